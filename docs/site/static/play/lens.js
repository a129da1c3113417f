// Chapter 04: a ball through a lens. Its true outline, and the ellipse of the tangent, for three projections and a shutter.
"use strict";

/** The lenses of the figure: W x H px, focal lengths in px, and the widest angle at which a mean is put, radians. */
gsplatPlay.lenses = {
    perspective: { name: "pinhole", W: 128, H: 128, f: 40, widest: 1.3 },
    fisheye: { name: "fisheye", W: 128, H: 128, f: 40, widest: 2.6 },
    equirectangular: { name: "panorama", W: 256, H: 128, f: 128 / Math.PI, widest: Math.PI },
};

/** Where a point in camera axes lies on the plane, in units of the focal length, and the Jacobian; k1 distorts radially. */
gsplatPlay.onPlane = function (kind, k1, [x, y, z]) {
    const s = x * x + y * y, square = s + z * z;
    if (kind === "equirectangular") {
        const h = Math.hypot(x, z), down = -y / (square * h);
        return { place: [Math.atan2(x, z), Math.atan2(y, h)], J: [[z / (h * h), 0, -x / (h * h)], [x * down, h / square, z * down]] };
    }
    let g = 1 / z, gs = 0, gz = -g * g; // the radial factor, and its derivatives by s and z
    if (kind === "fisheye") {
        const r = Math.sqrt(s), q = s / (z * z);
        const axis = z > 0 && q < 1e-6;
        g = axis ? (1 - q / 3 + (q * q) / 5) / z : Math.atan2(r, z) / r;
        gs = axis ? (-1 / 3 + (2 * q) / 5) / z ** 3 : (z / square - g) / (2 * s);
        gz = -1 / square;
    }
    const [a, b] = [g * x, g * y], q = a * a + b * b, R = 1 + k1 * q;
    const J = [[g + 2 * x * x * gs, 2 * x * y * gs, x * gz], [2 * x * y * gs, g + 2 * y * y * gs, y * gz]];
    const K = [[R + 2 * k1 * a * a, 2 * k1 * a * b], [2 * k1 * a * b, R + 2 * k1 * b * b]];
    return { place: kind === "perspective" && z <= 0 ? [NaN, NaN] : [R * a, R * b], J: gsplatPlay.multiply(K, J) };
};

/** Where a lens, whose rows are read one after another while the camera turns about +y (radians), sees a point: px. */
gsplatPlay.throughLens = function (kind, k1, turn, p) {
    const { W, H, f } = gsplatPlay.lenses[kind];
    const turned = (h, [x, y, z]) => { // Cayley's map of (0, h, 0)
        const c = (1 - h * h) / (1 + h * h), s = (2 * h) / (1 + h * h);
        return [c * x + s * z, y, c * z - s * x];
    };
    let v = (H - 1) / 2, seen;
    for (let step = 0; step < 6; step++) {
        const h = (turn / 2) * ((v - (H - 1) / 2) / H), now = turned(h, p), { place, J } = gsplatPlay.onPlane(kind, k1, now);
        const pace = turn / (1 + h * h), rows = J.map((row) => row.map((value) => f * value));
        const speed = rows.map((row) => pace * (row[0] * now[2] - row[2] * now[0]));
        seen = { u: f * place[0] + (W - 1) / 2, v: f * place[1] + (H - 1) / 2, rows, speed, h };
        v += (seen.v - v) / (1 - speed[1] / H);
    }
    const { rows, speed, h } = seen, k = 1 / H / (1 - speed[1] / H);
    const J = rows.map((row, i) => turned(-h, row.map((value, n) => value + k * speed[i] * rows[1][n])));
    return { u: seen.u, v, J };
};

/** A ball at distance 1: the ellipse of its tangent, its true outline, and how far that leaves the ellipse, as a fraction. */
gsplatPlay.ball = function ({ kind, k1, turn, mean, size }, sigmas = 2) {
    const { u, v, J } = gsplatPlay.throughLens(kind, k1, turn, mean);
    const cov2d = gsplatPlay.multiply(J, gsplatPlay.transposed(J)).map((row) => row.map((value) => size * size * value));
    const side = gsplatPlay.unit(Math.abs(mean[1]) < 0.9 ? [mean[2], 0, -mean[0]] : [0, mean[2], -mean[1]]);
    const up = [mean[1] * side[2] - mean[2] * side[1], mean[2] * side[0] - mean[0] * side[2], mean[0] * side[1] - mean[1] * side[0]];
    const reach = sigmas * size, along = Math.sqrt(1 - reach * reach), [xx, xy, yy] = gsplatPlay.conic(cov2d);
    let miss = 0;
    const rim = Array.from({ length: 120 }, (_, i) => {
        const angle = (i / 120) * 2 * Math.PI, [c, s] = [reach * Math.cos(angle), reach * Math.sin(angle)];
        const at = gsplatPlay.throughLens(kind, k1, turn, mean.map((value, k) => along * value + c * side[k] + s * up[k]));
        if (kind === "equirectangular") at.u += 256 * Math.round((u - at.u) / 256); // past the seam
        const [du, dv] = [at.u - u, at.v - v];
        miss = Math.max(miss, Math.abs(Math.sqrt(xx * du * du + 2 * xy * du * dv + yy * dv * dv) / sigmas - 1));
        return [at.u, at.v];
    });
    return { centre: [u, v], cov2d, rim, miss: rim.flat().every(Number.isFinite) ? miss : NaN };
};

gsplatPlay.figures.lens = function (place) {
    const { element, number, lenses } = gsplatPlay, SHOWN = [264, 146]; // px that the canvas shows
    const state = { kind: "fisheye", mean: [Math.sin(1.4), 0, Math.cos(1.4)], size: 0.12, k1: 0, turn: 0 };
    const told = element("output", { class: "play-told" });
    const shown = gsplatPlay.canvas((width) => (width * SHOWN[1]) / SHOWN[0], draw, {
        tabindex: "0", role: "application", class: "play-drag",
        "aria-label": "A ball seen through a lens: its outline and the ellipse of the tangent. Arrow keys move it, plus and minus " +
            "change its size, L changes the lens.",
    });
    let zoom = 1;

    function ruled(context, at) { // directions 30 degrees apart
        const { kind, k1 } = state, { W, H, f, widest } = lenses[kind], angles = [30, 60, 90, 120, 150].map((d) => (d * Math.PI) / 180);
        context.strokeStyle = gsplatPlay.color("foreground-border");
        context.lineWidth = 1;
        context.beginPath();
        if (kind === "equirectangular") {
            for (let step = -5; step < 6; step++) {
                const off = (step * Math.PI * f) / 6;
                context.moveTo(...at([W / 2 - 0.5 + off, -0.5]));
                context.lineTo(...at([W / 2 - 0.5 + off, H - 0.5]));
                if (Math.abs(step) > 2) continue;
                context.moveTo(...at([-0.5, H / 2 - 0.5 + off]));
                context.lineTo(...at([W - 0.5, H / 2 - 0.5 + off]));
            }
        } else {
            for (const angle of angles.filter((value) => value <= widest)) {
                const radius = f * gsplatPlay.onPlane(kind, k1, [Math.sin(angle), 0, Math.cos(angle)]).place[0];
                const [left, top] = at([W / 2 - 0.5, H / 2 - 0.5]);
                context.moveTo(left + radius * zoom, top);
                if (radius > 0) context.arc(left, top, radius * zoom, 0, 2 * Math.PI);
            }
        }
        context.stroke();
    }

    function draw(context, width, height) {
        zoom = width / SHOWN[0];
        const { W, H } = lenses[state.kind], found = gsplatPlay.ball(state);
        const at = ([u, v]) => [width / 2 + (u - (W - 1) / 2) * zoom, height / 2 + (v - (H - 1) / 2) * zoom];
        context.fillStyle = gsplatPlay.color("background-primary");
        context.fillRect(0, 0, width, height);
        ruled(context, at);
        context.strokeStyle = gsplatPlay.color("foreground-primary");
        context.strokeRect(...at([-0.5, -0.5]), W * zoom, H * zoom);
        context.beginPath();
        for (const [i, point] of found.rim.concat([found.rim[0]]).entries()) {
            const known = [point, found.rim[(i + 119) % 120]].every((value) => value.every(Number.isFinite));
            if (known && i > 0) context.lineTo(...at(point));
            else context.moveTo(...at(point.every(Number.isFinite) ? point : found.centre));
        }
        context.lineWidth = 3;
        context.strokeStyle = "#2f7fd6";
        context.stroke();
        context.strokeStyle = "#e2761b";
        context.lineWidth = 1.5;
        gsplatPlay.outline(context, at(found.centre), found.cov2d, zoom, 2);
        context.lineWidth = 1;
        const angle = (Math.acos(Math.min(1, Math.max(-1, state.mean[2]))) * 180) / Math.PI;
        told.textContent = [
            `angle to the axis     ${number(angle, 1)} degrees`,
            `centre, px            ${number(found.centre[0], 1)}  ${number(found.centre[1], 1)}`,
            `ellipse, px²          ${[found.cov2d[0][0], found.cov2d[0][1], found.cov2d[1][1]].map((v) => number(v, 1)).join("  ")}`,
            `outline leaves it by  ${Number.isFinite(found.miss) ? `${number(100 * found.miss, 1)} %` : "a part is behind the camera"}`,
        ].join("\n");
    }

    /** Move the mean so that its image moves by so many px, to first order: dm = J' (J J')^-1 d. */
    function moved(du, dv) {
        const { J } = gsplatPlay.throughLens(state.kind, state.k1, state.turn, state.mean);
        const [xx, xy, yy] = gsplatPlay.conic(gsplatPlay.multiply(J, gsplatPlay.transposed(J)));
        const pull = [xx * du + xy * dv, xy * du + yy * dv];
        return gsplatPlay.unit(state.mean.map((value, k) => value + J[0][k] * pull[0] + J[1][k] * pull[1]));
    }

    /** The nearest direction that the lens shows: within its widest angle, and 85 degrees of latitude for a panorama. */
    function held(mean) {
        const { widest } = lenses[state.kind], r = Math.hypot(mean[0], mean[1]), steep = Math.sin((85 * Math.PI) / 180);
        if (state.kind === "equirectangular") {
            if (Math.abs(mean[1]) <= steep) return mean;
            const shrink = Math.sqrt((1 - steep * steep) / (1 - mean[1] ** 2));
            return [mean[0] * shrink, Math.sign(mean[1]) * steep, mean[2] * shrink];
        }
        if (Math.atan2(r, mean[2]) <= widest) return mean;
        return [(mean[0] / r) * Math.sin(widest), (mean[1] / r) * Math.sin(widest), Math.cos(widest)];
    }

    function change(values) {
        Object.assign(state, values);
        if (state.kind === "equirectangular") state.k1 = 0;
        state.mean = held(state.mean);
        select.value = state.kind;
        distortion.input.disabled = state.kind === "equirectangular";
        for (const [entry, { input }] of Object.entries({ size, k1: distortion, turn })) input.value = String(state[entry]);
        shown.redraw();
    }

    gsplatPlay.drag(shown.canvas, () => {}, (_, [dx, dy]) => change({ mean: moved(dx / zoom, dy / zoom) }));
    const slider = (label, entry, range, unit) => gsplatPlay.slider(label, { ...range, value: String(state[entry]) }, (to) => {
        change({ [entry]: to });
        return `${number(to, 2)}${unit}`;
    });
    const select = element("select", { "aria-label": "lens" }, ...Object.entries(lenses).map(([kind, { name }]) => element("option", { value: kind }, name)));
    select.addEventListener("change", () => change({ kind: select.value }));
    const size = slider("size of the ball", "size", { min: "0.01", max: "0.3", step: "0.01" }, " of its distance");
    const distortion = slider("distortion k1", "k1", { min: "-0.05", max: "0.05", step: "0.01" }, "");
    const turn = slider("turn while rows are read", "turn", { min: "-1", max: "1", step: "0.1" }, " radians");
    const step = (du, dv) => () => change({ mean: moved(du, dv) });
    const grow = (by) => () => {
        size.input.value = String(state.size + by);
        size.told();
    };
    const kinds = Object.keys(lenses), next = () => change({ kind: kinds[(kinds.indexOf(state.kind) + 1) % kinds.length] });
    gsplatPlay.keys(shown.canvas, {
        ArrowLeft: step(-3, 0), ArrowRight: step(3, 0), ArrowUp: step(0, -3), ArrowDown: step(0, 3),
        "+": grow(0.01), "=": grow(0.01), "-": grow(-0.01), l: next, L: next,
    });
    const help = "Drag the ball. Blue: its true outline at two standard deviations. Orange: the ellipse of J Σ Jᵀ. Grey: " +
        "directions 30 degrees apart. A rolling shutter reads the rows from top to bottom, while the camera turns about its vertical " +
        "axis. Keys: arrows move, + and − change the size, L changes the lens.";
    place.append(shown.canvas, element("div", { class: "play-row" }, "lens", select), size.row, distortion.row, turn.row, told,
        element("p", { class: "play-help" }, help));
    change({});
    return { state, change, told };
};
