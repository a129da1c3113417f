// What arrives by itself waits while something is pressed: a button that moves or is replaced between press and release is
// not clicked. The studio's page imports this module too.

const CONTROL = "button, a, summary, label, input, select, textarea";
const PRESSABLE = "button, a, summary, label, [type=checkbox], [type=radio]"; // not what is dragged, or opens a list
const RELEASES = ["pointerup", "pointercancel", "pointermove", "keyup", "blur"];
const FINGER = 100; // milliseconds; the click of a finger comes after its release, that of a mouse together with it

let pressing = null; // resolves once what is pressed is released

function holdChanges({ target }) {
  if (pressing || !target.closest?.(CONTROL)?.matches(PRESSABLE)) return;
  let end;
  pressing = new Promise((resolve) => (end = resolve));
  const release = () => {
    pressing = null;
    end();
  };
  // A release outside the window is noticed when the pointer comes back, or when the window loses the focus.
  const look = ({ type, buttons, pointerType, target: at }) => {
    if ((type === "pointermove" && buttons) || (type === "blur" && at !== window)) return;
    for (const one of RELEASES) removeEventListener(one, look, true);
    setTimeout(release, pointerType === "touch" ? FINGER : 0);
  };
  for (const one of RELEASES) addEventListener(one, look, true);
}

addEventListener("pointerdown", (event) => event.isPrimary && event.button === 0 && holdChanges(event), true);
addEventListener("keydown", (event) => event.key === " " && holdChanges(event), true);

// Resolves once nothing is pressed.
export async function released() {
  while (pressing) await pressing;
}
