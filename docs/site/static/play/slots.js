// Chapter 12: slots of the backward pass; who writes where, and sums of the same numbers in several orders.
"use strict";

/** h = alpha dL/dalpha of each pair, summed over its pixels in float64, for L = sum (image - 1/2)² / 2; by slot.
 *
 *  cg = g . c;   w = T alpha;   R -= w cg;   dL/dalpha = T cg - R / (1 - alpha);   T -= w        near to far
 */
gsplatPlay.screen.backward = function (marks, W, H, { tiles, pairs }) {
    const { walk, all, TILE, CEILING, tilesOf } = gsplatPlay.screen, splats = all(marks), sums = new Float64Array(pairs);
    const grads = new Float32Array(5 * W * H);
    for (let y = 0; y < H; y++) {
        for (let x = 0; x < W; x++) {
            const slots = new Map(tiles[Math.floor(y / TILE) * tilesOf(W, H)[0] + Math.floor(x / TILE)]
                .map(({ splat, slot }) => [splat, slot]));
            const { color, steps } = walk(splats, x, y);
            const g = color.map((value) => Math.fround(value - 0.5));
            grads.set(g, 5 * (y * W + x));
            const dot = (a) => a[0] * g[0] + a[1] * g[1] + a[2] * g[2];
            let R = dot(color), T = 1;
            for (const { i, alpha, w } of steps) {
                const cg = dot(splats[i].color);
                R -= w * cg;
                const h = alpha < CEILING ? alpha * (T * cg - R / (1 - alpha)) : 0;
                if (slots.has(i)) sums[slots.get(i)] += h;
                T -= w;
            }
        }
    }
    return { sums, grads };
};

/** Add float32 numbers in an order, rounding after each addition. */
gsplatPlay.screen.added = (numbers, order) => order.reduce((sum, at) => Math.fround(sum + numbers[at]), 0);

gsplatPlay.figures.slots = function (place) {
    const { element, screen } = gsplatPlay, { program } = window.gsplatData.slots;
    const W = 96, H = 64, TILES = screen.tilesOf(W, H).reduce((a, b) => a * b), COUNT = 16, ROOM = 512, TRIES = 200;
    const marks = screen.scatter(COUNT, W, H, 12, 8, 16);
    const lists = screen.lists(marks, W, H), { sums, grads } = screen.backward(marks, W, H, lists);
    const slotAt = Array.from({ length: TILES }, (_, tile) => new Map(lists.tiles[tile].map(({ splat, slot }) => [splat, slot])));
    const state = { splat: 9, tile: 13, tries: 0, results: new Set(), gpu: null, seed: 1 };
    const told = element("output", { class: "play-told" });
    const button = element("button", { type: "button" }, "add in 200 random orders");
    let wide = 1, tall = 1;
    const shown = gsplatPlay.canvas((width) => Math.max(200, Math.min(width * 0.6, 22 * TILES)), draw, {
        tabindex: "0",
        role: "application",
        "aria-label": `The slots of ${COUNT} splats in ${TILES} tiles. Arrow keys choose a splat and a tile, R adds in random orders.`,
        class: "play-drag",
    });

    const numbers = () => state.gpu?.h ?? Float32Array.from(sums);
    const runner = gsplatPlay.gpu.runner((result, reason) => {
        state.gpu = result ? taken(result) : { reason };
        change({});
    });

    function taken({ found, passes, groups }) {
        if (new Uint32Array(found.live)[1] !== lists.pairs) return { reason: "The GPU found other pairs than JavaScript." };
        const slots = new Float32Array(found.slots), added = new Float32Array(found.sums);
        const h = Float32Array.from({ length: lists.pairs }, (_, slot) => slots[10 * slot + 4]);
        const splats = Float32Array.from({ length: COUNT }, (_, i) => added[10 * i + 4]);
        const largest = Math.max(...sums.map(Math.abs));
        const gap = Math.max(...sums.map((value, slot) => Math.abs(value - h[slot]))) / largest;
        return { h, splats, passes, groups, gap };
    }

    function compute() {
        const live = new Uint32Array([COUNT, 0, 0, 0]), counts = screen.counts(marks, W, H, ROOM);
        runner.run({
            program, counts, view: screen.view(W, H), parts: ["lists", "composite", "backward"],
            writes: { live, records: screen.records(marks), grads }, reads: ["live", "slots", "sums"],
        });
    }

    function draw(context, width, height) {
        [wide, tall] = [width / COUNT, height / TILES];
        context.fillStyle = gsplatPlay.color("background-primary");
        context.fillRect(0, 0, width, height);
        const brand = gsplatPlay.color("brand-primary"), line = gsplatPlay.color("foreground-primary");
        const largest = Math.max(...sums.map(Math.abs));
        for (let tile = 0; tile < TILES; tile++) {
            for (const [splat, slot] of slotAt[tile]) {
                context.globalAlpha = 0.2 + 0.8 * Math.sqrt(Math.abs(sums[slot]) / largest);
                context.fillStyle = brand;
                context.fillRect(splat * wide + 1, tile * tall + 1, wide - 2, tall - 2);
            }
        }
        context.globalAlpha = 1;
        context.strokeStyle = line;
        context.strokeRect(state.splat * wide + 0.5, 0.5, wide - 1, height - 1);
        context.strokeRect(0.5, state.tile * tall + 0.5, width - 1, tall - 1);
        context.lineWidth = 3;
        context.strokeRect(state.splat * wide + 1.5, state.tile * tall + 1.5, wide - 3, tall - 3);
        context.lineWidth = 1;
        told.textContent = words();
    }

    /** The slots of the chosen splat, in order. */
    function mine() {
        const first = lists.starts[state.splat];
        return Array.from({ length: lists.met[state.splat] }, (_, k) => first + k);
    }

    function words() {
        const slots = mine(), h = numbers(), chosen = slotAt[state.tile].get(state.splat);
        const nth = lists.tiles[state.tile].findIndex(({ splat }) => splat === state.splat);
        const pair = chosen === undefined
            ? `splat ${state.splat} does not reach tile ${state.tile}: they have no slot`
            : `slot ${chosen}: written by invocation ${nth} of workgroup ${state.tile}, h ${h[chosen].toPrecision(9)}`;
        const sum = state.gpu?.splats?.[state.splat] ?? screen.added(h, slots);
        const order = slots.length ? `slots ${slots[0]} to ${slots.at(-1)}, in order: ${sum.toPrecision(9)}` : "no slots";
        const random = state.tries
            ? `${state.tries} random orders, as atomics may have: ${state.results.size} different sums` : "";
        return [pair, `splat ${state.splat} adds up ${order}`, random, gpuWords(slots, h)].filter(Boolean).join("\n");
    }

    function gpuWords(slots, h) {
        const { gpu } = state;
        if (!gpu) return "…";
        if (!gpu.h) return gpu.reason;
        const same = Object.is(gpu.splats[state.splat], screen.added(h, slots));
        return `GPU: ${gpu.passes} passes, ${gpu.groups} workgroups; its slots differ from JavaScript's float64 by ` +
            `${gpu.gap.toExponential(0)} of the largest at most; its sum has ${same ? "the" : "other"} bits ` +
            `${same ? "of" : "than"} the sum in order`;
    }

    const between = (value, low, high) => Math.min(high, Math.max(low, value));

    function change(values) {
        Object.assign(state, values);
        state.splat = between(state.splat, 0, COUNT - 1);
        state.tile = between(state.tile, 0, TILES - 1);
        if (!("tries" in values)) Object.assign(state, { tries: 0, results: new Set() });
        shown.redraw();
    }

    /** Add the chosen splat's slots in random orders, in float32. */
    function shuffle() {
        const slots = mine(), h = numbers(), results = new Set(state.results);
        for (let round = 0; round < TRIES; round++) {
            const order = [...slots];
            for (let k = order.length - 1; k > 0; k--) {
                state.seed = (Math.imul(state.seed, 1664525) + 1013904223) >>> 0;
                const other = Math.floor((state.seed / 2 ** 32) * (k + 1));
                [order[k], order[other]] = [order[other], order[k]];
            }
            results.add(screen.added(h, order));
        }
        change({ tries: state.tries + TRIES, results });
    }

    const choose = ([x, y]) => change({ splat: Math.floor(x / wide), tile: Math.floor(y / tall) });
    gsplatPlay.drag(shown.canvas, choose, choose);
    const step = (splat, tile) => () => change({ splat: state.splat + splat, tile: state.tile + tile });
    gsplatPlay.keys(shown.canvas, {
        ArrowLeft: step(-1, 0), ArrowRight: step(1, 0), ArrowUp: step(0, -1), ArrowDown: step(0, 1), r: shuffle, R: shuffle,
    });
    button.addEventListener("click", shuffle);
    const help = "A column is a splat, near to far from the left, a row is a tile, and each filled square is a pair with a slot " +
        "of its own. Touch a square or use the arrow keys. A tile's workgroup writes along its row; a splat adds up its column from top to " +
        "bottom. R or the button adds the same numbers in random orders.";
    place.append(shown.canvas, element("p", { class: "play-row" }, button), told, element("p", { class: "play-help" }, help));
    compute();
    return { state, change, told, marks, sums, grads, lists, idle: runner.idle };
};
