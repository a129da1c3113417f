// The page of a scene whose levels of detail come from the folder of its server.

import { say, startPage } from "./common.js";
import { FACTS } from "./facts.js";
import { Levels, machineBudget } from "./levels.js";
import { showScene, Viewer } from "./viewer.js";
import { Visitor } from "./visitor.js";

startPage(async () => {
  const viewer = streamed(FACTS);
  await showScene(viewer, null);
  new Visitor(viewer);
});

// A viewer that loads levels of detail from the folder of this page's server.
function streamed(facts) {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl)
    throw new Error(
      "This page draws with WebGL2, which this browser lacks or has switched off. Allow hardware acceleration, use another browser, or make a video: gsplat-edu render",
    );
  const budget = facts.lod.budget ?? machineBudget(gl, facts.sh_degree);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  let viewer = null;
  const levels = new Levels(facts, budget, () => {
    say("");
    viewer.changed();
  });
  viewer = new Viewer({ ...facts, count: levels.capacity }, { means: hidden(levels.capacity) }, levels);
  return viewer;
}

function hidden(count) {
  return new Float32Array(3 * count).fill(NaN);
}
