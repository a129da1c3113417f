// The state of every splat after a list of operations, as gsplat_edu/edits/apply.py computes it, with undo and redo.

import { EditWork } from "./edit_cells.js";
import { DELETED, HIDDEN, SELECTED } from "./edit_flags.js";
import { boxMembers, members } from "./edit_member.js";
import { Motion } from "./edit_move.js";
import { applyNear } from "./edit_near.js";

const UNDO_BYTES = 128 << 20; // changes remembered for undo; older operations are undone by repeating those before

// Applies one operation to the states, in place; returns what undoes a move of splats. Throws an Error, before anything is changed, if the work is too much.
export function applyOperation(operation, values, flags, work) {
  const change = (next) => {
    if (operation.op !== "crop") work.add(flags.length);
    for (let i = 0; i < flags.length; ++i) flags[i] = next(flags[i], i);
  };
  switch (operation.op) {
    case "select":
      return applySelect(operation.how, members(operation, values, work), flags);
    case "deselect":
      return change((flag) => (flag === SELECTED ? 0 : flag));
    case "invert":
      return change((flag) => (flag <= SELECTED ? flag ^ SELECTED : flag));
    case "grow":
    case "shrink":
      return applyNear(operation, values, flags, work);
    case "delete":
      return change((flag) => (flag === SELECTED ? DELETED : flag));
    case "hide":
      return change((flag) => (flag === SELECTED ? HIDDEN : flag));
    case "show":
      return change((flag) => (flag === HIDDEN ? 0 : flag));
    case "move":
      work.add(flags.length);
      return (values.motion ??= new Motion(values)).apply(operation, flags);
    case "crop": {
      work.add(flags.length);
      const inside = boxMembers(operation, values);
      return change((flag, i) => (inside[i] ? flag : DELETED));
    }
  }
}

function applySelect(how, inside, flags) {
  for (let i = 0; i < flags.length; ++i) {
    const flag = flags[i];
    if (flag > SELECTED) continue;
    if (how === "replace") flags[i] = inside[i];
    else if (how === "add") flags[i] = flag | inside[i];
    else if (how === "subtract") flags[i] = flag & ~inside[i];
    else flags[i] = flag & inside[i];
  }
}

export class EditHistory {
  // values: as for members(). operations: those of the opened file.
  constructor(values, operations) {
    this.values = values;
    this.flags = new Uint8Array(values.count);
    this.done = [];
    this.undone = [];
    this.work = new EditWork();
    this.tests = []; // of each operation done
    this.changes = []; // of each operation done: which splats had another state before, and which; null if forgotten
    this.bytes = 0;
    for (const operation of operations) this.step(operation);
  }

  // Applies a new operation; what was undone before is forgotten. Throws an Error if it takes too much work.
  perform(operation) {
    this.step(operation);
    this.undone = [];
  }

  step(operation) {
    const before = this.flags.slice();
    const { left } = this.work;
    let moved;
    try {
      moved = applyOperation(operation, this.values, this.flags, this.work);
    } catch (error) {
      this.work.left = left;
      throw error;
    }
    this.tests.push(left - this.work.left);
    this.done.push(operation);
    this.remember(before, moved);
  }

  remember(before, moved = null) {
    let count = 0;
    for (let i = 0; i < before.length; ++i) if (before[i] !== this.flags[i]) ++count;
    const change = {
      at: new Uint32Array(count),
      was: new Uint8Array(count),
      moved,
      bytes: 5 * count + (moved?.bytes ?? 0),
    };
    for (let i = 0, j = 0; j < count; ++i) {
      if (before[i] === this.flags[i]) continue;
      change.at[j] = i;
      change.was[j++] = before[i];
    }
    this.changes.push(change);
    this.bytes += change.bytes;
    for (let i = 0; this.bytes > UNDO_BYTES && i < this.changes.length; ++i) this.forget(i);
  }

  forget(index) {
    if (this.changes[index]) this.bytes -= this.changes[index].bytes;
    this.changes[index] = null;
  }

  // Undoes the last operation; returns it, or undefined if there is none.
  undo() {
    const operation = this.done.pop();
    if (!operation) return undefined;
    this.undone.push(operation);
    this.work.left += this.tests.pop();
    const change = this.changes.pop();
    if (change) {
      this.bytes -= change.bytes;
      if (change.moved) this.values.motion.undo(change.moved);
      for (let j = 0; j < change.at.length; ++j) this.flags[change.at[j]] = change.was[j];
    } else {
      this.flags.fill(0);
      this.values.motion?.reset();
      for (const earlier of this.done) applyOperation(earlier, this.values, this.flags, new EditWork());
    }
    return operation;
  }

  redo() {
    const operation = this.undone.pop();
    if (operation) this.step(operation);
    return operation;
  }

  // Number of splats in each state.
  counts() {
    const counts = { all: this.flags.length, selected: 0, hidden: 0, deleted: 0 };
    for (const flag of this.flags) {
      if (flag === SELECTED) ++counts.selected;
      else if (flag === HIDDEN) ++counts.hidden;
      else if (flag === DELETED) ++counts.deleted;
    }
    return counts;
  }

  // The operations that change no splat, as they stand now: the last one of a kind counts.
  views() {
    const found = { upright: null, scale: null, start: null, path: undefined, named: new Map(), measures: [] };
    for (const operation of this.done) {
      const { op, name } = operation;
      if (op === "upright" || op === "scale" || op === "start") found[op] = operation;
      else if (op === "path") found.path = operation.path;
      else if (op === "view") found.named.set(name, operation);
      else if (op === "order_views") found.named = orderedViews(found.named, operation.names);
      else if (op === "remove_view") found.named.delete(name);
      else if (op === "measure") found.measures.push(operation);
    }
    return found;
  }
}

// The named views with some names first; names without a view have no effect, and views without a name here follow.
function orderedViews(named, names) {
  return new Map([...names.filter((name) => named.has(name)).map((name) => [name, named.get(name)]), ...named]);
}
