// The page's side of the sorting worker. One sort runs at a time because a single buffer travels to the worker and
// back.

export class Sorter {
  // onOrder(order, thinning) is called after each sort, before the next one takes the buffer away.
  constructor(splats, near, onOrder) {
    const source = document.getElementById("sort-worker").textContent;
    const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    this.worker = new Worker(url);
    this.near = near;
    this.onOrder = onOrder;
    this.running = null;
    this.sorted = "";
    this.version = 0; // of the means
    this.keeping = 0; // version of what every sample contains
    this.camera = null; // of the last sort
    this.give(splats);
  }

  // Gives the worker copies, which it keeps. Without scales and opacities, it ranks no splats.
  give({ means, log_scales, logit_opacities }) {
    this.order = new ArrayBuffer((means.length / 3) * Uint32Array.BYTES_PER_ELEMENT);
    const copies = [means, log_scales, logit_opacities].map((array) => array?.slice() ?? null);
    const buffers = copies.filter((copy) => copy).map((copy) => copy.buffer);
    this.worker.postMessage({ splats: copies, near: this.near }, buffers);
    this.ranks = Boolean(log_scales && logit_opacities);
  }

  // Takes other splats, in place of all. prepare() is called before; the next order is of these.
  async replace(splats, prepare) {
    while (this.running) await this.running;
    prepare();
    ++this.version;
    this.give(splats);
  }

  // Whether the current order was made for this camera, and of a sample of so many splats.
  fits(camera, most = Infinity) {
    return this.sorted === this.key(camera, most);
  }

  key(camera, most) {
    const sample = this.ranks && most < Infinity ? `${most} ${this.keeping}` : "all";
    return `${this.version} ${sample} ${Sorter.key(camera)}`;
  }

  // An order depends only on depth, or on distance for a head, which is a camera whose R is null.
  static key(camera) {
    return JSON.stringify([Sorter.axis(camera), camera.eye]);
  }

  static axis({ R }) {
    return R?.[2];
  }

  // Replaces means, beginning with splat `at`.
  write(means, at) {
    ++this.version;
    this.worker.postMessage({ replaced: means, at }, [means.buffer]);
  }

  // Puts these splats into every sample, see sorted_splats.js; it takes the array.
  keep(indices) {
    ++this.keeping;
    this.worker.postMessage({ kept: indices }, [indices.buffer]);
  }

  // Takes splats out of the order.
  hide(at, count) {
    this.write(new Float32Array(3 * count).fill(NaN), at);
  }

  // Sorts again for the last camera if there was one.
  async refresh() {
    if (this.camera) await this.sort(this.camera);
  }

  // Sorts the splats for a camera: all, or a sample of so many, see sorted_splats.js.
  async sort(camera, most = Infinity) {
    while (this.running) await this.running;
    if (this.fits(camera, most)) return;
    this.camera = camera;
    const key = this.key(camera, most);
    this.running = new Promise((resolve, reject) => {
      this.worker.onerror = () => reject(new Error("The sorting thread failed; reload the page."));
      this.worker.onmessage = ({ data }) => {
        this.order = data.order;
        this.sorted = key;
        this.running = null;
        this.onOrder(new Uint32Array(data.order, 0, data.count), data.thinning);
        resolve();
      };
    });
    const wanted = this.ranks ? most : Infinity;
    this.worker.postMessage({ axis: Sorter.axis(camera), eye: camera.eye, order: this.order, most: wanted }, [
      this.order,
    ]);
    await this.running;
  }
}
