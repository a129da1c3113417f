"""The editor says that it measures the visible surface of a large scene before it does."""

from gsplat_edu.edits.document import parse_edits
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
    tab = shown.tab
    tab.evaluate(WATCH)
    tab.evaluate("editor.chooseFront(true)")
    tab.click("[data-tool=rectangle]")
    tab.mouse.move(300, 250)
    tab.mouse.down()
    tab.mouse.move(420, 380)
    tab.mouse.up()
    until(tab, "editor.history.done.length > 0")
    assert tab.evaluate("painted.at(-1)") == "Measuring the visible surface ..."
    assert tab.inner_text("#edit-message") == ""
    (operation,) = parse_edits(tab.evaluate("editor.text()").encode(), "edits.json").operations
    assert operation.region.front is not None and "selected" in tab.inner_text("#edit-count")
