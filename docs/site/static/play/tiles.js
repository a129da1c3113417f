// Chapter 11: drag splats over tiles; the lists, their counts and the prefix sum follow, made by the engine's kernels.
"use strict";

gsplatPlay.figures.tiles = function (place) {
    const { element, screen } = gsplatPlay, { program } = window.gsplatData.tiles;
    const W = 96, H = 64, [ACROSS, DOWN] = screen.tilesOf(W, H), COUNT = 12, ROOM = 512;
    const marks = screen.scatter(COUNT, W, H, 11, 3, 9);
    const state = { chosen: 5, u: marks[45], v: marks[46], tile: 8, lists: null, image: null, gpu: null };
    const told = element("output", { class: "play-told" });
    let scale = 1, stride = 4;
    const shown = gsplatPlay.canvas((width) => (width * H) / W, draw, {
        tabindex: "0",
        role: "application",
        "aria-label": `${COUNT} splats on ${ACROSS * DOWN} tiles. Arrow keys move the chosen splat, N chooses the next one, ` +
            "W, A, S and D choose a tile.",
        class: "play-drag",
    });

    const runner = gsplatPlay.gpu.runner((result, reason) => {
        state.gpu = result ? taken(result) : { reason };
        shown.redraw();
    });

    // The kernels' lists in the form of `screen.lists`, and the image in steps of six numbers.
    function taken({ found, passes, groups }) {
        const [begin, slotOf, owner] = ["tiles", "slot_of", "owner"].map((name) => new Uint32Array(found[name]));
        const image = new Float32Array(found.image);
        const tiles = Array.from({ length: ACROSS * DOWN }, (_, tile) =>
            Array.from(slotOf.subarray(begin[tile], begin[tile + 1]), (slot) => ({ splat: owner[slot], slot })));
        const same = JSON.stringify(tiles) === JSON.stringify(state.lists.tiles);
        return { tiles, image, passes, groups, same, gap: screen.gap(image, 6, state.dense) };
    }

    function compute() {
        state.dense = screen.dense(marks, W, H);
        state.lists = screen.lists(marks, W, H);
        state.gpu = null;
        const live = new Uint32Array([COUNT, 0, 0, 0]), counts = screen.counts(marks, W, H, ROOM);
        runner.run({
            program, counts, view: screen.view(W, H), parts: ["lists", "composite"],
            writes: { live, records: screen.records(marks) }, reads: ["tiles", "slot_of", "owner", "image"],
        });
    }

    const lists = () => state.gpu?.tiles ?? state.lists.tiles;
    const at = (value) => (value + 0.5) * scale;

    function draw(context, width, height) {
        scale = width / W;
        const drawn = state.gpu?.image;
        screen.paint(context, drawn ?? state.dense, drawn ? 6 : stride, W, H, width, height);
        const edge = screen.TILE * scale, met = lists();
        context.textAlign = "center";
        context.textBaseline = "middle";
        for (let tile = 0; tile < ACROSS * DOWN; tile++) {
            const x = (tile % ACROSS) * edge, y = Math.floor(tile / ACROSS) * edge;
            const hit = met[tile].some(({ splat }) => splat === state.chosen);
            context.fillStyle = "rgba(255, 176, 0, 0.3)";
            if (hit) context.fillRect(x, y, edge, edge);
            context.strokeStyle = "#9a9a9a";
            context.strokeRect(x + 0.5, y + 0.5, edge, edge);
            label(context, String(met[tile].length), x + edge / 2, y + edge / 2);
        }
        context.strokeStyle = "#ffffff";
        context.lineWidth = 3;
        const [left, top] = [(state.tile % ACROSS) * edge, Math.floor(state.tile / ACROSS) * edge];
        context.strokeRect(left + 1.5, top + 1.5, edge - 3, edge - 3);
        context.lineWidth = 1;
        outline(context);
        told.textContent = words();
    }

    // Light letters with a dark rim: the scene is black, whatever the theme.
    function label(context, text, x, y) {
        context.lineWidth = 3;
        context.strokeStyle = "#000000";
        context.strokeText(text, x, y);
        context.lineWidth = 1;
        context.fillStyle = "#ffffff";
        context.fillText(text, x, y);
    }

    function outline(context) {
        const one = screen.splat(marks, state.chosen), level = 2 * Math.log(one.opacity / screen.FLOOR);
        const middle = (one.A + one.C) / 2, half = Math.hypot((one.A - one.C) / 2, one.B);
        const axes = [middle - half, middle + half].map((value) => Math.sqrt(level / value) * scale);
        context.strokeStyle = "#ffb000";
        context.lineWidth = 2;
        context.beginPath();
        const along = 0.5 * Math.atan2(2 * one.B, one.A - one.C) + Math.PI / 2; // the long axis has the small eigenvalue
        context.ellipse(at(one.u), at(one.v), ...axes, along, 0, 2 * Math.PI);
        context.stroke();
        context.lineWidth = 1;
        context.fillStyle = "#ffb000";
        context.beginPath();
        context.arc(at(one.u), at(one.v), 4, 0, 2 * Math.PI);
        context.fill();
    }

    function words() {
        const { met, starts, pairs } = state.lists, list = lists()[state.tile];
        const row = (values) => values.map((value) => String(value).padStart(3)).join("");
        const batch = list.map(({ splat }) => splat).join(" ") || "nothing";
        const last = starts[state.chosen] + met[state.chosen] - 1;
        const lines = [
            `splat${row(met.map((_, i) => i))}`,
            `tiles${row(met)}`,
            `start${row(starts)}`,
            `All counts together make ${pairs} pairs.`,
            met[state.chosen] ? `Splat ${state.chosen} has the slots ${starts[state.chosen]} to ${last}.` : "",
            `The workgroup of tile ${state.tile} reads: ${batch}`,
        ];
        return [...lines, gpuWords()].filter(Boolean).join("\n");
    }

    function gpuWords() {
        const { gpu } = state;
        if (!gpu) return "…";
        if (!gpu.tiles) return gpu.reason;
        return `GPU: ${gpu.passes} passes, ${gpu.groups} workgroups; ` +
            `${gpu.same ? "the same lists as" : "other lists than"} JavaScript; the image differs from float64 by ` +
            `${gpu.gap.toExponential(0)} at most`;
    }

    const between = (value, low, high) => Math.min(high, Math.max(low, value));

    function change(values) {
        if ("chosen" in values) {
            state.chosen = ((values.chosen % COUNT) + COUNT) % COUNT;
            [state.u, state.v] = marks.subarray(9 * state.chosen, 9 * state.chosen + 2);
        }
        if ("tile" in values) state.tile = between(values.tile, 0, ACROSS * DOWN - 1);
        if ("u" in values || "v" in values) {
            state.u = between(values.u ?? state.u, 0, W - 1);
            state.v = between(values.v ?? state.v, 0, H - 1);
            marks.set([state.u, state.v], 9 * state.chosen);
            compute();
        }
        shown.redraw();
    }

    const pixel = ([x, y]) => [x / scale - 0.5, y / scale - 0.5];
    gsplatPlay.drag(shown.canvas, (point) => {
        const [x, y] = pixel(point);
        const far = screen.all(marks).map(({ u, v }) => Math.hypot(u - x, v - y));
        const tile = Math.floor((y + 0.5) / screen.TILE) * ACROSS + Math.floor((x + 0.5) / screen.TILE);
        change({ chosen: far.indexOf(Math.min(...far)), tile });
    }, (_, [dx, dy]) => change({ u: state.u + dx / scale, v: state.v + dy / scale }));
    const push = (dx, dy) => () => change({ u: state.u + dx, v: state.v + dy });
    const step = (by) => () => change({ tile: state.tile + by });
    const next = () => change({ chosen: state.chosen + 1 });
    gsplatPlay.keys(shown.canvas, {
        ArrowLeft: push(-1, 0), ArrowRight: push(1, 0), ArrowUp: push(0, -1), ArrowDown: push(0, 1), n: next, N: next,
        a: step(-1), d: step(1), w: step(-ACROSS), s: step(ACROSS),
    });
    const help = "Drag a splat: the tiles that its ellipse meets turn orange, and each tile shows the length of its list. " +
        "Keys: arrows move the chosen splat, N chooses the next one, W A S D choose a tile. The kernels are the package's own: count, " +
        "prefix sum (the row start), pairs, sort by tile, ranges, composite.";
    place.append(shown.canvas, told, element("p", { class: "play-help" }, help));
    compute();
    return { state, change, told, marks, idle: runner.idle };
};
