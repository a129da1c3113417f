// The page's side of the sorting worker: one sort at a time, because there is one buffer, which travels to the worker
// and back.
"use strict";

class Sorter {
  // onOrder(order) is told of every finished sort, before the next one can take the buffer away.
  constructor(means, near, onOrder) {
    const source = document.getElementById("sort-worker").textContent;
    const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    this.worker = new Worker(url);
    this.order = new ArrayBuffer((means.length / 3) * Uint32Array.BYTES_PER_ELEMENT);
    this.onOrder = onOrder;
    this.running = null;
    this.sorted = "";
    const copy = means.slice(); // the worker keeps it
    this.worker.postMessage({ means: copy, near }, [copy.buffer]);
  }

  // Whether the order that is there was made for this camera.
  fits(camera) {
    return this.sorted === Sorter.key(camera);
  }

  // Depth is all that an order depends on.
  static key(camera) {
    return JSON.stringify([camera.R[2], camera.eye]);
  }

  async sort(camera) {
    while (this.running) await this.running;
    if (this.fits(camera)) return;
    this.running = new Promise((resolve, reject) => {
      this.worker.onerror = () => reject(new Error("The thread that sorts the splats failed; reload the page."));
      this.worker.onmessage = ({ data }) => {
        this.order = data.order;
        this.sorted = Sorter.key(camera);
        this.running = null;
        this.onOrder(new Uint32Array(data.order, 0, data.count));
        resolve();
      };
    });
    this.worker.postMessage({ axis: camera.R[2], eye: camera.eye, order: this.order }, [this.order]);
    await this.running;
  }
}
