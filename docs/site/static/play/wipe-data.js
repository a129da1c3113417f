(window.gsplatData ??= {}).wipe = {"width":240,"height":180,"brightest":0.25,"views":[{"name":"IMG_17.png","psnr":26.09},{"name":"IMG_33.png","psnr":24.25},{"name":"IMG_00.png","psnr":20.53}]};
