// Pictures of projects: a photo, or a scene that the studio draws.

import { at, get } from "./api.js";

// Address of a small picture of photos; null if there is none.
async function pictureOf(entry) {
  if (!entry.photos) return null;
  const { photos } = await get(at(entry.entry, "photos"));
  const good = photos.find(({ problem }) => !problem);
  return good ? `${at(entry.entry, "thumbs", good.name)}?side=256` : null;
}

// The studio draws the pictures of scenes, one after the other, and only those that somebody sees.
let drawn = Promise.resolve();
const covers = new IntersectionObserver((seen) => {
  for (const { target, isIntersecting } of seen) {
    const { cover, image } = target;
    if (!isIntersecting || !cover) continue;
    target.cover = null;
    drawn = drawn.then(async () => {
      if (!target.isConnected || !(await fetch(cover).catch(() => ({}))).ok) return;
      Object.assign(image, { src: cover, hidden: false });
    });
  }
});

// Reads the picture again once the entry has changed.
export function picture(element, entry) {
  const version = `${entry.entry} ${entry.modified} ${entry.files} ${entry.finished}`;
  if (element.version === version) return;
  element.version = version;
  if (entry.kind === "scenes" || entry.kind === "runs") {
    const isThere = entry.kind === "runs" ? entry.psnr !== null : entry.file;
    element.cover = isThere && `${at(entry.entry, "cover")}?of=${entry.modified}`;
    covers.unobserve(element);
    covers.observe(element); // tells at once if it is seen
    return;
  }
  pictureOf(entry).then(
    (address) => {
      element.image.hidden = !address;
      if (address) element.image.src = address;
    },
    () => {},
  );
}
