// Chapter 04: one Gaussian in front of a pinhole, its samples, and the ellipse of the tangent. Drag it, and walk up to it.
"use strict";

/** The ellipse of a Gaussian (covariance rows, mean in camera coordinates): Sigma2d = J Sigma J', W = I.
 *
 *  With a limit, x/z and y/z inside J are clamped to the viewing directions of the image, enlarged around its middle.
 */
gsplatPlay.tangent = function (cov, mean, { f = 150, edge = 128 } = {}, limit = null) {
    const reach = limit ? (limit * edge) / 2 : Infinity, c = edge / 2; // half a pixel: rows go from -0.5 to edge - 0.5
    const ratios = [0, 1].map((k) => Math.min((reach - 0.5) / f, Math.max((-reach - 0.5) / f, mean[k] / mean[2])));
    const J = gsplatPlay.jacobian(mean, f, f, ratios);
    const cov2d = gsplatPlay.multiply(gsplatPlay.multiply(J, cov), gsplatPlay.transposed(J));
    return { J, cov2d, centre: [0, 1].map((k) => (f * mean[k]) / mean[2] + c) };
};

/** The variance of the projection (t + e a) / (1 + e c) against the ellipse's e² (1 + t²), over draws and their opposites. */
gsplatPlay.excess = function (e, t, draws) {
    let excess = 0, bias = 0;
    for (const [a, c] of draws) {
        const square = (e * (a - t * c)) ** 2, ahead = (t + e * a) / (1 + e * c) - t, back = (t - e * a) / (1 - e * c) - t;
        excess += (ahead * ahead + back * back) / 2 - square;
        bias += (ahead + back) / 2;
    }
    return (excess / draws.length - (bias / draws.length) ** 2) / (e * e * (1 + t * t));
};

/** The same to second order in e. */
gsplatPlay.predictedExcess = (e, t) => ((3 + 8 * t * t) / (1 + t * t)) * e * e;

gsplatPlay.figures.tangent = function (place) {
    const { element, number } = gsplatPlay, F = 150, EDGE = 128, TALL = 174; // px that the canvas shows from top to bottom
    const state = { t: [0.25, -0.08], z: 1.5, across: 0.06, deep: 0.22, clamped: false };
    const told = element("output", { class: "play-told" });
    const cloud = gsplatPlay.normals(1500, 4), draws = gsplatPlay.normals(4000, 44);
    const shown = gsplatPlay.canvas((width) => Math.min(width * 0.7, 400), draw, {
        tabindex: "0", role: "application", class: "play-drag",
        "aria-label": "A Gaussian seen by a pinhole, as samples and as an ellipse. Arrow keys move it, plus and minus change its " +
            "depth, C clamps the Jacobian.",
    });
    let zoom = 1;

    function draw(context, width, height) {
        zoom = height / TALL;
        const at = ([u, v]) => [width / 2 + (u - EDGE / 2) * zoom, height / 2 + (v - EDGE / 2) * zoom];
        const line = gsplatPlay.color("foreground-primary"), mean = [state.t[0] * state.z, state.t[1] * state.z, state.z];
        const s = [state.across, state.across, state.deep], diagonal = s.map((v, i) => s.map((_, j) => (i === j ? v * v : 0)));
        const { centre, cov2d } = gsplatPlay.tangent(diagonal, mean, {}, state.clamped ? 1.3 : null);
        context.fillStyle = gsplatPlay.color("background-primary");
        context.fillRect(0, 0, width, height);
        context.strokeStyle = line;
        context.lineWidth = 1;
        context.strokeRect(...at([-0.5, -0.5]), EDGE * zoom, EDGE * zoom);
        context.fillStyle = gsplatPlay.color("foreground-muted");
        let behind = 0;
        for (const ball of cloud) {
            const [x, y, z] = mean.map((value, k) => value + s[k] * ball[k]);
            if (z <= 0.05) behind += 1;
            else {
                const [left, top] = at([(F * x) / z + EDGE / 2, (F * y) / z + EDGE / 2]);
                context.fillRect(left - 1, top - 1, 2, 2);
            }
        }
        context.strokeStyle = gsplatPlay.color("brand-primary");
        context.lineWidth = 2;
        for (const sigmas of [1, 2, 3]) gsplatPlay.outline(context, at(centre), cov2d, zoom, sigmas);
        context.lineWidth = 1;
        const round = Math.max(state.across, state.deep) / state.z, t = Math.abs(state.t[0]);
        const percent = (value) => `${number(100 * value, 2)} %`;
        told.textContent = [
            `centre, px            ${number(centre[0], 1)}  ${number(centre[1], 1)}`,
            `ellipse, px²          ${[cov2d[0][0], cov2d[0][1], cov2d[1][1]].map((v) => number(v, 1)).join("  ")}`,
            `samples behind 0.05   ${behind} of ${cloud.length}`,
            `a ball, size / depth  ${number(round, 3)}`,
            `variance off by       ${percent(gsplatPlay.predictedExcess(round, t))} predicted`,
            `                      ${round < 0.16 ? `${percent(gsplatPlay.excess(round, t, draws))} measured` : "too near to measure"}`,
        ].join("\n");
    }

    function change(values) {
        Object.assign(state, values);
        state.t = state.t.map((value) => Math.min(3, Math.max(-3, value)));
        box.checked = state.clamped;
        shown.redraw();
    }

    gsplatPlay.drag(shown.canvas, () => {}, (_, [dx, dy]) =>
        change({ t: [state.t[0] + dx / zoom / F, state.t[1] + dy / zoom / F] }));
    const slider = (label, entry, range) => gsplatPlay.slider(label, { ...range, value: String(state[entry]) }, (to) => {
        change({ [entry]: to });
        return `${number(to, 2)} world units`;
    });
    const box = element("input", { type: "checkbox" });
    box.addEventListener("change", () => change({ clamped: box.checked }));
    const depth = slider("depth", "z", { min: "0.3", max: "6", step: "0.05" });
    const sizes = { min: "0.01", max: "0.4", step: "0.01" };
    const step = (dx, dy) => () => change({ t: [state.t[0] + dx, state.t[1] + dy] });
    const walk = (by) => () => {
        depth.input.value = String(state.z + by);
        depth.told();
    };
    const clamp = () => change({ clamped: !state.clamped });
    gsplatPlay.keys(shown.canvas, {
        ArrowLeft: step(-0.05, 0), ArrowRight: step(0.05, 0), ArrowUp: step(0, -0.05), ArrowDown: step(0, 0.05),
        "+": walk(0.1), "=": walk(0.1), "-": walk(-0.1), c: clamp, C: clamp,
    });
    const help = "Drag the Gaussian, also out of the image (the square). Dots are samples that went through the pinhole, the " +
        "curves are the tangent's ellipse at one, two and three standard deviations. The last lines are about a ball of the larger " +
        "size at this depth and column: how far the variance along its row is from the ellipse's. Keys: arrows move, + and − change the depth, C clamps.";
    place.append(shown.canvas, depth.row, slider("size across", "across", sizes).row, slider("size in depth", "deep", sizes).row,
        element("label", { class: "play-row" }, box, "clamp x/z and y/z inside J"), told, element("p", { class: "play-help" }, help));
    return { state, change, told };
};
