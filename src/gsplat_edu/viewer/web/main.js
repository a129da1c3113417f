// The page of a scene whose splats it contains.

import { startPage } from "./common.js";
import { FACTS } from "./facts.js";
import { unpackSplats } from "./scene.js";
import { showScene, Viewer } from "./viewer.js";

startPage(async () => {
  const splats = await unpackSplats(FACTS);
  await showScene(new Viewer(FACTS, splats), splats);
});
