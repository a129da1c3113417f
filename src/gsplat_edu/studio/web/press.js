// Changes of the page wait while something is pressed: a button that is moved or replaced between press and release is
// not clicked.

const CONTROL = "button, a, summary, label, input, select, textarea";
const CLICKED = "button, a, summary, label, [type=checkbox], [type=radio]"; // not what is dragged, or opens a list
const ENDS = ["pointerup", "pointercancel", "pointermove", "keyup", "blur"];

let pressed = null; // resolves once it is released

function press({ target }) {
  if (pressed || !target.closest?.(CONTROL)?.matches(CLICKED)) return;
  let end;
  pressed = new Promise((resolve) => (end = resolve));
  const release = () => {
    pressed = null;
    end();
  };
  // A release outside the window is noticed when the pointer comes back, or when the window loses the focus.
  const look = ({ type, buttons }) => {
    if (type === "pointermove" && buttons) return;
    for (const one of ENDS) removeEventListener(one, look);
    setTimeout(release); // the click comes in between
  };
  for (const one of ENDS) addEventListener(one, look);
}

addEventListener("pointerdown", (event) => event.isPrimary && event.button === 0 && press(event), true);
addEventListener("keydown", (event) => event.key === " " && press(event), true);

// Resolves once nothing is pressed.
export async function released() {
  while (pressed) await pressed;
}
