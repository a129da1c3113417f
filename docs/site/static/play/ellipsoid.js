// Chapter 03: turn and stretch a Gaussian, and walk up to it. Covariance, affine image, and the outline of its shell.
"use strict";

/** Covariance Sigma = (R S)(R S)', its image under a camera that forgets depth, and the outline of its shell in a pinhole.
 *
 *  A = f/z (I 0): Sigma2d = A Sigma A'.   D = m m' - k² Sigma;   c = D_i3 / D_33,   M = c c' - D_12 / D_33   (in pixels)
 */
gsplatPlay.solid = function ({ quat, scales, distance, f = 200, direction = [0, 0, 1] }, k = 1) {
    const { multiply, transposed } = gsplatPlay, two = [0, 1];
    const RS = gsplatPlay.stretched(gsplatPlay.rotation(quat), scales), cov = multiply(RS, transposed(RS));
    const mean = direction.map((value) => value * distance), pixels = [f, f, 1];
    const affine = two.map((i) => two.map((j) => (f / mean[2]) ** 2 * cov[i][j]));
    const D = mean.map((a, i) => mean.map((b, j) => pixels[i] * pixels[j] * (a * b - k * k * cov[i][j])));
    const centre = two.map((i) => D[i][2] / D[2][2]);
    const shape = two.map((i) => two.map((j) => centre[i] * centre[j] - D[i][j] / D[2][2]));
    return { RS, cov, mean, affine, centre, shape, image: two.map((i) => (f * mean[i]) / mean[2]) };
};

gsplatPlay.figures.ellipsoid = function (place) {
    const { element, number } = gsplatPlay, F = 200;
    const state = { quat: gsplatPlay.unit([0.9, 0.15, 0.5, 0.1]), scales: [0.5, 0.1, 0.15], distance: 3 };
    const told = element("output", { class: "play-told" }), cloud = gsplatPlay.normals(600, 3);
    const AXES = ["#d55e00", "#009e73", "#cc79a7"];
    const shown = gsplatPlay.canvas((width) => Math.min(width * 0.72, 380), draw, {
        tabindex: "0",
        role: "application",
        "aria-label": "A Gaussian in space, seen by a camera. Arrow keys turn it, the comma and the full stop roll it, plus " +
            "and minus move the camera.",
        class: "play-drag",
    });

    function draw(context, width, height) {
        const solid = gsplatPlay.solid(state), line = gsplatPlay.color("foreground-primary");
        // A world unit at the depth of the mean is as long at any distance, so that only the shape changes.
        const zoom = ((height / 2.5) * state.distance) / F;
        const at = ([u, v]) => [width / 2 + (u - solid.image[0]) * zoom, height / 2 + (v - solid.image[1]) * zoom];
        const seen = (ball) => {
            const [x, y, z] = solid.RS.map((row, i) => solid.mean[i] + row.reduce((sum, r, k) => sum + r * ball[k], 0));
            return z > 0.05 ? at([(F * x) / z, (F * y) / z]) : null;
        };
        context.fillStyle = gsplatPlay.color("background-primary");
        context.fillRect(0, 0, width, height);
        context.fillStyle = gsplatPlay.color("foreground-muted");
        for (const spot of cloud.map(seen).filter(Boolean)) context.fillRect(spot[0] - 1, spot[1] - 1, 2, 2);
        context.lineWidth = 3;
        AXES.forEach((color, k) => {
            const tip = [0, 1, 2].map((i) => Number(i === k)), ends = [tip, tip.map((value) => -value)].map(seen);
            if (ends.includes(null)) return;
            context.strokeStyle = color;
            context.beginPath();
            context.moveTo(...ends[0]);
            context.lineTo(...ends[1]);
            context.stroke();
        });
        context.lineWidth = 2;
        for (const k of [1, 2]) {
            const shell = gsplatPlay.solid(state, k);
            context.setLineDash([]);
            context.strokeStyle = gsplatPlay.color("brand-primary");
            gsplatPlay.outline(context, at(shell.centre), shell.shape, zoom);
            context.setLineDash([6, 5]);
            context.strokeStyle = line;
            gsplatPlay.outline(context, at(shell.image), shell.affine, zoom, k);
        }
        context.setLineDash([]);
        context.lineWidth = 1;
        told.textContent = words(solid);
    }

    function words({ cov, affine, shape, centre, image }) {
        const row = (values, decimals) => values.map((value) => number(value, decimals).padStart(8)).join("");
        const three = ([[xx, xy], [, yy]]) => row([xx, xy, yy], 1);
        return [
            `quaternion  ${row(state.quat, 2).replaceAll("    ", "  ")}`,
            `covariance  ${row(cov[0])}`,
            `            ${row(cov[1])}`,
            `            ${row(cov[2])}`,
            `affine, px² ${three(affine)}`,
            `pinhole, px²${three(shape)}`,
            `centre, px  ${row([centre[0] - image[0], centre[1] - image[1]], 2)}`,
        ].join("\n");
    }

    function change(values) {
        Object.assign(state, values);
        state.distance = Math.min(12, Math.max(1.5, state.distance));
        state.scales = state.scales.map((value) => Math.min(0.6, Math.max(0.02, value)));
        shown.redraw();
    }

    const turn = (axis, angle) => {
        const by = [0, 1, 2].map((k) => (k === axis ? Math.sin(angle / 2) : 0));
        change({ quat: gsplatPlay.unit(gsplatPlay.hamilton([Math.cos(angle / 2), ...by], state.quat)) });
    };
    gsplatPlay.drag(shown.canvas, () => {}, (_, [dx, dy]) => {
        turn(1, -dx / 100);
        turn(0, dy / 100);
    });
    const scales = state.scales.map((value, k) =>
        gsplatPlay.slider(`s${"₁₂₃"[k]}`, { min: "0.02", max: "0.6", step: "0.01", value: String(value) }, (to) => {
            change({ scales: state.scales.map((old, j) => (j === k ? to : old)) });
            return `${number(to, 2)} world units`;
        }));
    const walk = gsplatPlay.slider("distance", { min: "1.5", max: "12", step: "0.1", value: "3" }, (distance) => {
        change({ distance });
        return `${number(distance, 1)} world units`;
    });
    const step = (by) => () => {
        walk.input.value = String(state.distance + by);
        walk.told();
    };
    gsplatPlay.keys(shown.canvas, {
        ArrowLeft: () => turn(1, 0.1), ArrowRight: () => turn(1, -0.1), ArrowUp: () => turn(0, -0.1),
        ArrowDown: () => turn(0, 0.1), ",": () => turn(2, -0.1), ".": () => turn(2, 0.1),
        "+": step(-0.5), "=": step(-0.5), "-": step(0.5),
    });
    const help = "Drag to turn the Gaussian; the sliders stretch it along its own axes, and move it away. Keys: " +
        "arrows turn, comma and full stop roll, + and − move the camera. Solid: the outlines of the shells at one and two " +
        "standard deviations, as a pinhole sees them. Dashed: the image under a camera that forgets depth. Image covariances " +
        "are given as xx, xy, yy. The last line is the distance of the first outline's centre from the image of the mean.";
    place.append(shown.canvas, ...[...scales, walk].map(({ row }) => row), told,
        element("p", { class: "play-help" }, help));
    return { state, change, told };
};
