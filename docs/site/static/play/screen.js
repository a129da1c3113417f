// Splats on the screen, near to far, as chapters 10 to 12 have them: arrays for the kernels, and the same in float64.
"use strict";

gsplatPlay.screen = (() => {
    const FLOOR = 1 / 255, CEILING = 0.99, TILE = 16, MARK = 9, RECORD = 16;
    const UNIT = Math.sqrt(0.5 / Math.LN2); // exponents are powers of two: e^-q/2 = 2^-(unit² q)

    /** Scatter splats: nine floats each, mean, conic, colour, opacity. The same seed gives the same splats. */
    function scatter(count, W, H, seed, least, most) {
        let bits = seed >>> 0;
        const draw = () => {
            bits = (Math.imul(bits, 1664525) + 1013904223) >>> 0;
            return bits / 2 ** 32;
        };
        const marks = new Float32Array(MARK * count);
        for (let i = 0; i < count; i++) {
            const u = draw() * (W - 1), v = draw() * (H - 1), angle = Math.PI * draw();
            const s1 = least + (most - least) * draw(), s2 = s1 * (0.35 + 0.65 * draw());
            const c = Math.cos(angle), s = Math.sin(angle);
            const xx = c * c * s1 * s1 + s * s * s2 * s2 + 0.3, yy = s * s * s1 * s1 + c * c * s2 * s2 + 0.3;
            const xy = c * s * (s1 * s1 - s2 * s2), det = xx * yy - xy * xy;
            marks.set([u, v, yy / det, -xy / det, xx / det, draw(), draw(), draw(), 0.3 + 0.6 * draw()], MARK * i);
        }
        return marks;
    }

    function splat(marks, i) {
        const [u, v, A, B, C, r, g, b, opacity] = marks.subarray(MARK * i, MARK * i + MARK);
        return { u, v, A, B, C, color: [r, g, b], opacity };
    }

    const all = (marks) => Array.from({ length: marks.length / MARK }, (_, i) => splat(marks, i));

    /** Half width and height of alpha >= 1/255; null for a splat that is nowhere so opaque. */
    function extent({ A, B, C, opacity }) {
        const level = 2 * Math.log(opacity / FLOOR), det = A * C - B * B;
        return level > 0 ? [Math.sqrt((level * C) / det), Math.sqrt((level * A) / det)] : null;
    }

    /** The engine's records: alpha = 2^(log2 o - s² - t²), s = sx dx + sy dy, t = ty dy. */
    function records(marks) {
        const out = new Float32Array((marks.length / MARK) * RECORD);
        all(marks).forEach((one, i) => {
            const { u, v, A, B, C, color, opacity } = one, half = extent(one) ?? [0, 0];
            const rows = [u, v, UNIT * Math.sqrt(A), (UNIT * B) / Math.sqrt(A), UNIT * Math.sqrt(C - (B * B) / A), 0, 0];
            out.set([...rows, Math.log2(opacity), ...color, 1, u, v, ...half], RECORD * i);
        });
        return out;
    }

    const tilesOf = (W, H) => [Math.ceil(W / TILE), Math.ceil(H / TILE)];

    /** The part of the uniform block of view.wgsl that these kernels read. */
    function view(W, H) {
        const block = new ArrayBuffer(512), floats = new Float32Array(block), words = new Uint32Array(block);
        const [across, down] = tilesOf(W, H);
        floats[31] = -1; // no pixel ends before its tile
        floats.set([CEILING, Math.log2(CEILING)], 34);
        words.set([W, H, across, across * down], 36);
        return block;
    }

    function counts(marks, W, H, pairs) {
        const [across, down] = tilesOf(W, H);
        return { gaussians: marks.length / MARK, pixels: W * H, edges: across * down + 2, pairs, live: 4 };
    }

    const exponent = (one, x, y) => {
        const dx = x - one.u, dy = y - one.v;
        return -0.5 * (one.A * dx * dx + one.C * dy * dy) - one.B * dx * dy;
    };

    /** Walk one pixel near to far: a step for each splat that is above the floor. */
    function walk(splats, x, y) {
        let T = 1;
        const color = [0, 0, 0], steps = [];
        splats.forEach((one, i) => {
            const alpha = Math.min(CEILING, one.opacity * Math.exp(exponent(one, x, y)));
            if (alpha < FLOOR) return;
            const w = T * alpha;
            for (let k = 0; k < 3; k++) color[k] += w * one.color[k];
            T -= w;
            steps.push({ i, alpha, w, T });
        });
        return { color, T, steps };
    }

    /** Compose every splat at every pixel: r, g, b, T for each, in float64. */
    function dense(marks, W, H) {
        const splats = all(marks), image = new Float64Array(4 * W * H);
        for (let pixel = 0; pixel < W * H; pixel++) {
            const { color, T } = walk(splats, pixel % W, Math.floor(pixel / W));
            image.set([...color, T], 4 * pixel);
        }
        return image;
    }

    /** The first and last tile of a row of tiles that the ellipse alpha >= 1/255 meets, or null; as in ellipse.wgsl. */
    function columns(one, half, row, W) {
        const low = Math.max(row * TILE - one.v, -half[1]), high = Math.min(row * TILE + TILE - 1 - one.v, half[1]);
        if (low > high) return null;
        const level = 2 * Math.log(one.opacity / FLOOR), det = one.A * one.C - one.B * one.B;
        const rim = (dy, side) => (-one.B * dy + side * Math.sqrt(Math.max(one.A * level - det * dy * dy, 0))) / one.A;
        const tip = (-one.B / one.C) * half[0], clamp = (dy) => Math.min(high, Math.max(low, dy));
        const x1 = Math.min(W - 1, Math.floor(one.u + rim(clamp(tip), 1) + 1e-3));
        const x0 = Math.max(0, Math.ceil(one.u + rim(clamp(-tip), -1) - 1e-3));
        return x0 > x1 ? null : [Math.floor(x0 / TILE), Math.floor(x1 / TILE)];
    }

    /** Counts of tiles per splat, their prefix sum, and each tile's list of {splat, slot}, near to far. */
    function lists(marks, W, H) {
        const [across, down] = tilesOf(W, H), tiles = Array.from({ length: across * down }, () => []);
        const met = [], starts = [];
        let slot = 0;
        all(marks).forEach((one, i) => {
            const half = extent(one);
            starts.push(slot);
            const first = half ? Math.max(0, Math.ceil(one.v - half[1] - 1e-3)) : 1;
            const last = half ? Math.min(H - 1, Math.floor(one.v + half[1] + 1e-3)) : 0;
            for (let row = Math.floor(first / TILE); first <= last && row <= Math.floor(last / TILE); row++) {
                const run = columns(one, half, row, W);
                for (let column = run ? run[0] : 1; run && column <= run[1]; column++) {
                    tiles[row * across + column].push({ splat: i, slot });
                    slot += 1;
                }
            }
            met.push(slot - starts[i]);
        });
        return { met, starts, tiles, pairs: slot };
    }

    /** The largest difference of two images of four numbers a pixel: kernels' in steps of `stride`, of ours of four. */
    function gap(theirs, stride, ours) {
        let largest = 0;
        for (let pixel = 0; pixel < ours.length / 4; pixel++) {
            for (let k = 0; k < 4; k++) largest = Math.max(largest, Math.abs(theirs[stride * pixel + k] - ours[4 * pixel + k]));
        }
        return largest;
    }

    /** Draw an image of `stride` numbers a pixel, without smoothing. */
    function paint(context, image, stride, W, H, width, height) {
        const small = gsplatPlay.element("canvas", { width: String(W), height: String(H) });
        const target = small.getContext("2d"), pixels = target.createImageData(W, H);
        for (let i = 0; i < W * H; i++) {
            for (let k = 0; k < 3; k++) pixels.data[4 * i + k] = 255 * Math.min(1, image[stride * i + k]) + 0.5;
            pixels.data[4 * i + 3] = 255;
        }
        target.putImageData(pixels, 0, 0);
        context.imageSmoothingEnabled = false;
        context.drawImage(small, 0, 0, width, height);
    }

    return {
        FLOOR, CEILING, TILE, MARK,
        scatter, splat, all, records, view, counts, walk, dense, lists, tilesOf, gap, paint,
    };
})();
