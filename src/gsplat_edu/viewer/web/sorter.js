// The page's side of the sorting worker. One sort runs at a time because a single buffer travels to the worker and
// back.
"use strict";

class Sorter {
  // onOrder(order) is called after each sort, before the next one takes the buffer away.
  constructor(means, near, onOrder) {
    const source = document.getElementById("sort-worker").textContent;
    const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    this.worker = new Worker(url);
    this.near = near;
    this.onOrder = onOrder;
    this.running = null;
    this.sorted = "";
    this.version = 0; // of the means
    this.camera = null; // of the last sort
    this.give(means);
  }

  give(means) {
    this.order = new ArrayBuffer((means.length / 3) * Uint32Array.BYTES_PER_ELEMENT);
    const copy = means.slice(); // transferred to the worker, which keeps it
    this.worker.postMessage({ means: copy, near: this.near }, [copy.buffer]);
  }

  // Takes other means, in place of all. prepare() is called before; the next order is of these means.
  async replace(means, prepare) {
    while (this.running) await this.running;
    prepare();
    ++this.version;
    this.give(means);
  }

  // Whether the current order was made for this camera.
  fits(camera) {
    return this.sorted === this.version + Sorter.key(camera);
  }

  // An order depends only on depth.
  static key(camera) {
    return JSON.stringify([camera.R[2], camera.eye]);
  }

  // Replaces means, beginning with splat `at`.
  write(means, at) {
    ++this.version;
    this.worker.postMessage({ replaced: means, at }, [means.buffer]);
  }

  // Takes splats out of the order.
  hide(at, count) {
    this.write(new Float32Array(3 * count).fill(NaN), at);
  }

  // Sorts again for the last camera if there was one.
  async refresh() {
    if (this.camera) await this.sort(this.camera);
  }

  async sort(camera) {
    while (this.running) await this.running;
    if (this.fits(camera)) return;
    this.camera = camera;
    const key = this.version + Sorter.key(camera);
    this.running = new Promise((resolve, reject) => {
      this.worker.onerror = () => reject(new Error("The sorting thread failed; reload the page."));
      this.worker.onmessage = ({ data }) => {
        this.order = data.order;
        this.sorted = key;
        this.running = null;
        this.onOrder(new Uint32Array(data.order, 0, data.count));
        resolve();
      };
    });
    this.worker.postMessage({ axis: camera.R[2], eye: camera.eye, order: this.order }, [this.order]);
    await this.running;
  }
}
