// The page of a scene whose splats it contains.

import { startPage } from "./common.js";
import { FACTS } from "./facts.js";
import { Headset } from "./headset.js";
import { unpackSplats } from "./scene.js";
import { showScene, Viewer } from "./viewer.js";
import { tellUnpacked, Visitor } from "./visitor.js";

// page.html?ui=0 is the picture alone, for a page that embeds it.
if (new URLSearchParams(location.search).get("ui") === "0") document.documentElement.classList.add("bare");

startPage(async () => {
  const splats = await unpackSplats(FACTS, tellUnpacked);
  const viewer = new Viewer(FACTS, splats);
  await showScene(viewer, splats);
  if (!FACTS.edit) new Visitor(viewer);
  if (!FACTS.edit && !FACTS.live) await Headset.look(viewer);
});
