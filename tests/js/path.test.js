import { test } from "node:test";

import { readKeyframe } from "../../src/gsplat_edu/viewer/web/keyframes.js";
import { PathCurve } from "../../src/gsplat_edu/viewer/web/path.js";
import { assertClose, vectors } from "./vectors.js";

test("a camera path moves as in Python", () => {
  for (const { name, path, length, times, eyes, rotations, fovs } of vectors("paths")) {
    const curve = new PathCurve({ ...path, keyframes: path.keyframes.map(readKeyframe) });
    assertClose(curve.length, length, { absolute: 1e-9, relative: 1e-9 }, name);
    for (const [i, time] of times.entries()) {
      const { eye, R, fov } = curve.pose(time);
      assertClose([eye, R, fov], [eyes[i], rotations[i], fovs[i]], { absolute: 1e-6 }, `${name} at ${time} s`);
    }
  }
});
