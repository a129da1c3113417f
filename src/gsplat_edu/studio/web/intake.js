// Takes in photos, folders, zip files, videos and scenes: dropped, chosen, or named by their path.

import { filesOf } from "../../viewer/web/dropped.js";
import { at, post, remove, upload } from "./api.js";
import { announce, attempt, bytes, button, count, dateOf, errorLine, h, heading } from "./dom.js";

const AT_ONCE = 3;
const SCENES = /\.(ply|k?splat|spz|sog|glb|usd[acz]|rad|csv)$/i;
const VIDEOS = /\.(mp4|mov|m4v|avi|mkv|webm|mts|m2ts|mpg|mpeg|3gp|wmv)$/i; // a browser does not know the type of each
const IGNORED = /(?:^|\/)(?:\.[^/]*|Thumbs\.db|desktop\.ini)$/i;
const HEAD = 1 << 18; // bytes at the start of a photo in which its EXIF data lie
const TAKEN = /((?:19|20)\d\d):(0[1-9]|1[0-2]):(0[1-9]|[12]\d|3[01]) \d\d:\d\d:\d\d\0/g; // a date of EXIF, in every format

const isPhotoOrVideo = ({ file, path }) => /^(?:image|video)\//.test(file.type) || VIDEOS.test(path);

// The day on which a photo was taken: the earliest date in its EXIF data, which a program that changed it later has not
// replaced; else that of its file.
export async function dayOf(file) {
  const text = new TextDecoder("latin1").decode(await file.slice(0, HEAD).arrayBuffer());
  const [first] = [...text.matchAll(TAKEN)].sort(([one], [other]) => (one < other ? -1 : 1));
  return first ? new Date(first[1], first[2] - 1, first[3]) : new Date(file.lastModified);
}

// A name for photos that have no folder to be named after.
export async function namedByDay(files) {
  const byName = files.toSorted((one, other) => one.path.localeCompare(other.path, "en", { numeric: true }));
  return `Photos of ${dateOf(await dayOf(byName[0].file))}`;
}

// Splits files into entries to make: {kind, name, files: [{file, path}], zip, unsettled}. Files beside photos may be the
// poses of any program: the studio decides, once they are there, whether that is a capture or only photos.
async function sorted(files, wanted) {
  const groups = new Map();
  for (const { file, path } of files) {
    if (IGNORED.test(path)) continue;
    const inFolder = path.includes("/");
    const isTable = /\.csv$/i.test(path) && files.length > 1; // the poses of the photos beside it, not a scene
    const single = !inFolder && (/\.zip$/i.test(path) || (SCENES.test(path) && !isTable));
    const top = inFolder ? path.slice(0, path.indexOf("/")) : single ? path : "";
    const rest = inFolder ? path.slice(top.length + 1) : path;
    if (!groups.has(top)) groups.set(top, { top, single, files: [] });
    groups.get(top).files.push({ file, path: rest });
  }
  const found = [];
  for (const { top, single, files: own } of groups.values()) {
    const zip = single && /\.zip$/i.test(top);
    let kind = "photos";
    if (single && !zip) kind = "scenes";
    else if (wanted !== "auto") kind = wanted;
    else if (zip || !own.every(isPhotoOrVideo)) kind = "captures";
    const unsettled = wanted === "auto" && kind === "captures";
    const video = !top && own.length === 1 && VIDEOS.test(own[0].path);
    const stem = single || video ? own[0].path.replace(/\.[^.]+$/, "") : top;
    found.push({ kind, name: stem || (await namedByDay(own)), files: own, zip, unsettled });
  }
  return found;
}

// A name for a new entry that no other tab gets. The studio makes it; it changes what a name may not have.
const promised = async (kind, wish) => (await post("/api/names", { kind, wish })).name;

// One upload of many files: its progress, and the files that were refused.
class Batch {
  constructor(store, { kind, name, files, zip, unsettled }) {
    Object.assign(this, { store, kind, name, files, zip, sent: new Map(), refused: 0 });
    this.stopping = new AbortController();
    this.total = files.reduce((sum, { file }) => sum + file.size, 0);
    this.bar = h("progress", { max: Math.max(1, this.total), value: 0, "aria-label": `upload of ${name}` });
    this.text = h("span", { class: "left" });
    this.errors = h("ul", { class: "errors", "aria-label": "files that were not taken in" });
    this.stop = button("Stop", () => this.stopping.abort());
    this.element = h(
      "article",
      { class: "job card" },
      heading(3, unsettled ? name : `${kind}/${name}`),
      h("div", { class: "progress" }, this.bar, this.text, this.stop),
      this.errors,
    );
  }

  show(done) {
    const bytesSent = [...this.sent.values()].reduce((sum, some) => sum + some, 0);
    this.bar.value = Math.min(bytesSent, this.total);
    this.text.textContent = `${bytes(bytesSent)} of ${bytes(this.total)}, ${done} of ${count(this.files.length, "file")}`;
  }

  refuse(name, error) {
    this.refused += 1;
    const base = name.split("/").at(-1); // some of the server's sentences begin with it
    const repeated = [`'${base}' `, `“${base}” `].find((start) => error.message.startsWith(start)) ?? "";
    const what = error.message.slice(repeated.length);
    this.errors.append(h("li", { class: "error" }, h("strong", {}, name), ": ", what));
  }

  async one({ file, path }) {
    const limits = this.store.library?.limits;
    try {
      if (limits && file.size > limits.file_bytes) {
        throw new Error(`has ${bytes(file.size)}, but a file may have ${bytes(limits.file_bytes)}`);
      }
      const address = this.zip ? at(this.kind, this.name, "zip") : at(this.kind, this.name, "files", path);
      const answer = await upload(address, file, (some) => this.note(file, some), this.stopping.signal);
      this.note(file, file.size);
      this.leaveOut(answer.left_out ?? []);
      return true;
    } catch (error) {
      if (!this.stopping.signal.aborted) this.refuse(path, error);
      return false;
    }
  }

  leaveOut(names) {
    for (const name of names) this.refuse(name, new Error("left out: neither a photo nor a video"));
  }

  note(file, some) {
    this.sent.set(file, Math.min(some, file.size));
    this.show(this.done);
  }

  // Resolves to the number of files that were taken in.
  async run() {
    this.done = 0;
    let next = 0;
    this.show(0);
    const work = async () => {
      while (next < this.files.length && !this.stopping.signal.aborted) {
        if (await this.one(this.files[next++])) this.done += 1;
        this.show(this.done);
      }
    };
    await Promise.all(Array.from({ length: this.zip ? 1 : AT_ONCE }, work));
    this.stop.hidden = true;
    announce(`${this.name}: ${count(this.done, "file")} taken in, ${this.refused} refused`);
    return this.done;
  }
}

let uploading = 0;
addEventListener("beforeunload", (event) => {
  if (uploading) event.preventDefault();
});

// How files come in: chosen here, or dropped anywhere, which calls take(transfer). `into` is an entry {kind, name} that files
// are added to; null makes new ones. began() is called once something comes in.
export function intake(store, into = null) {
  const line = errorLine();
  const batches = h("div", { class: "batches" });
  const kind = h(
    "select",
    { id: "take-as" },
    h("option", { value: "auto" }, "what they look like"),
    h("option", { value: "photos" }, "photos without poses"),
    h("option", { value: "captures" }, "a capture: photos with poses"),
  );
  const made = { began: () => {}, progress: h("div", { class: "coming" }, line, batches) };

  async function taken(files) {
    const groups = into ? [{ ...into, files, zip: false }] : await sorted(files, kind.value);
    if (!groups.some((group) => group.files.length)) throw new Error("What was dropped holds no files.");
    made.began();
    let landed = null;
    for (const group of groups) {
      if (!into) group.name = await promised(group.kind, group.name);
      const batch = new Batch(store, group);
      batches.append(batch.element);
      uploading += 1;
      const coming = `${group.kind}/${group.name}`;
      if (group.unsettled) store.arriving.add(coming);
      const done = await batch.run().finally(() => (uploading -= 1));
      if (!into && !done) await remove(at("names", group.kind, group.name)).catch(() => {}); // nobody waits for it
      try {
        if (done && group.unsettled) {
          const settled = await post(at("captures", group.name, "settle"), {});
          group.kind = settled.entry.split("/")[0];
          batch.leaveOut(settled.left_out);
        }
      } finally {
        await store.refresh();
        if (store.arriving.delete(coming)) store.changed(); // no earlier: an older list still has its former kind
      }
      if (done && !batch.refused) batch.element.remove();
      if (done && !batch.refused) landed ??= `#/${group.kind}/${encodeURIComponent(group.name)}`;
    }
    // with one entry and nothing refused, the next step is there
    if (!into && landed && groups.length === 1 && batches.isConnected) location.hash = landed;
  }

  const choose = (more, text, attributes) => {
    const input = h("input", {
      type: "file",
      multiple: true,
      hidden: true,
      ...more,
      onchange: () => {
        const files = [...input.files].map((file) => ({ file, path: file.webkitRelativePath || file.name }));
        input.value = "";
        attempt(null, line, () => taken(files));
      },
    });
    return [input, button(text, () => input.click(), attributes)];
  };

  made.take = (transfer) => {
    const files = filesOf(transfer); // what was dropped is gone once the event has ended
    return attempt(null, line, async () => taken(await files));
  };
  made.element = h(
    "section",
    { class: into ? "drop row" : "drop empty", "aria-label": into ? "Add photos" : "Add photos, a video or a scene" },
    into ? h("p", {}, "Drop more photos anywhere, or") : h("p", { class: "hint" }, "Drop photos anywhere"),
    into ? null : h("p", { class: "quiet" }, "A folder, a zip file, a video or a finished scene will do, too."),
    h(
      "div",
      { class: "row" },
      choose({}, "Choose files", { "data-key-u": "", class: into ? null : "primary" }),
      into ? null : choose({ webkitdirectory: true }, "Choose a folder"),
    ),
    into
      ? null
      : h(
          "details",
          {},
          h("summary", {}, "Other ways"),
          h("p", { class: "row" }, h("label", { for: "take-as" }, "Take them in as "), kind),
          pathForm(store, made),
        ),
  );
  return made;
}

// Uses a folder or file of this computer where it is.
function pathForm(store, made) {
  const line = errorLine();
  const path = h("input", { id: "path", type: "text", required: true, autocomplete: "off", spellcheck: "false" });
  const kind = h(
    "select",
    { id: "path-kind" },
    ["photos", "captures", "runs", "scenes"].map((name) => h("option", { value: name }, name)),
  );
  const add = h("button", {}, "Add");
  const form = h(
    "form",
    {
      class: "row",
      onsubmit: (event) => {
        event.preventDefault();
        attempt(add, line, async () => {
          const adopted = await post("/api/adopt", { kind: kind.value, path: path.value });
          await store.refresh();
          made.began();
          location.hash = `#/${adopted.kind}/${encodeURIComponent(adopted.name)}`;
        });
      },
    },
    h("label", { for: "path" }, "Path of the folder or file"),
    path,
    h("label", { for: "path-kind" }, "It holds"),
    kind,
    add,
  );
  return h("div", {}, h("h3", {}, "Use a folder on this computer without copying it"), form, line);
}
