// Groups of splats that the server proposes to delete, each with its reason; absent in a page without a server.

import { element } from "./common.js";
import { patch, want } from "./patch.js";

const ASK_EVERY = 500; // ms between questions to the server

export const FLOATERS_PANEL = `
<div id="edit-floaters" role="group" aria-label="proposed floaters" hidden>
<p class="row"><button data-do="propose" title="Judge the scene, by its photos where there are some">propose floaters</button>
<button data-do="stop-proposing" hidden>stop</button>
<progress id="edit-judged" aria-label="judged" hidden></progress></p>
<p id="edit-proposed" role="status"></p>
<ol id="edit-groups"></ol>
</div>`;

export class EditFloaters {
  // Shows what has been proposed before, or is being judged.
  constructor(editor, panel) {
    Object.assign(this, { editor, panel, url: editor.scene.floaters, timer: 0, questions: 0 });
    if (!this.url) return;
    element("edit-floaters").hidden = false;
    this.ask("GET", true);
  }

  propose() {
    return this.ask("POST");
  }

  stop() {
    return this.ask("DELETE");
  }

  // Sends a request and shows the answer. quiet: whether a failure is not shown.
  async ask(method, quiet = false) {
    clearTimeout(this.timer);
    const question = ++this.questions;
    let said = null;
    try {
      const answer = await fetch(this.url, { method }).catch(() => {
        throw new Error("The program that served this page has ended.");
      });
      const text = await answer.text();
      const found = text.startsWith("{") ? JSON.parse(text) : { error: text.trim() };
      if (!answer.ok) throw new Error(found.error);
      said = found;
    } catch (error) {
      said = { state: "failed", error: quiet ? "" : error.message };
    }
    if (question === this.questions) this.show(said); // an answer to an earlier question is older
  }

  show({ state, done, total, groups = [], basis = "", error = "" }) {
    const running = state === "running";
    const [button, stop, bar] = [
      this.panel.button("propose"),
      this.panel.button("stop-proposing"),
      element("edit-judged"),
    ];
    const focused = [button, stop].includes(document.activeElement);
    button.disabled = running;
    stop.hidden = bar.hidden = !running;
    if (focused) (running ? stop : button).focus(); // a disabled or hidden button loses the focus
    if (total) [bar.max, bar.value] = [total, done];
    else bar.removeAttribute("value");
    const nothing = state === "done" && !groups.length ? "No splat is proposed. " : "";
    element("edit-proposed").textContent = running ? "judging ..." : error || nothing + basis;
    patch(
      element("edit-groups"),
      groups.map((group) => this.row(group)),
    );
    if (running) this.timer = setTimeout(() => this.ask("GET"), ASK_EVERY);
  }

  row({ reason, runs }) {
    const count = runs.reduce((sum, x, k) => sum + (k % 2 ? x : 0), 0);
    const onclick = () => this.editor.perform({ op: "select", how: this.editor.how, by: "list", reason, runs });
    return want("li", {}, want("button", { onclick }, `${count.toLocaleString("en")} · ${reason}`));
  }
}
