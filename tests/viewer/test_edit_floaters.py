"""The editor in Chromium: floaters proposed by the server, bar charts, growing and shrinking by buttons and keys."""

import http.client
import json
import os
import signal

import numpy as np
import pytest
import torch

from gestures import drag, inside
from gsplat_edu.edits.apply import flags_after
from gsplat_edu.edits.document import read_edits
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer.edit_serve import ADDRESS, FLOATERS
from viewer.handles import until
from viewer.pages import Editor
from waiting import awaited

N = 400


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
def served(edit_site):
    return edit_site(ball())


@pytest.fixture
def opened(served, visit):
    """Return a function that opens the page in a tab."""
    return lambda: visit(900, 700, url=served.url, kind=Editor).ready()


def test_floaters_are_proposed_with_reasons_selected_undone_and_deleted(opened, served):
    shown = opened()
    shown.do("propose")
    shown.tab.wait_for_selector("#edit-groups button")
    assert shown.tab.inner_text("#edit-proposed").startswith("Judged by shape alone, without photos: ")
    texts = [button.inner_text() for button in shown.tab.query_selector_all("#edit-groups button")]
    assert texts == ["1 · too large: wider than half of the scene", "1 · floating: far from all other splats"]
    shown.tab.click("#edit-groups button >> nth=1")
    assert shown.flags().nonzero()[0].tolist() == [N]
    last = shown.last()
    reason = "floating: far from all other splats"
    assert last == {"op": "select", "how": "replace", "by": "list", "reason": reason, "runs": [N, 1]}
    assert shown.tab.text_content("#edit-list li:last-child button") == f"select: {reason}"
    shown.do("undo")
    assert not shown.flags().any()
    shown.tab.click("#edit-groups button >> nth=0")
    shown.press("Delete", "Control+s")
    shown.tab.wait_for_selector('#edit-saved:text-is("saved")')
    np.testing.assert_array_equal(flags_after(read_edits(served.file).operations, ball()), shown.flags())
    again = opened()
    again.tab.wait_for_selector("#edit-groups button")
    assert again.tab.inner_text("[data-do=propose]") == "propose floaters"


def test_a_judgement_can_be_stopped_and_a_lost_server_is_said(opened, served):
    shown = opened()
    start = served.proposing.start

    def start_and_stand_still():
        start()
        os.kill(served.proposing.process.pid, signal.SIGSTOP)  # so that it has not ended before it is stopped

    served.proposing.start = start_and_stand_still
    shown.do("propose")
    shown.tab.wait_for_selector("[data-do=stop-proposing]:visible")
    assert shown.evaluate("document.activeElement.dataset.do") == "stop-proposing"
    assert shown.tab.is_visible("#edit-judged") and shown.tab.is_disabled("[data-do=propose]")
    shown.press("Enter")
    shown.tab.wait_for_selector("[data-do=propose]:not([disabled])")
    assert shown.tab.is_hidden("[data-do=stop-proposing]") and shown.tab.inner_text("#edit-groups") == ""
    assert served.proposing.state() == {"state": "idle"}


def test_a_press_counts_although_proposals_arrive_meanwhile(opened):
    """Their list moves the buttons below it."""
    shown, held = opened(), []

    def last_one_held(route):
        answer = route.fetch()
        if answer.json()["state"] == "done":
            held.append((route, answer))
        else:
            route.fulfill(response=answer)

    shown.select_all()
    shown.tab.route(f"**{FLOATERS}", last_one_held)
    shown.do("propose")
    awaited(shown.tab, lambda: held)
    shown.tab.hover("[data-do=undo]")
    shown.tab.mouse.down()
    ((route, answer),) = held
    route.fulfill(response=answer)
    shown.tab.wait_for_selector("#edit-groups button")
    shown.tab.mouse.up()
    assert len(shown.operations()) == 0, "the press has undone the selection"


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
        "Cookie": f"{served.cookie}={served.token}",
        "Origin": f"http://127.0.0.1:{served.port}",
    }

    def ask(method, path=FLOATERS, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=180)
        try:
            connection.request(method, path, headers=headers)
            answer = connection.getresponse()
            return answer.status, answer.read()
        finally:
            connection.close()

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


def set_range(shown, low, high):
    for name, value in (("low", low), ("high", high)):
        shown.evaluate(SET, [f"edit-{name}", value])


def chart(shown):
    until(shown.tab, "Boolean(editor.panel.histogram.ends && !editor.panel.histogram.asked)")
    return shown.evaluate("[[...editor.panel.histogram.all], [...editor.panel.histogram.selected]]")


def test_a_range_of_the_bar_chart_is_selected_by_keys_and_by_dragging(opened):
    shown = opened()
    shown.tab.click("#edit-histogram summary")
    everything, chosen = chart(shown)
    assert sum(everything) == N + 2 and sum(chosen) == 0 and len(everything) == 50
    opacities = torch.sigmoid(ball().logit_opacities.double()).numpy()
    assert everything == np.histogram(opacities, 50, (0, 1))[0].tolist()
    shown.tab.focus("#edit-low")
    shown.press(*["ArrowRight"] * 60)
    assert shown.tab.inner_text("#edit-low-text") == "0.3" and "no limit" in shown.tab.inner_text(
        "#edit-high-text"
    )
    shown.press("Enter")
    assert shown.evaluate("editor.history.done.at(-1).by") == "opacity"
    np.testing.assert_array_equal(shown.flags(), opacities >= 0.3)
    everything, chosen = chart(shown)
    assert sum(chosen) == (opacities >= 0.3).sum() and "are selected" in shown.tab.get_attribute(
        "#edit-chart", "aria-label"
    )
    box = shown.tab.query_selector("#edit-chart").bounding_box()
    drag(shown.tab, *inside(box, (0.95, 0.5), (0.5, 0.5)))
    assert shown.tab.input_value("#edit-high") == "100" and shown.tab.input_value("#edit-low") == "60"
    shown.do("select-range")
    np.testing.assert_array_equal(shown.flags(), (opacities >= 0.3) & (opacities <= 0.5))
    shown.tab.select_option("#edit-quantity", "distance")
    chart(shown)
    assert shown.tab.input_value("#edit-low") == "0"
    set_range(shown, 0, 150)
    shown.do("select-range")
    last = shown.last()
    assert (
        last["by"] == "distance"
        and "low" not in last
        and last["center"] == shown.evaluate("viewer.view.focus")
    )
    far = np.linalg.norm(ball().means.double().numpy() - np.array(last["center"]), axis=1)
    np.testing.assert_array_equal(shown.flags(), far <= last["high"])
    shown.tab.select_option("#edit-quantity", "size")
    chart(shown)
    set_range(shown, 100, 200)
    shown.do("select-range")
    assert shown.evaluate("editor.history.done.at(-1).by") == "size" and shown.flags().nonzero()[
        0
    ].tolist() == [N + 1]


def test_the_bar_chart_is_as_sharp_as_its_panel_is_wide_in_a_window_that_keeps_its_size(opened):
    shown = opened()
    shown.tab.click("#edit-histogram summary")
    chart(shown)
    before = shown.evaluate("element('edit-chart').width")
    shown.evaluate("element('edit-column').style.width = '14rem'")  # as beside a scroll bar
    until(shown.tab, f"element('edit-chart').width < {before}")
    assert shown.evaluate("element('edit-chart').width === element('edit-chart').clientWidth")


def test_the_selection_grows_and_shrinks_by_keys(opened):
    shown = opened()
    assert float(shown.tab.input_value("#edit-near")) == pytest.approx(0.3)
    assert shown.tab.is_disabled("[data-do=grow]") and shown.tab.is_disabled("[data-do=shrink]")
    shown.evaluate("editor.perform({ op: 'select', how: 'replace', by: 'list', reason: '', runs: [0, 5] })")
    shown.press(".")
    grown = shown.flags().sum()
    assert grown > 5 and shown.last() == {"op": "grow", "radius": 0.3}
    shown.press(",")
    assert shown.flags().sum() < grown
    assert shown.tab.text_content("#edit-list li:last-child button") == "shrink by 0.3"
    shown.tab.fill("#edit-near", "0")
    shown.select_all()
    shown.do("grow")
    assert shown.tab.inner_text("#edit-message") == "Give a radius above 0."
