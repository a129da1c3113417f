"""The page in Chromium: from a capture to a scene, on a desktop and a phone, across reloads, without other servers."""

import base64
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import build_wasm
from accessibility import STYLES, grave_faults
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.io.formats import read_scene
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.tab.serving import TabServer
from waiting import PATIENCE

DROP = """async ([name, data]) => {
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
  const transfer = new DataTransfer();
  transfer.items.add(new File([bytes], name));
  document.body.dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, bubbles: true }));
}"""


@pytest.fixture(scope="module")
def server():
    assert build_wasm.is_built(), "the WebAssembly module is missing or old: run tools/set_up.sh dev"
    with TabServer() as made:
        made.start(made.application())
        yield made


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "ball"
    write_colmap(folder, *procedural_capture(48, 12, splats=60))
    return folder


@pytest.fixture
def window(browser):
    return browser.new_context(viewport={"width": 1440, "height": 900}, accept_downloads=True)


def opened(window, server, faults=None):
    """Open the page in a tab; faults of its scripts are collected, or fail the test when they are looked at."""
    tab = window.new_page()
    tab.on("pageerror", lambda error: (faults if faults is not None else []).append(str(error)))
    tab.goto(server.url)
    tab.get_by_role("button", name="Try the example").wait_for()
    return tab


def drop(tab, path):
    tab.evaluate(DROP, [path.name, base64.b64encode(path.read_bytes()).decode()])


def choose_draft(tab):
    """Wait for the forecast, choose the shortest length, and wait for its own forecast."""
    start = tab.locator("button:has-text('Start'):not([disabled])")
    start.wait_for()
    tab.get_by_text("Draft", exact=True).click()
    tab.get_by_text("Preparing photo").or_(tab.get_by_text("Trying the first steps")).first.wait_for()
    start.wait_for()
    return start


def scene_of(tab, text):
    with tab.expect_download() as download:
        tab.get_by_role("button", name=text).click()
    return Path(download.value.path())


def trained(tab):
    """Wait for the verdict, and return the bytes of the scene."""
    tab.locator(".banner").wait_for(timeout=4000 * PATIENCE)
    return scene_of(tab, "Download the scene (PLY)")


def test_from_a_dropped_zip_file_to_a_scene_that_python_scores_alike(window, server, capture, tmp_path):
    """The page shows PSNR with two digits; both render in float32, whose errors are far below 1e-4 of a pixel's range.

    A photo's mean squared error is at least 1e-4 here (PSNR below 40 dB), so an error of 1e-5 in all pixels changes it
    by less than 2 * 1e-5 * 1e-2, 0.2 % or 0.01 dB.
    """
    faults, asked = [], []
    window.on("request", lambda request: asked.append(request.url))
    tab = opened(window, server, faults)
    drop(tab, Path(shutil.make_archive(str(tmp_path / "ball"), "zip", capture)))
    choose_draft(tab).click()
    path = trained(tab)
    gaussians = read_scene(shutil.copy(path, tmp_path / "ball.ply")).gaussians
    tab.get_by_text("Details").click()
    shown = float(re.search(r"([\d.]+) dB on held-out photos", tab.inner_text("#place"))[1])
    settings, scores = RenderSettings(jacobian_limit=1.3), []
    for view in load_dataset(capture).test:
        image = render(gaussians, view.camera, settings=settings).image.numpy(force=True)
        error = np.mean((np.clip(image, 0, 1) - view.read().image / 255.0) ** 2)
        scores.append(-10 * np.log10(error))
    assert 15 < shown < 40
    assert abs(np.mean(scores) - shown) < 0.005 + 0.01
    own = server.url.rstrip("/")
    assert faults == [] and {url for url in asked if not url.startswith((own, "blob:", "data:"))} == set()


def test_a_closed_tab_continues_to_the_same_bytes(window, server, capture):
    """A tab is closed in mid-training, after a pause has kept its state; the next one ends with the same scene."""
    tab = opened(window, server)
    tab.locator("input[webkitdirectory]").set_input_files(capture)
    choose_draft(tab).click()
    whole = trained(tab).read_bytes()
    tab.get_by_role("button", name="New scene").click()
    tab.locator("input[webkitdirectory]").set_input_files(capture)
    choose_draft(tab).click()
    tab.get_by_role("button", name="Pause").click()
    tab.get_by_role("button", name="Download the scene so far").wait_for()
    paused = scene_of(tab, "Download the scene so far").read_bytes()
    tab.get_by_role("button", name="Continue").click()
    tab.close()
    tab = opened(window, server)
    tab.get_by_text("Continue ball").wait_for()
    tab.get_by_role("button", name="Continue").click()
    assert trained(tab).read_bytes() == whole != paused


KEPT = """() => new Promise((resolve) => {
  const request = indexedDB.open("gsplat_edu", 1);
  request.onupgradeneeded = () => request.result.createObjectStore("training");
  request.onsuccess = () => {
    const keys = request.result.transaction("training").objectStore("training").getAllKeys();
    keys.onsuccess = () => resolve(keys.result);
  };
})"""
"""Names of what the page keeps in the browser's storage."""


@pytest.mark.parametrize("tabs", [1, 2])
def test_only_the_first_tab_keeps_its_training(window, server, capture, tabs):
    tab = [opened(window, server) for _ in range(tabs)][-1]
    tab.locator("input[webkitdirectory]").set_input_files(capture)
    choose_draft(tab).click()
    tab.get_by_role("button", name="Pause").click()
    scene_of(tab, "Download the scene so far")  # the worker answers after it has kept the state
    assert tab.evaluate(KEPT) == (["capture", "state"] if tabs == 1 else [])


def test_what_is_no_capture_is_said_in_one_sentence(window, server, capture, tmp_path):
    tab = opened(window, server)
    shutil.copytree(capture / "images", tmp_path / "photos")
    tab.locator("input[webkitdirectory]").set_input_files(tmp_path / "photos")
    said = tab.locator(".error").inner_text()
    assert said.startswith("There are 12 photos, but no camera poses") and said.endswith(".")
    drop(tab, capture / "sparse/0/cameras.bin")
    tab.get_by_text("There are no photos here").wait_for()


@pytest.mark.parametrize(("width", "height", "scheme"), STYLES)
def test_the_page_fits_and_has_no_grave_fault(browser, server, width, height, scheme):
    window = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
    tab = opened(window, server)

    def check():
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
        assert grave_faults(tab) == []

    check()
    tab.get_by_role("button", name="Try the example").click()
    tab.locator("button:has-text('Start'):not([disabled])").wait_for()
    tab.get_by_text("Details").click()
    check()
    tab.get_by_role("button", name="Start").click()
    tab.get_by_role("button", name="Pause").click()
    check()
