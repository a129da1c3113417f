// What the entries of the library are, in a few words.

import { bytes, count, whole } from "./dom.js";

export const KINDS = { photos: "Photos", captures: "Cameras", runs: "Training", scenes: "Scene" };

export const addressOf = ({ kind, name }) => `#/${kind}/${encodeURIComponent(name)}`;

// What an entry is, in a few words.
export function factsOf(entry) {
  const { kind } = entry;
  if (kind === "photos" || kind === "captures") {
    const videos = entry.videos ? count(entry.videos, "video") : "";
    const photos = entry.photos || !videos ? count(entry.photos, "photo") : "";
    if (entry.unfinished) return [bytes(entry.bytes)];
    return [
      photos,
      videos,
      kind === "captures" ? searchOf(entry) || entry.layout || "not placed" : "",
      bytes(entry.bytes),
    ];
  }
  if (kind === "scenes") return [entry.file ? entry.file.split(".").at(-1) : "no scene file", bytes(entry.scene_bytes)];
  const done = entry.iterations ?? 0;
  return [
    entry.training
      ? "in training"
      : entry.finished
        ? `${whole(done)} iterations`
        : entry.planned
          ? `${whole(done)} of ${whole(entry.planned)} iterations`
          : "no iterations yet",
    entry.verdict?.grade ?? "",
    entry.edited ? "edited" : "",
  ];
}

// How many photos of a capture were placed; empty if their poses come from another program.
export function searchOf({ search }) {
  if (!search) return "";
  return search.photos === null ? "" : `${whole(search.posed)} of ${count(search.photos, "photo")} placed`;
}

// The state of the newest job of an entry that somebody has to know of, or what is wrong with the entry; else "".
export function stateOf(store, entry) {
  const job = store.jobsOf(entry.entry)[0];
  if (job && (job.active || ["held", "failed", "interrupted"].includes(job.job.state))) return job.job.state;
  if (entry.problem) return "damaged";
  if (entry.unfinished) return "unfinished";
  return "";
}
