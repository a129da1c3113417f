// Opens the editor in a page that `view --edit` serves.

import { startEditor } from "./edit.js";
import { FACTS } from "./facts.js";
import { inflated } from "./scene.js";

// The exact parameters that the page's splats lack: sh0, then the logits of the opacities.
async function unpackValues(count) {
  const bytes = await inflated(document.querySelectorAll("script.values"), 16 * count);
  return {
    sh0: new Float32Array(bytes.buffer, 0, 3 * count),
    logits: new Float32Array(bytes.buffer, 12 * count, count),
  };
}

// Reads the edits file from the server, and writes it; its version tells whether another tab has written it.
class EditFile {
  constructor(url) {
    this.url = url;
    this.version = "";
  }

  async read() {
    const answer = await fetch(this.url);
    if (!answer.ok) throw new Error((await answer.text()).trim());
    this.version = answer.headers.get("ETag");
    return answer.json();
  }

  async write(text) {
    const answer = await fetch(this.url, { method: "PUT", body: text, headers: { "If-Match": this.version } }).catch(
      () => {
        throw new Error("The program that served this page has ended; download the edits instead.");
      },
    );
    if (!answer.ok) throw new Error((await answer.text()).trim());
    this.version = answer.headers.get("ETag");
  }
}

addEventListener("viewer", async ({ detail: { viewer, splats } }) => {
  const { scene, file, commands, url, floaters, subject } = FACTS.edit;
  const { means, log_scales, quats } = splats;
  const values = { count: FACTS.count, means, log_scales, quats, ...(await unpackValues(FACTS.count)) };
  const stored = url && new EditFile(url);
  const edits = stored ? await stored.read() : null;
  window.editor = startEditor({
    viewer,
    scene: { ...scene, values, file, commands, floaters, subject },
    edits,
    save: stored && ((text) => stored.write(text)),
  });
});
