// The studio's API; docs/STUDIO.md describes it. Errors have the line that the server gives.

export class ApiError extends Error {
  constructor(line, status) {
    super(line);
    this.status = status;
  }
}

let start = ""; // the command that starts the studio again, which only the studio knows
const BUSY = { most: 90, pause: 2000 }; // questions and milliseconds between them until it is too busy: three minutes
const LOCKED = "The studio was started again. Open the address that it printed last in its terminal.";

export const startsBy = (command) => (start = command);

// What to do while the studio does not answer.
export const gone = () => {
  const how = start ? `this command and open the address that it prints: ${start}` : "the same command as before.";
  return `The studio does not answer. If it has ended, start it again in a terminal with ${how}`;
};

// "captures/NAME" or parts of a path as an address.
export const at = (...parts) => `/api/${parts.join("/").split("/").map(encodeURIComponent).join("/")}`;

const lineOf = (status, text) => {
  if (status === 403) return text.includes("token") ? LOCKED : text.trim();
  try {
    const { plain, error } = JSON.parse(text);
    return plain ?? error;
  } catch {
    return text.trim().split("\n")[0] || `The studio answered ${status}.`;
  }
};

async function ask(method, address, body) {
  const given =
    body === undefined ? {} : { body: JSON.stringify(body), headers: { "Content-Type": "application/json" } };
  const answer = await fetch(address, { method, ...given }).catch(() => {
    throw new ApiError(gone(), 0);
  });
  const isJson = (answer.headers.get("content-type") ?? "").startsWith("application/json");
  const text = method === "HEAD" && isJson ? await fetch(address).then((other) => other.text()) : await answer.text();
  if (!answer.ok) throw new ApiError(lineOf(answer.status, text), answer.status);
  return isJson && text ? JSON.parse(text) : text;
}

// Asks again while the studio is busy with other questions, which can have a line of them wait.
export async function get(address) {
  for (let left = BUSY.most; ; left--) {
    try {
      return await ask("GET", address);
    } catch (error) {
      if (error.status !== 503 || !left) throw error;
    }
    await new Promise((resolve) => setTimeout(resolve, BUSY.pause));
  }
}

// For what may not be there yet: a refusal throws the same error, but the browser's console stays empty.
async function quietly(method, address) {
  const found = await ask(method, `${address}${address.includes("?") ? "&" : "?"}quiet=1`).catch((error) => {
    if (error instanceof SyntaxError) return ""; // it has come in between, and is no JSON
    throw error;
  });
  if (typeof found?.error === "string") throw new ApiError(found.plain ?? found.error, found.status);
  return found;
}

export const getQuietly = (address) => quietly("GET", address);
export const head = (address) => quietly("HEAD", address);
export const post = (address, body = {}) => ask("POST", address, body);
export const remove = (address) => ask("DELETE", address);

// Sends a file as it is. progress(bytes) is called while it goes out.
export function upload(address, file, progress, signal) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("PUT", address);
    request.upload.addEventListener("progress", ({ loaded }) => progress(loaded));
    request.addEventListener("load", () => {
      const { status, responseText: text } = request;
      if (status < 300) resolve(JSON.parse(text));
      else reject(new ApiError(lineOf(status, text), status));
    });
    // the server closes the connection when it refuses a file before it has all of it
    request.addEventListener("error", () =>
      reject(new ApiError("The connection closed before the file was received.", 0)),
    );
    request.addEventListener("abort", () => reject(new ApiError("Stopped.", 0)));
    signal.addEventListener("abort", () => request.abort());
    request.send(file);
  });
}
