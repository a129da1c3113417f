"""Node and Chromium give the same bytes, on one thread and on several."""

import base64
import hashlib

import pytest

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.tab.serving import TabServer
from wasm_host import Host, options_of

TRAIN = """async ([threads, points, colors, views, settings]) => {
  const engine = await import("/tab/web/engine.js");
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const numbers = (text) => new Float64Array(bytes(text).buffer);
  const name = threads > 1 ? "gsplat_edu_threads.wasm" : "gsplat_edu.wasm";
  const module = await engine.loadModule(`/tab/web/${name}`, { threads });
  const trainer = new engine.Trainer(module, {
    points: numbers(points),
    colors: numbers(colors),
    views: views.map((view) => ({ ...view, pixels: bytes(view.pixels) })),
    settings,
  });
  trainer.step(settings.iterations);
  const digest = await crypto.subtle.digest("SHA-256", trainer.state());
  module.close();
  return [...new Uint8Array(digest)].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}"""


def text(array):
    """An array's bytes for JavaScript."""
    return base64.b64encode(array.tobytes()).decode()


@pytest.mark.parametrize("threads", [1, 2])
def test_chromium_trains_to_the_bytes_of_node(node, browser, threads):
    options = options_of(*procedural_capture(64, 10), iterations=60, maxGaussians=700)
    host = Host(node)
    host.ask("train", **options)
    host.ask("step", count=60)
    expected = hashlib.sha256(host.ask("state").tobytes()).hexdigest()
    host.close()
    views = [view | {"pixels": text(view["pixels"])} for view in options["views"]]
    with TabServer() as server:
        server.start(server.application())
        tab = browser.new_page()
        tab.goto(server.url)
        given = [threads, text(options["points"]), text(options["colors"]), views, options["settings"]]
        assert tab.evaluate(TRAIN, given) == expected
