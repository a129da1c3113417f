"""The longest texts that a job can show fit the page on every screen."""

import pytest

from waiting import resize

WIDTHS = (320, 390, 768, 1280, 1440)

LONG = {
    "words": " ".join(["a rather long sentence about what is being done"] * 6),
    "one word": "w" * 300,
}
"""Texts of the length that a record allows, with places for a break and without."""

CARDS = """async ([text, left]) => {
  const [{ jobCard }, { Store }] = await Promise.all([import("/web/jobs.js"), import("/web/store.js")]);
  const store = new Store();
  const work = { command: "train", inputs: ["captures/a"], outputs: ["runs/a"], options: {} };
  const job = { title: text, subject: "runs/a", command: `gsplat-edu ${text}`, line: "", waits_for: [], work };
  const waits = [{ job: "000001", place: text }];
  const states = ["running", "paused", "queued", "failed", "cancelled", "interrupted", "held", "done"];
  const cards = states.map((state, index) => {
    const id = String(index + 1).padStart(6, "0");
    const [line, waits_for] = [/ed$/.test(state) ? text : "", state === "queued" ? waits : []];
    const view = store.put({ ...job, id, state, line, waits_for });
    const events = [
      { event: "stage", name: "reading photos" },
      { event: "stage", name: text },
      { event: "message", text },
      { event: "progress", stage: text, done: 19, total: 100, seconds_left: left / 2 },
      { event: "progress", stage: text, done: 19, total: 100, seconds_left: left },
    ];
    events.forEach((event, number) => view.take({ ...event, number: number + 1 }));
    const card = jobCard(store, id);
    card.update();
    return card.element;
  });
  const side = document.createElement("div");
  side.className = "right-side";
  side.append(...cards);
  const watch = document.createElement("div");
  watch.className = "watch";
  watch.append(document.createElement("div"), side);
  document.getElementById("main").replaceChildren(watch);
}"""
"""Fills the page with the cards of jobs of every state, whose every text is long, beside a scene."""

OUTSIDE = """[...document.querySelectorAll(".job *")].filter((one) => {
  if (!one.checkVisibility() || one.closest("details:not([open]) > :not(summary)")) return false;
  const [own, card] = [one.getBoundingClientRect(), one.closest(".job").getBoundingClientRect()];
  return own.left < card.left - 0.5 || own.right > card.right + 0.5;
}).map((one) => `${one.tagName}.${one.className}`)"""
"""What reaches beyond its card."""


@pytest.mark.parametrize("kind", LONG)
@pytest.mark.parametrize("left", [57, 356_400])
def test_the_longest_texts_of_a_job_stay_in_its_card_and_never_scroll_the_page(visitor, kind, left):
    tab = visitor().tab
    tab.evaluate(CARDS, [LONG[kind], left])
    assert "at least" in tab.locator(".job .left").first.inner_text()
    for width in WIDTHS:
        resize(tab, width, 800)
        assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth"), width
        assert tab.evaluate(OUTSIDE) == [], width
        cut = "(one) => one.scrollWidth > one.clientWidth && getComputedStyle(one).overflow === 'hidden'"
        assert tab.evaluate(f"[...document.querySelectorAll('.job .left')].filter({cut}).length") == 0
