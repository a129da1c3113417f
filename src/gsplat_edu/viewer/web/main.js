// The page of a scene whose splats it contains.

import { fitted } from "./camera.js";
import { element, followSize, hasSize, startPage } from "./common.js";
import { FACTS } from "./facts.js";
import { Headset } from "./headset.js";
import { unpackSplats } from "./scene.js";
import { showScene, Viewer } from "./viewer.js";
import { tellUnpacked, Visitor } from "./visitor.js";

// page.html?ui=0 is the picture alone, for a page that embeds it.
if (new URLSearchParams(location.search).get("ui") === "0") document.documentElement.classList.add("bare");

// Shows the poster, a picture of the start view, where the first picture will have it.
function placePoster({ start: { camera }, border, settings }) {
  const [poster, canvas] = [element("poster"), element("canvas")];
  if (!poster || !hasSize(canvas)) return;
  const { fx, cx, cy } = fitted(camera, canvas.clientWidth, canvas.clientHeight);
  const scale = fx / camera.fx;
  const px = { left: cx - scale * (camera.cx + 0.5), top: cy - scale * (camera.cy + 0.5) }; // but for half a pixel
  Object.assign(px, { wide: scale * camera.W, high: scale * camera.H });
  for (const [name, value] of Object.entries(px)) poster.style.setProperty(`--${name}`, `${value.toFixed(1)}px`);
  const around = (border || settings.background).map((level) => Math.round(255 * level));
  poster.parentElement.style.background = `rgb(${around})`;
}

startPage(async () => {
  placePoster(FACTS);
  followSize(element("canvas"), () => placePoster(FACTS));
  const splats = await unpackSplats(FACTS, tellUnpacked);
  const viewer = new Viewer(FACTS, splats);
  await showScene(viewer, splats);
  if (!FACTS.edit) new Visitor(viewer);
  if (!FACTS.edit && !FACTS.live) await Headset.look(viewer);
});
