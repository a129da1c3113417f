(window.gsplatData ??= {}).wipe = {"width":240,"height":180,"brightest":0.25,"views":[{"name":"IMG_17.png","psnr":26.21},{"name":"IMG_25.png","psnr":24.94},{"name":"IMG_00.png","psnr":21.19}]};
