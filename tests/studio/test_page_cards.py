"""Cards of the library and of jobs: what a training takes before it starts, and a time left that never rises."""

import re

from accessibility import grave_faults_in_all_styles
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from studio.pages import waiting

SHOWN = """async (events) => {
  const { Store } = await import("/web/store.js");
  const { jobCard } = await import("/web/jobs.js");
  const store = new Store();
  const work = { command: "train", inputs: ["captures/a"], outputs: ["runs/a"], options: {} };
  const named = { id: "1", title: "training of a", subject: "runs/a", command: "" };
  const view = store.put({ ...named, state: "running", waits_for: [], work });
  const card = jobCard(store, "1");
  const shown = [];
  for (const [number, event] of events.entries()) {
    view.take({ ...event, number: number + 1 });
    card.update();
    shown.push(card.element.querySelector(".left").textContent);
  }
  return shown;
}"""
"""Feeds the events of a job to its card; returns what it says of the time left after each."""


def log(stage, *left):
    """Planted events of a stage: its forecasts of the time left, s, at equal steps."""
    steps = [
        {"event": "progress", "stage": stage, "done": i, "total": len(left), "seconds_left": s}
        for i, s in enumerate(left)
    ]
    return [{"event": "stage", "name": stage}, *steps]


def seconds(text):
    found = re.search(r"(?:(\d+) h )?(\d+) (s|min) left", text)
    return (
        None if found is None else (int(found[1] or 0) * 60 + int(found[2])) * (1 if found[3] == "s" else 60)
    )


def test_the_time_left_never_rises_in_a_stage(visitor):
    tab = visitor().tab
    # densification makes iterations slower than the pace of the first ones; one forecast is missing
    forecasts = (50, 40, 42, 90, 100, None, 80, 39, 20, 21, 19, 3)
    shown = tab.evaluate(SHOWN, log("training", *forecasts))[1:]
    assert [seconds(text) for text in shown] == [50, 40, 40, 40, 40, 40, 40, 39, 20, 20, 19, 3]
    # a forecast that is clearly larger makes the figure a least time
    assert ["at least" in text for text in shown] == [i in (3, 4, 5, 6) for i in range(12)]


def test_another_stage_or_attempt_has_a_time_of_its_own(visitor):
    tab = visitor().tab
    events = [
        *log("matching", 10, 5),
        *log("training", 600, 500),
        {"event": "started"},
        *log("training", 700, 650),
    ]
    found = [seconds(text) for text in tab.evaluate(SHOWN, events) if "left" in text]
    assert found == [10, 5, 600, 480, 720, 660]  # minutes are rounded


def test_a_card_says_what_a_training_takes_before_it_starts(visitor, library):
    write_colmap(library[0].library.root / "captures" / "told", *procedural_capture(48, 12, splats=120))
    tab = visitor().tab
    card = tab.get_by_role("article", name="told")
    for scheme in ("light", "dark"):  # the button waits for the press that starts it
        tab.emulate_media(color_scheme=scheme)
        card.get_by_role("button", name="Next: Start training, told").click()
        card.get_by_text(
            re.compile(r"^It takes about .* of memory; [\d,]+ iterations, up to [\d,]+ splats")
        ).wait_for()
        assert card.locator(".primary").count() == 1
        assert not library[0].queue.jobs()
        if scheme == "light":
            assert grave_faults_in_all_styles(tab) == []
            card.get_by_role("button", name="Not now").click()
            assert not card.locator(".forecast").is_visible()
    with waiting(library[0]):
        card.get_by_role("button", name="Next: Start it, told").click()
        tab.wait_for_url(re.compile("#/runs/told"))
        (job,) = library[0].queue.jobs()
    assert job.work.options == {"quality": "standard"} and job.work.inputs == ("captures/told",)
