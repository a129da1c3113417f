"""The editor in Chromium: floaters proposed by the server, bar charts, growing and shrinking by buttons and keys."""

import http.client
import json
import os
import signal
import threading

import numpy as np
import pytest
import torch

from gsplat_edu.edits.apply import flags_after
from gsplat_edu.edits.document import read_edits
from gsplat_edu.edits.identity import identity_of
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.runs.source import open_source
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer import page, page_parts
from gsplat_edu.viewer.edit_page import editing_of
from gsplat_edu.viewer.edit_serve import ADDRESS, FLOATERS, EditServer
from viewer.handles import until
from waiting import awaited

N = 400


READY = "async () => { while (!window.editor) await new Promise((done) => setTimeout(done, 20)); }"
SET = """([id, value]) => {
  element(id).value = value;
  element(id).dispatchEvent(new Event("input", { bubbles: true }));
}"""


def ball():
    """A ball of splats of opacities from 0.1 to 0.9, one splat far away and one that is too large."""
    rng = np.random.default_rng(0)
    means = torch.from_numpy(rng.normal(size=(N + 2, 3))).float()
    means[N] = torch.tensor([60.0, 0.0, 0.0])
    scales = torch.full((N + 2, 3), 0.1)
    scales[N + 1] = 5.0
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(N + 2, 1)
    opacities = torch.linspace(0.1, 0.9, N + 2)
    return Gaussians(
        means, quats, scales.log(), means[:, None] / 4, torch.zeros(N + 2, 0, 3), torch.logit(opacities)
    )


@pytest.fixture
def served(tmp_path):
    """Serve the ball with the editor."""
    scene, file = tmp_path / "ball.ply", tmp_path / "edits.json"
    write_scene(scene, Scene(ball()))
    source = open_source(scene)
    with EditServer("127.0.0.1", 0, page_parts.policy(page_parts.EDITOR), file) as server:
        server.prepare(identity_of(source.scene), scene)
        editing = editing_of(source, scene, file, ADDRESS)
        server.page = page.html(source.scene, (), source.settings, "ball", editing=editing)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join(10)


@pytest.fixture
def opened(browser, served):
    """Return a function that opens the page in a tab; nothing may be written to its console."""
    tabs, complaints = [], []

    def make(width=900, height=700, **options):
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        tab = context.new_page()
        tab.on("pageerror", lambda error: complaints.append(str(error)))
        tab.on(
            "console", lambda message: complaints.append(message.text) if message.type == "error" else None
        )
        tab.goto(served.url)
        tab.wait_for_selector("#edit")
        tab.evaluate(READY)
        tabs.append(context)
        return tab

    yield make
    for context in tabs:
        context.close()
    assert complaints == []


def flags(tab):
    return np.array(tab.evaluate("[...editor.history.flags]"), dtype=np.uint8)


def test_floaters_are_proposed_with_reasons_selected_undone_and_deleted(opened, served):
    tab = opened()
    tab.click("[data-do=propose]")
    tab.wait_for_selector("#edit-groups button")
    assert tab.inner_text("#edit-proposed").startswith("Judged by shape alone, without photos: ")
    texts = [button.inner_text() for button in tab.query_selector_all("#edit-groups button")]
    assert texts == ["1 · too large: wider than half of the scene", "1 · floating: far from all other splats"]
    tab.click("#edit-groups button >> nth=1")
    assert flags(tab).nonzero()[0].tolist() == [N]
    last = tab.evaluate("editor.history.done.at(-1)")
    reason = "floating: far from all other splats"
    assert last == {"op": "select", "how": "replace", "by": "list", "reason": reason, "runs": [N, 1]}
    assert tab.text_content("#edit-list li:last-child button") == f"select: {reason}"
    tab.click("[data-do=undo]")
    assert not flags(tab).any()
    tab.click("#edit-groups button >> nth=0")
    tab.keyboard.press("Delete")
    tab.keyboard.press("Control+s")
    tab.wait_for_selector('#edit-saved:text-is("saved")')
    np.testing.assert_array_equal(flags_after(read_edits(served.file).operations, ball()), flags(tab))
    again = opened()
    again.wait_for_selector("#edit-groups button")
    assert again.inner_text("[data-do=propose]") == "propose floaters"


def test_a_judgement_can_be_stopped_and_a_lost_server_is_said(opened, served):
    tab = opened()
    start = served.proposing.start

    def start_and_stand_still():
        start()
        os.kill(
            served.proposing._process.pid, signal.SIGSTOP
        )  # so that it has not ended before it is stopped

    served.proposing.start = start_and_stand_still
    tab.click("[data-do=propose]")
    tab.wait_for_selector("[data-do=stop-proposing]:visible")
    assert tab.evaluate("document.activeElement.dataset.do") == "stop-proposing"
    assert tab.is_visible("#edit-judged") and tab.is_disabled("[data-do=propose]")
    tab.keyboard.press("Enter")
    tab.wait_for_selector("[data-do=propose]:not([disabled])")
    assert tab.is_hidden("[data-do=stop-proposing]") and tab.inner_text("#edit-groups") == ""
    assert served.proposing.state() == {"state": "idle"}


def test_a_press_counts_although_proposals_arrive_meanwhile(opened):
    """Their list moves the buttons below it."""
    tab, held = opened(), []

    def last_one_held(route):
        answer = route.fetch()
        if answer.json()["state"] == "done":
            held.append((route, answer))
        else:
            route.fulfill(response=answer)

    tab.evaluate("editor.perform({ op: 'select', how: 'replace', by: 'all' })")
    tab.route(f"**{FLOATERS}", last_one_held)
    tab.click("[data-do=propose]")
    awaited(tab, lambda: held)
    tab.hover("[data-do=undo]")
    tab.mouse.down()
    ((route, answer),) = held
    route.fulfill(response=answer)
    tab.wait_for_selector("#edit-groups button")
    tab.mouse.up()
    assert tab.evaluate("editor.history.done.length") == 0, "the press has undone the selection"


LATE = """async () => {
  const { floaters } = editor.panel;
  const [ask, show, answers, shown] = [window.fetch, floaters.show.bind(floaters), [], []];
  floaters.show = (found) => shown.push(found.state);
  window.fetch = () => new Promise((resolve) => answers.push(resolve));
  const asked = [floaters.ask("GET", true), floaters.ask("POST")];
  window.fetch = ask;
  for (const [i, state] of [[1, "running"], [0, "idle"]]) {
    answers[i](new Response(JSON.stringify({ state })));
    await asked[i];
  }
  floaters.show = show;
  return shown;
}"""
"""Answers the question of the page's start after that of a press of the button; returns the states shown."""


def test_a_late_answer_does_not_hide_a_running_judgement(opened):
    assert opened().evaluate(LATE) == ["running"]


def test_only_the_page_may_start_a_judgement(served):
    own = {
        "Cookie": served.guard.cookie.partition(";")[0],
        "Origin": f"http://127.0.0.1:{served.server_port}",
    }

    def ask(method, path=FLOATERS, **headers):
        connection = http.client.HTTPConnection(*served.server_address[:2], timeout=180)
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read()

    for method in ("GET", "POST", "DELETE"):
        assert ask(method)[0] == 403
    for method in ("POST", "DELETE"):
        assert ask(method, **{**own, "Origin": "http://example.org"})[0] == 403
        assert ask(method, ADDRESS, **own)[0] == 405
    assert served.proposing.state() == {"state": "idle"}
    status, body = ask("GET", **own)
    assert (status, json.loads(body)) == (200, {"state": "idle"})
    served.proposing = None
    assert ask("POST", **own)[0] == 404


def set_range(tab, low, high):
    for name, value in (("low", low), ("high", high)):
        tab.evaluate(SET, [f"edit-{name}", value])


def chart(tab):
    until(tab, "Boolean(editor.panel.histogram.ends && !editor.panel.histogram.asked)")
    return tab.evaluate("[[...editor.panel.histogram.all], [...editor.panel.histogram.selected]]")


def test_a_range_of_the_bar_chart_is_selected_by_keys_and_by_dragging(opened):
    tab = opened()
    tab.click("#edit-histogram summary")
    everything, chosen = chart(tab)
    assert sum(everything) == N + 2 and sum(chosen) == 0 and len(everything) == 50
    opacities = torch.sigmoid(ball().logit_opacities.double()).numpy()
    assert everything == np.histogram(opacities, 50, (0, 1))[0].tolist()
    tab.focus("#edit-low")
    for _ in range(60):
        tab.keyboard.press("ArrowRight")
    assert tab.inner_text("#edit-low-text") == "0.3" and "no limit" in tab.inner_text("#edit-high-text")
    tab.keyboard.press("Enter")
    assert tab.evaluate("editor.history.done.at(-1).by") == "opacity"
    np.testing.assert_array_equal(flags(tab), opacities >= 0.3)
    everything, chosen = chart(tab)
    assert sum(chosen) == (opacities >= 0.3).sum() and "are selected" in tab.get_attribute(
        "#edit-chart", "aria-label"
    )
    box = tab.query_selector("#edit-chart").bounding_box()
    at = [(box["x"] + share * box["width"], box["y"] + 40) for share in (0.95, 0.5)]
    tab.mouse.move(*at[0])
    tab.mouse.down()
    tab.mouse.move(*at[1], steps=4)
    tab.mouse.up()
    assert tab.input_value("#edit-high") == "100" and tab.input_value("#edit-low") == "60"
    tab.click("[data-do=select-range]")
    np.testing.assert_array_equal(flags(tab), (opacities >= 0.3) & (opacities <= 0.5))
    tab.select_option("#edit-quantity", "distance")
    chart(tab)
    assert tab.input_value("#edit-low") == "0"
    set_range(tab, 0, 150)
    tab.click("[data-do=select-range]")
    last = tab.evaluate("editor.history.done.at(-1)")
    assert (
        last["by"] == "distance" and "low" not in last and last["center"] == tab.evaluate("viewer.view.focus")
    )
    far = np.linalg.norm(ball().means.double().numpy() - np.array(last["center"]), axis=1)
    np.testing.assert_array_equal(flags(tab), far <= last["high"])
    tab.select_option("#edit-quantity", "size")
    chart(tab)
    set_range(tab, 100, 200)
    tab.click("[data-do=select-range]")
    assert tab.evaluate("editor.history.done.at(-1).by") == "size" and flags(tab).nonzero()[0].tolist() == [
        N + 1
    ]


def test_the_selection_grows_and_shrinks_by_keys(opened):
    tab = opened()
    assert float(tab.input_value("#edit-near")) == pytest.approx(0.3)
    assert tab.is_disabled("[data-do=grow]") and tab.is_disabled("[data-do=shrink]")
    tab.evaluate("editor.perform({ op: 'select', how: 'replace', by: 'list', reason: '', runs: [0, 5] })")
    tab.keyboard.press(".")
    grown = flags(tab).sum()
    assert grown > 5 and tab.evaluate("editor.history.done.at(-1)") == {"op": "grow", "radius": 0.3}
    tab.keyboard.press(",")
    assert flags(tab).sum() < grown
    assert tab.text_content("#edit-list li:last-child button") == "shrink by 0.3"
    tab.fill("#edit-near", "0")
    tab.evaluate("editor.perform({ op: 'select', how: 'replace', by: 'all' })")
    tab.click("[data-do=grow]")
    assert tab.inner_text("#edit-message") == "Give a radius above 0."
