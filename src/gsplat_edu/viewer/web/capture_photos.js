// Photos from the server, on demand, and what the page changes in the capture: photos to leave out, and the region.

const MOST_KEPT = 200; // photos in memory

export class Photos {
  constructor() {
    this.known = new Map(); // addresses of photos in memory, oldest first
  }

  // Resolves with the address of a photo in memory; rejects with the reason why there is none.
  load(name, side) {
    const key = `${side} ${name}`;
    let found = this.known.get(key);
    this.known.delete(key);
    found ??= this.fetched(name, side);
    this.known.set(key, found);
    found.catch(() => this.known.delete(key));
    if (this.known.size > MOST_KEPT) {
      const [[oldest, address]] = this.known;
      this.known.delete(oldest);
      address.then(
        (url) => URL.revokeObjectURL(url),
        () => {},
      );
    }
    return found;
  }

  async fetched(name, side) {
    const answer = await fetch(`thumbs/${name.split("/").map(encodeURIComponent).join("/")}?side=${side}`).catch(
      () => null,
    );
    if (!answer) throw new Error("The server of this page has ended.");
    if (!answer.ok) throw new Error(await reasonOf(answer));
    return URL.createObjectURL(await answer.blob());
  }

  // Leaves a photo out, or takes it back; resolves with the names of all that are left out.
  async leaveOut(name, back) {
    return (await answered("left-out", { photos: [name], back })).left_out;
  }

  // The capture's region of interest; null if it has none.
  async region() {
    const answer = await fetch("region").catch(() => null);
    if (!answer) throw new Error("The server of this page has ended.");
    if (!answer.ok) throw new Error(await reasonOf(answer));
    return (await answer.json()).region;
  }

  // Saves the capture's region of interest, a box in the capture's coordinates; null removes it.
  async saveRegion(region) {
    await answered("region", { region });
  }
}

// What the server answers to a change; rejects with its reason if it refuses.
async function answered(address, body) {
  const headers = { "Content-Type": "application/json" };
  const answer = await fetch(address, { method: "POST", headers, body: JSON.stringify(body) }).catch(() => null);
  if (!answer) throw new Error("The server of this page has ended.");
  if (!answer.ok) throw new Error(await reasonOf(answer));
  return answer.json();
}

// The line in which a server says why it refuses: text, or JSON in the studio.
async function reasonOf(answer) {
  const text = (await answer.text()).trim();
  try {
    return JSON.parse(text).error ?? text;
  } catch {
    return text || `The server answered with status ${answer.status}.`;
  }
}
