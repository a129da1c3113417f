"""The renderer of the pages' scripts, on a bare page: what it changes, what it leaves alone, and presses that count."""

import pytest

from gsplat_edu.viewer import modules
from waiting import FRAMES, until_in

CASES = """
const texts = (place) => [...place.children].map((one) => one.textContent).join(" ");
const list = (place, keys) => patch(place, [...keys].map((key) => want("button", { "data-key": key }, key)));
const cases = {
  "children become those that are wanted": (place) => {
    patch(place, "a", want("p", { class: "x", hidden: true, title: null }, "b", [want("b", {}, 1)]), false, null, "");
    return [place.innerHTML, 'a<p class="x" hidden="">b<b>1</b></p>'];
  },
  "the same nodes change": (place) => {
    patch(place, want("p", { class: "x", id: "i" }, "b", want("b", {}, "c")), "d");
    const nodes = () => [...place.childNodes, ...place.firstChild.childNodes];
    const before = nodes();
    patch(place, want("p", { class: "y", title: "t" }, "B", want("b", {}, "C")), "D");
    return [[place.innerHTML, nodes().map((one, i) => one === before[i])],
            ['<p class="y" title="t">B<b>C</b></p>D', [true, true, true, true]]];
  },
  "what nothing describes stays": (place) => {
    const folded = (text) => want("details", { class: "a" }, want("summary", {}, text));
    const show = (text) => patch(place, folded(text), want("input", { value: "1" }));
    show("x");
    const [details, input] = place.children;
    details.open = true;
    details.classList.add("marked");
    input.value = "typed";
    show("y");
    return [[details.open, details.className, input.value, details.textContent], [true, "a marked", "typed", "y"]];
  },
  "a value that is described anew is shown": (place) => {
    const show = (value, checked) =>
      patch(place, want("input", { value }), want("input", { type: "checkbox", checked }));
    show("1", false);
    const [input, box] = place.children;
    [input.value, box.checked] = ["typed", false];
    show("2", true);
    return [[input.value, box.checked], ["2", true]];
  },
  "listeners are taken over": (place) => {
    const heard = [];
    for (const word of ["a", "b"]) patch(place, want("button", { onclick: () => heard.push(word) }, word));
    place.firstChild.click();
    patch(place, want("button", {}, "c"));
    place.firstChild.click();
    return [heard, ["b"]];
  },
  "an element stands for itself": (place) => {
    const [mine, other] = [h("p", {}, "mine"), h("p", {}, "other")];
    patch(place, want("p", {}, "first"), mine);
    mine.append("!");
    patch(place, mine, other, want("p", {}, "second"));
    return [[place.innerHTML, place.firstChild === mine], ["<p>mine!</p><p>other</p><p>second</p>", true]];
  },
  "a key keeps its node, whatever its place": (place) => {
    list(place, "abcd");
    const was = Object.fromEntries([...place.children].map((one) => [one.dataset.key, one]));
    list(place, "xdba");
    return [[texts(place), [...place.children].map((one) => one === was[one.dataset.key])],
            ["x d b a", [false, true, true, true]]];
  },
  "a key of another kind is another node": (place) => {
    patch(place, want("p", { "data-key": "a" }));
    patch(place, want("b", { "data-key": "a" }));
    return [place.innerHTML, '<b data-key="a"></b>'];
  },
  "the focus stays when a list changes": (place) => {
    list(place, "abcd");
    place.children[2].focus();
    const focused = (keys) => (list(place, keys), document.activeElement.textContent);
    return [["bcd", "dcb", "xcdb", "cy", "yzc"].map(focused), ["c", "c", "c", "c", "c"]];
  },
  "as few nodes as possible move": (place) => {
    list(place, "abcdef");
    const watch = new MutationObserver(() => {});
    watch.observe(place, { childList: true });
    list(place, "fabcde");
    const moves = watch.takeRecords().flatMap(({ addedNodes }) => [...addedNodes]).map((one) => one.textContent);
    return [moves, ["f"]];
  },
  "an unchanged place is left alone": (place) => {
    const text = () => want("p", { class: "a" }, "b", want("i", {}, "c"));
    const show = () => patch(place, text(), want("button", { onclick: () => {} }, "d"));
    show();
    const watch = new MutationObserver(() => {});
    watch.observe(place, { childList: true, subtree: true, attributes: true, characterData: true });
    show();
    return [watch.takeRecords().length, 0];
  },
  "a selection within a text stays": (place) => {
    const show = (more) => patch(place, want("p", {}, "some words"), more && want("p", {}, more));
    show("");
    getSelection().setBaseAndExtent(place.firstChild.firstChild, 0, place.firstChild.firstChild, 4);
    show("more");
    return [String(getSelection()), "some"];
  },
  "svg is drawn": (place) => {
    patch(place, want("svg", { viewBox: "0 0 1 1" }, want("path", { d: "M0 0" })));
    return [[place.firstChild.namespaceURI, place.firstChild.firstChild instanceof SVGPathElement],
            ["http://www.w3.org/2000/svg", true]];
  },
  "markup in a text is text": (place) => {
    patch(place, want("p", {}, "<b>x</b>"));
    return [place.textContent, "<b>x</b>"];
  },
};
"""
"""By name, functions of an empty place that return what they found and what is right."""

NAMES = [line.split('"')[1] for line in CASES.splitlines() if line.startswith('  "')]

RUN = """(name) => {
  const place = document.createElement("main");
  document.body.append(place);
  const found = cases[name](place);
  place.remove();
  return found;
}"""

PRESSED = """() => {
  globalThis.clicks = [];
  document.body.innerHTML = '<p id="above"></p><main></main>';
  globalThis.show = (word) => {
    const onclick = ({ currentTarget }) => clicks.push(`${currentTarget.dataset.key} ${word}`);
    const control = (name, more = {}) => want(name, { "data-key": name, onclick, ...more }, `the ${name}`);
    patch(
      document.querySelector("main"),
      want("p", {}, control("button")),
      want("p", {}, control("a", { href: "#there" })),
      want("p", {}, want("label", { "data-key": "label" }, want("input", { type: "checkbox" }), "the label")),
      want("details", {}, want("summary", { "data-key": "summary" }, "the summary"), "inside"),
    );
  };
  show("first");
}"""

STATE = """() => [clicks, document.querySelector("input").checked, document.querySelector("details").open]"""

GROW = "() => (document.querySelector('#above').style.height = '300px')"

DONE = {
    "button": [["button first"], False, False],
    "a": [["a first"], False, False],
    "label": [[], True, False],
    "summary": [[], False, True],
}
"""What a press on each control does."""


@pytest.fixture(scope="module")
def bare(browser):
    """A bare page with the renderer."""
    tab = browser.new_page(has_touch=True)
    tab.set_content("<!doctype html><title>bare</title>")
    tab.add_script_tag(content=modules.script(("patch.js",)) + CASES)
    tab.evaluate("keepPresses()")
    return tab


@pytest.fixture
def tab(bare):
    """The bare page with a control of each kind."""
    bare.evaluate(PRESSED)
    return bare


@pytest.mark.parametrize("name", NAMES)
def test_the_renderer(bare, name):
    found, right = bare.evaluate(RUN, name)
    assert found == right


def middle(tab, name):
    box = tab.locator(f"[data-key={name}]").bounding_box()
    return box["x"] + 20, box["y"] + box["height"] / 2


@pytest.mark.parametrize("name", DONE)
def test_a_press_counts_although_the_control_moves_away_meanwhile(tab, name):
    tab.mouse.move(*middle(tab, name))
    tab.mouse.down()
    tab.evaluate(GROW)
    tab.evaluate(FRAMES)
    tab.mouse.up()
    assert tab.evaluate(STATE) == DONE[name]


@pytest.mark.parametrize("name", DONE)
def test_a_finger_s_press_counts_although_the_control_moves_away_meanwhile(tab, name):
    x, y = middle(tab, name)
    session = tab.context.new_cdp_session(tab)
    session.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [{"x": x, "y": y}]})
    tab.evaluate(GROW)
    tab.evaluate(FRAMES)
    tab.evaluate(
        "addEventListener('click', () => { globalThis.clicked = true; }, { once: true, capture: true })"
    )
    session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    until_in(tab, tab, "globalThis.clicked")
    assert tab.evaluate(STATE) == DONE[name]


@pytest.mark.parametrize("name", DONE)
def test_a_release_beside_the_control_is_no_click(tab, name):
    x, y = middle(tab, name)
    tab.mouse.move(x, y)
    tab.mouse.down()
    tab.mouse.move(x + 300, y + 200)
    tab.mouse.up()
    assert tab.evaluate(STATE) == [[], False, False]
    tab.mouse.click(x, y)
    assert tab.evaluate(STATE) == DONE[name], "and the next press counts"


def test_a_release_on_the_control_where_it_is_now_is_a_click(tab):
    tab.mouse.move(*middle(tab, "button"))
    tab.mouse.down()
    tab.evaluate(GROW)
    tab.mouse.move(*middle(tab, "button"))
    tab.mouse.up()
    assert tab.evaluate(STATE) == DONE["button"]


@pytest.mark.parametrize("by", ["mouse", "keyboard"])
def test_a_press_does_what_the_control_did_when_it_was_pressed(tab, by):
    tab.mouse.move(*middle(tab, "button"))
    tab.focus("button")
    tab.mouse.down() if by == "mouse" else tab.keyboard.down(" ")
    tab.evaluate("show('second')")
    tab.mouse.up() if by == "mouse" else tab.keyboard.up(" ")
    assert tab.evaluate("clicks") == ["button first"]
    for again in (lambda: tab.keyboard.press("Enter"), lambda: tab.click("button")):
        again()
    assert tab.evaluate("clicks") == ["button first", "button second", "button second"]


def test_a_pressed_control_is_not_moved_in_its_list(tab):
    tab.evaluate("list(document.querySelector('main'), 'abc')")
    tab.mouse.move(*middle(tab, "a"))
    tab.mouse.down()
    held = tab.locator("[data-key=a]").element_handle()
    moved = tab.evaluate("""() => {
      const watch = new MutationObserver(() => {});
      watch.observe(document.querySelector("main"), { childList: true });
      list(document.querySelector("main"), "bca");
      return watch.takeRecords().flatMap(({ removedNodes }) => [...removedNodes]).map((one) => one.textContent);
    }""")
    assert sorted(moved) == ["b", "c"]
    assert held.evaluate("(button) => button.matches(':active')")
    tab.mouse.up()
