// Chapter 05: turn the sphere of splats. The formulas of chapters 02 to 05, in the same order, for a few hundred splats.
"use strict";

/** Project a flat disk on the unit sphere: Sigma = s_t² I + (s_n² - s_t²) n n', Sigma2d = J W Sigma W' J' + 0.3 I. */
gsplatPlay.projected = function (mean, shell, camera) {
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const offset = mean.map((value, k) => value - camera.eye[k]);
    const [x, y, z] = camera.R.map((row) => dot(row, offset));
    if (z <= 0.05) return null;
    const normal = camera.R.map((row) => dot(row, mean));
    const f = camera.fx / z;
    const J = [[f, 0, (-f * x) / z], [0, f, (-f * y) / z]];
    const flat = shell.s_n ** 2 - shell.s_t ** 2, along = J.map((row) => dot(row, normal));
    const cov = (i, j) => shell.s_t ** 2 * dot(J[i], J[j]) + flat * along[i] * along[j];
    const xx = cov(0, 0) + 0.3, xy = cov(0, 1), yy = cov(1, 1) + 0.3, det = xx * yy - xy * xy;
    const reach = Math.sqrt(2 * Math.log(255 * shell.opacity));
    return {
        u: f * x + camera.size / 2, v: f * y + camera.size / 2, z,
        conic: [yy / det, -xy / det, xx / det],
        half: [reach * Math.sqrt(xx), reach * Math.sqrt(yy)],
        color: mean.map((value) => (value + 1) / 2),
    };
};

/** Composite near to far, or as stored, on black: alpha = min(0.99, o exp(...)), zero below 1/255. */
gsplatPlay.composite = function (shell, camera, sorted = true) {
    const { size } = camera, image = new Float64Array(3 * size * size), T = new Float64Array(size * size).fill(1);
    const splats = shell.means.map((mean) => gsplatPlay.projected(mean, shell, camera)).filter(Boolean);
    if (sorted) splats.sort((a, b) => a.z - b.z);
    const clip = (value) => Math.min(size - 1, Math.max(0, value));
    for (const { u, v, conic: [A, B, C], half, color } of splats) {
        for (let y = clip(Math.ceil(v - half[1])); y <= clip(Math.floor(v + half[1])); y++) {
            for (let x = clip(Math.ceil(u - half[0])); x <= clip(Math.floor(u + half[0])); x++) {
                const dx = x - u, dy = y - v;
                const falls = Math.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy);
                const alpha = Math.min(0.99, shell.opacity * falls);
                if (alpha < 1 / 255) continue;
                const pixel = y * size + x, weight = T[pixel] * alpha;
                for (let k = 0; k < 3; k++) image[3 * pixel + k] += weight * color[k];
                T[pixel] -= weight;
            }
        }
    }
    return image;
};

gsplatPlay.figures.sphere = function (place) {
    const { element, number } = gsplatPlay, shell = window.gsplatData.sphere, SIZE = 160;
    const state = { azimuth: 0.5, elevation: -0.35, sorted: true };
    const told = element("output", { class: "play-told" });
    const small = element("canvas", { width: String(SIZE), height: String(SIZE) });
    const shown = gsplatPlay.canvas((width) => Math.min(width, 420), draw, {
        tabindex: "0",
        role: "application",
        "aria-label": `A sphere of ${shell.means.length} splats. Arrow keys turn it; S switches sorting on and off.`,
        class: "play-drag play-turn",
    });
    const box = element("input", { type: "checkbox", checked: true });

    function draw(context, width, height) {
        const image = gsplatPlay.composite(shell, gsplatPlay.orbit(state.azimuth, state.elevation, SIZE, 1.17 * SIZE),
            state.sorted);
        const target = small.getContext("2d"), pixels = target.createImageData(SIZE, SIZE);
        for (let i = 0; i < SIZE * SIZE; i++) {
            for (let k = 0; k < 3; k++) pixels.data[4 * i + k] = 255 * Math.min(1, image[3 * i + k]) + 0.5;
            pixels.data[4 * i + 3] = 255;
        }
        target.putImageData(pixels, 0, 0);
        context.fillStyle = "#000000"; // the scene's background, in either theme
        context.fillRect(0, 0, width, height);
        context.drawImage(small, (width - height) / 2, 0, height, height);
        const degrees = (angle) => number((angle * 180) / Math.PI, 0);
        told.textContent = `azimuth ${degrees(state.azimuth)}°  elevation ${degrees(state.elevation)}°  ` +
            (state.sorted ? "near to far" : "in the order of storage");
    }

    function change(values) {
        Object.assign(state, values);
        state.azimuth = Math.atan2(Math.sin(state.azimuth), Math.cos(state.azimuth));
        state.elevation = Math.min(1.4, Math.max(-1.4, state.elevation));
        box.checked = state.sorted;
        shown.redraw();
    }

    gsplatPlay.drag(shown.canvas, () => {}, (_, [dx, dy]) =>
        change({ azimuth: state.azimuth - dx / 150, elevation: state.elevation - dy / 150 }));
    const turn = (by, up) => () => change({ azimuth: state.azimuth + by, elevation: state.elevation + up });
    const sort = () => change({ sorted: !state.sorted });
    gsplatPlay.keys(shown.canvas, {
        ArrowLeft: turn(0.1, 0), ArrowRight: turn(-0.1, 0), ArrowUp: turn(0, 0.1), ArrowDown: turn(0, -0.1), s: sort, S: sort,
    });
    box.addEventListener("change", () => change({ sorted: box.checked }));
    const help = "Drag, swipe sideways or use the arrow keys to turn the camera around the sphere. Without sorting, the far " +
        "side is painted over the near one wherever it comes later in the list.";
    place.append(shown.canvas, element("label", { class: "play-row" }, box, "sorted by depth"), told,
        element("p", { class: "play-help" }, help));
    return { state, change, told };
};
