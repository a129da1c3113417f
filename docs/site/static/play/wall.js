// Chapter 15: a ray through a wall of flat splats. Move the ray and the wall, and watch three depths leave the surface.
"use strict";

/** The centres and normals of splats at the places s along a wall through (0, 4), (x, z): `offsets` are added along the wall's
 *  normal, `turns` to its angle.
 */
gsplatPlay.slantedWall = function (slant, places, offsets, turns) {
    const [c, s] = [Math.cos(slant), Math.sin(slant)];
    return places.map((place, i) => ({
        center: [place * c + offsets[i] * s, 4 + place * s - offsets[i] * c],
        normal: [Math.sin(slant + turns[i]), -Math.cos(slant + turns[i])],
    }));
};

/** Mean, median and planar depth along the ray (x, 1) from the origin, and alpha. The median is NaN where there is none.
 *
 *  mean = sum w z / sum w,   planar = sum w d / (sum w n . r),   d = n . center
 */
gsplatPlay.pixelDepths = function (x, splats, sigma, opacity) {
    const sums = { w: 0, z: 0, d: 0, slope: 0 }, weights = [];
    let T = 1, median = NaN;
    for (const { center: [across, z], normal: [nx, nz] } of [...splats].sort((a, b) => a.center[1] - b.center[1])) {
        const u = across / z, spread = (sigma * Math.abs(nz + u * nx)) / z;
        const w = T * Math.min(0.99, opacity * Math.exp(-0.5 * ((x - u) / spread) ** 2));
        T -= w;
        if (T < 0.5 && Number.isNaN(median)) median = z;
        sums.w += w;
        sums.z += w * z;
        sums.d += w * (nx * across + nz * z);
        sums.slope += w * (nx * x + nz);
        weights.push(w);
    }
    return { mean: sums.z / sums.w, median, planar: sums.d / sums.slope, alpha: 1 - T, weights };
};

gsplatPlay.figures.wall = function (place) {
    const { element, number } = gsplatPlay, SIGMA = 0.06, REACH = 0.9, MOST = 300;
    const state = { x: 0, slant: 55, count: 120, noise: 0, turn: 0 };
    const told = element("output", { class: "play-told" });
    const pairs = gsplatPlay.normals(MOST, 15), wide = gsplatPlay.normals(MOST, 16);
    // The places are spread evenly by the golden ratio, so that every number of splats covers the wall.
    const seats = Array.from({ length: MOST }, (_, i) => REACH * (2 * ((i * 0.618033988749895) % 1) - 1));
    const shown = gsplatPlay.canvas((width) => Math.min(width * 0.62, 380), draw, {
        tabindex: "0", role: "application", class: "play-drag",
        "aria-label": "A ray through a wall of flat splats, from the side. Left and right move the ray, up and down tilt the wall.",
    });
    let zoom = 1;

    /** Everything the figure shows, from the state. */
    function measured() {
        const slant = (state.slant * Math.PI) / 180, chosen = seats.slice(0, state.count);
        const offsets = chosen.map((_, i) => state.noise * pairs[i][0]);
        const turns = chosen.map((_, i) => (state.turn * Math.PI / 180) * wide[i][0]);
        const splats = gsplatPlay.slantedWall(slant, chosen, offsets, turns);
        const truth = (4 * Math.cos(slant)) / (Math.cos(slant) - state.x * Math.sin(slant));
        return { slant, splats, truth, ...gsplatPlay.pixelDepths(state.x, splats, SIGMA, 0.3) };
    }

    function draw(context, width, height) {
        const found = measured(), line = gsplatPlay.color("foreground-primary"), brand = gsplatPlay.color("brand-primary");
        zoom = width / 0.9; // the canvas shows 0.9 world units of depth
        // The camera is far to the left: depth goes to the right, x goes down.
        const at = (x, z) => [width / 2 + (z - 4) * zoom, height / 2 + x * zoom];
        context.fillStyle = gsplatPlay.color("background-primary");
        context.fillRect(0, 0, width, height);
        context.strokeStyle = gsplatPlay.color("foreground-muted");
        stroke(context, at(-Math.cos(found.slant), 4 - Math.sin(found.slant)), at(Math.cos(found.slant), 4 + Math.sin(found.slant)));
        context.strokeStyle = line;
        stroke(context, at(2 * state.x, 2), at(6 * state.x, 6));
        found.splats.sort((a, b) => a.center[1] - b.center[1]).forEach(({ center: [x, z], normal: [nx, nz] }, i) => {
            context.globalAlpha = 0.25 + 0.75 * Math.min(1, 5 * found.weights[i]);
            context.strokeStyle = found.weights[i] > 1e-3 ? brand : line;
            context.lineWidth = 1 + 12 * found.weights[i];
            stroke(context, at(x + SIGMA * nz, z - SIGMA * nx), at(x - SIGMA * nz, z + SIGMA * nx));
        });
        context.globalAlpha = context.lineWidth = 1;
        context.fillStyle = context.strokeStyle = line;
        marks(context, found, at);
        words(found);
    }

    function stroke(context, from, to) {
        context.beginPath();
        context.moveTo(...from);
        context.lineTo(...to);
        context.stroke();
    }

    /** Mark the depths on the ray: the wall by a ring, the others by a stem with a name, each of its own length. */
    function marks(context, found, at) {
        const ring = at(state.x * found.truth, found.truth);
        context.beginPath();
        context.arc(...ring, 6, 0, 2 * Math.PI);
        context.lineWidth = 2;
        context.stroke();
        context.lineWidth = 1;
        ["mean", "median", "planar"].forEach((name, k) => {
            if (Number.isNaN(found[name])) return;
            const [left, top] = at(state.x * found[name], found[name]), end = top + 40 + 22 * k;
            context.beginPath();
            context.arc(left, top, 3.5, 0, 2 * Math.PI);
            context.fill();
            stroke(context, [left, top], [left, end]);
            context.fillText(name, left + 5, end);
        });
    }

    function words(found) {
        const off = (value) => Number.isNaN(value) ? "none"
            : `${number(value)}, off by ${number((value - found.truth) / SIGMA, 2)} σ`;
        told.textContent = [
            `wall     ${number(found.truth)} away, slant ${number(state.slant, 0)} degrees`,
            `mean     ${off(found.mean)}`,
            `median   ${off(found.median)}`,
            `planar   ${off(found.planar)}`,
            `alpha    ${number(found.alpha)}`,
        ].join("\n");
    }

    const between = (value, low, high) => Math.min(high, Math.max(low, value));

    function change(values) {
        Object.assign(state, values);
        state.x = between(state.x, -0.06, 0.06);
        state.slant = between(state.slant, -75, 75);
        shown.redraw();
    }

    // A drag up or down moves the ray, a drag to the side tilts the wall.
    gsplatPlay.drag(shown.canvas, () => {}, (_, [dx, dy]) =>
        change({ x: state.x + dy / zoom / 4, slant: state.slant + dx / 3 }));
    gsplatPlay.keys(shown.canvas, {
        ArrowUp: () => change({ x: state.x - 0.005 }),
        ArrowDown: () => change({ x: state.x + 0.005 }),
        ArrowLeft: () => change({ slant: state.slant - 5 }),
        ArrowRight: () => change({ slant: state.slant + 5 }),
    });
    const slider = (label, entry, range, decimals, unit) =>
        gsplatPlay.slider(label, { ...range, value: String(state[entry]) }, (to) => {
            change({ [entry]: to });
            return `${number(to, decimals)} ${unit}`;
        }).row;
    const help = "From the side; the camera is far to the left. The ring is where the ray meets the wall. Strokes are splats, one " +
        "standard deviation σ to both sides, thick where the pixel sees them. Drag up and down to move the ray, sideways to tilt the " +
        "wall. Keys: up and down move, left and right tilt. Then take the splats off the wall, and turn them.";
    place.append(shown.canvas, slider("splats", "count", { min: "20", max: "300", step: "10" }, 0, "splats"),
        slider("off the wall", "noise", { min: "0", max: "0.1", step: "0.005" }, 3, "world units"),
        slider("turned", "turn", { min: "0", max: "40", step: "2" }, 0, "degrees"), told,
        element("p", { class: "play-help" }, help));
    return { state, change, told, measured };
};
