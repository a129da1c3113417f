// Sorts the splats of a page in its own thread. One order travels to it and back; see sorter.js.

import { SortedSplats } from "./sorted_splats.js";

let splats = null;

self.onmessage = ({ data }) => {
  if (data.splats) splats = new SortedSplats(data.splats, data.near);
  else if (data.replaced) splats.replace(data.replaced, data.at);
  else if (data.kept) splats.keep(data.kept);
  else {
    const order = new Uint32Array(data.order);
    const { count, thinning } = splats.sort(data.axis, data.eye, order, data.most);
    self.postMessage({ order: order.buffer, count, thinning }, [order.buffer]);
  }
};
