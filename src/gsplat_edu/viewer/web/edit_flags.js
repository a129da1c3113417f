// The states of a splat in the editor, at most one at a time; 0 is a splat that is merely there.

export const SELECTED = 1;
export const HIDDEN = 2;
export const DELETED = 4;
