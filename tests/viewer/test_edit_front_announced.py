"""The editor says that it measures the visible surface of a large scene before it does."""

from gestures import drag
from viewer.handles import until

WATCH = """() => {
  window.painted = [];
  const measures = editor.tools.frontOf.bind(editor.tools);
  const note = () => {
    const text = document.getElementById("edit-message").textContent;
    if (text && !window.measured) window.painted.push(text);
    if (!window.measured) requestAnimationFrame(note);
  };
  requestAnimationFrame(note);
  editor.tools.frontOf = (...args) => {
    window.measured = true;
    return measures(...args);
  };
}"""


def test_a_line_is_shown_before_a_large_front_is_measured(edit_page, random_gaussians):
    shown = edit_page(random_gaussians(50_000, rest=0))
    shown.evaluate(WATCH)
    shown.evaluate("editor.chooseFront(true)")
    shown.choose("rectangle")
    drag(shown.tab, (300, 250), (420, 380))
    until(shown.tab, "editor.history.done.length > 0")
    assert shown.evaluate("painted.at(-1)") == "Measuring the visible surface ..."
    assert shown.tab.inner_text("#edit-message") == ""
    (operation,) = shown.edits().operations
    assert operation.region.front is not None and "selected" in shown.tab.inner_text("#edit-count")
