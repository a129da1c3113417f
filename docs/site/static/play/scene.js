// Chapter 07: the raw numbers of a trained scene, each through its function, or not. The renderer of chapter 05 draws them.
"use strict";

/** Raw rows from whole numbers in base64: mean (3), log scales (3), quaternion (4), sh0 (3), logit. */
gsplatPlay.unpacked = function ({ count, wide, wide_columns, narrow, narrow_columns }) {
    const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const [means, rest] = [bytes(wide), bytes(narrow)], columns = narrow_columns.length;
    return Array.from({ length: count }, (_, i) => [
        ...wide_columns.map(([low, step], k) => low + step * (means[2 * (3 * i + k)] + 256 * means[2 * (3 * i + k) + 1])),
        ...narrow_columns.map(([low, step], k) => low + step * rest[columns * i + k]),
    ]);
};

/** What is drawn of a raw row; `kept` says which functions are applied, as the chapter's readers do or forget. */
gsplatPlay.activated = function (row, kept) {
    const [scales, quat, sh0, logit] = [row.slice(3, 6), row.slice(6, 10), row.slice(10, 13), row[13]];
    const M = gsplatPlay.stretched(gsplatPlay.rotation(quat, !kept.quats), scales.map((s) => (kept.scales ? Math.exp(s) : Math.abs(s))));
    return {
        mean: row.slice(0, 3), M,
        color: sh0.map((f) => Math.max(0, kept.colours ? f / (2 * Math.sqrt(Math.PI)) + 0.5 : f)),
        opacity: kept.opacities ? 1 / (1 + Math.exp(-logit)) : Math.min(1, Math.max(0, logit)),
    };
};

/** Project splats, sort them by depth and composite them on black; opacities below `least` are left out. */
gsplatPlay.drawnScene = function (splats, camera, least = 0) {
    const { multiply, transposed } = gsplatPlay, { size, fx } = camera;
    const image = new Float64Array(3 * size * size), T = new Float64Array(size * size).fill(1);
    const seen = splats.filter(({ opacity }) => opacity >= Math.max(least, 1 / 255)).map(({ mean, M, color, opacity }) => {
        const p = multiply(camera.R, mean.map((value, k) => [value - camera.eye[k]])).map(([value]) => value);
        return { p, M, color, opacity };
    }).filter(({ p }) => p[2] > 0.05).sort((a, b) => a.p[2] - b.p[2]);
    const clip = (value) => Math.min(size - 1, Math.max(0, value));
    for (const { p, M, color, opacity } of seen) {
        const N = multiply(multiply(gsplatPlay.jacobian(p, fx, fx), camera.R), M), [[xx, xy], [, yy]] = multiply(N, transposed(N));
        const [A, B, C] = gsplatPlay.conic([[xx + 0.3, xy], [xy, yy + 0.3]]), reach = Math.sqrt(2 * Math.log(255 * opacity));
        const u = (fx * p[0]) / p[2] + size / 2, v = (fx * p[1]) / p[2] + size / 2;
        const half = [reach * Math.sqrt(xx + 0.3), reach * Math.sqrt(yy + 0.3)];
        for (let y = clip(Math.ceil(v - half[1])); y <= clip(Math.floor(v + half[1])); y++) {
            for (let x = clip(Math.ceil(u - half[0])); x <= clip(Math.floor(u + half[0])); x++) {
                const pixel = y * size + x, dx = x - u, dy = y - v;
                if (T[pixel] < 1e-9) continue; // no digit of what is shown
                const alpha = Math.min(0.99, opacity * Math.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy));
                if (alpha < 1 / 255) continue;
                const weight = T[pixel] * alpha;
                for (let k = 0; k < 3; k++) image[3 * pixel + k] += weight * color[k];
                T[pixel] -= weight;
            }
        }
    }
    return { image, drawn: seen.length };
};

/** The largest difference of clipped images, the ratio in decibels, and the largest error of each pixel's channels. */
gsplatPlay.compared = function (image, truth) {
    const clip = (value) => Math.min(1, Math.max(0, value)), gaps = image.map((value, i) => Math.abs(clip(value) - clip(truth[i])));
    const worst = gaps.map((_, i) => Math.max(...gaps.slice(3 * Math.floor(i / 3), 3 * Math.floor(i / 3) + 3)));
    const error = gaps.reduce((sum, gap) => sum + gap * gap, 0) / gaps.length;
    return { worst, largest: Math.max(...worst), decibels: -10 * Math.log10(Math.max(error, 1e-10)) };
};

gsplatPlay.figures.scene = function (place) {
    const { element, number } = gsplatPlay, SIZE = 96, rows = gsplatPlay.unpacked(window.gsplatData.scene);
    const LABELS = {
        scales: "scales: e to the stored number", opacities: "opacities: the sigmoid of it",
        colours: "colours: C₀ f + 1/2", quats: "quaternions: divided by their length",
    };
    const state = { azimuth: -2.75, elevation: 0.18, least: 0, kept: { scales: true, opacities: true, colours: true, quats: true } };
    const told = element("output", { class: "play-told" });
    const smalls = [0, 1].map(() => element("canvas", { width: String(SIZE), height: String(SIZE) }));
    const all = { ...state.kept }, complete = rows.map((row) => gsplatPlay.activated(row, all));
    const shown = gsplatPlay.canvas((width) => Math.min(width, 520) / 2 + 20, draw, {
        tabindex: "0", role: "application", class: "play-drag play-turn",
        "aria-label": "A trained sphere as a reader draws it, and its error. Arrow keys turn the camera; 1 to 4 switch the " +
            "functions of scales, opacities, colours and quaternions.",
    });

    function draw(context, width, height) {
        const edge = height - 20, left = width / 2 - edge, camera = gsplatPlay.orbit(state.azimuth, state.elevation, SIZE, 1.17 * SIZE);
        const read = rows.map((row) => gsplatPlay.activated(row, state.kept));
        const { image, drawn } = gsplatPlay.drawnScene(read, camera, state.least);
        const { worst, largest, decibels } = gsplatPlay.compared(image, gsplatPlay.drawnScene(complete, camera).image);
        context.clearRect(0, 0, width, height);
        context.imageSmoothingEnabled = false;
        context.fillStyle = gsplatPlay.color("foreground-primary");
        context.textBaseline = "top";
        [["as this reader draws it", image], ["largest error of a channel", worst]].forEach(([title, pixels], i) => {
            context.fillText(title, left + i * edge, 0, edge - 4);
            context.drawImage(gsplatPlay.raster(smalls[i], pixels), left + i * edge, 20, edge - 4, edge - 4);
        });
        told.textContent = `${drawn} of ${rows.length} splats drawn\n` +
            `against the complete reader: ${number(decibels, 1)} dB, off by up to ${number(largest, 2)}`;
    }

    function change(values) {
        Object.assign(state, values);
        state.elevation = Math.min(1.4, Math.max(-1.4, state.elevation));
        for (const [name, box] of Object.entries(boxes)) box.checked = state.kept[name];
        shown.redraw();
    }

    const toggle = (name) => () => change({ kept: { ...state.kept, [name]: !state.kept[name] } });
    const boxes = Object.fromEntries(Object.keys(LABELS).map((name) =>
        [name, element("input", { type: "checkbox", checked: true, onchange: toggle(name) })]));
    gsplatPlay.drag(shown.canvas, () => {}, (_, [dx, dy]) =>
        change({ azimuth: state.azimuth - dx / 150, elevation: state.elevation - dy / 150 }));
    const turn = (by, up) => () => change({ azimuth: state.azimuth + by, elevation: state.elevation + up });
    const keys = Object.fromEntries(Object.keys(LABELS).map((name, i) => [String(i + 1), toggle(name)]));
    gsplatPlay.keys(shown.canvas, {
        ...keys, ArrowLeft: turn(0.1, 0), ArrowRight: turn(-0.1, 0), ArrowUp: turn(0, 0.1), ArrowDown: turn(0, -0.1),
    });
    const least = gsplatPlay.slider("opacity at least", { min: "0", max: "1", step: "0.01", value: "0" }, (to) => {
        change({ least: to });
        return `opacity at least ${number(to, 2)}`;
    });
    const help = "Drag to turn the camera. Each box is a function that a reader of the file has to apply to the stored numbers: " +
        "take one away and compare. The slider leaves out splats that are fainter. Keys: arrows turn, 1 to 4 switch the boxes. " +
        "The numbers are the file's to 8 bits, and positions to 16.";
    place.append(shown.canvas, ...Object.entries(LABELS).map(([name, text]) => element("label", { class: "play-row" }, boxes[name], text)),
        least.row, told, element("p", { class: "play-help" }, help));
    return { state, change, told };
};
