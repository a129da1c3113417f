// Chapter 06: a lobe in sixteen numbers. Drag the coefficients; the ball shows the colour that a camera on each side sees.
"use strict";

/** The 16 harmonics at a unit vector, in the order and with the signs of scene files. */
gsplatPlay.harmonics = function ([x, y, z]) {
    const root = (value) => Math.sqrt(value / Math.PI), xx = x * x, yy = y * y, zz = z * z;
    const [a, b, c, d] = [root(15) / 2, root(35 / 2) / 4, root(105) / 2, root(21 / 2) / 4];
    return [
        root(1) / 2, -root(3) / 2 * y, root(3) / 2 * z, -root(3) / 2 * x,
        a * x * y, -a * y * z, root(5) / 4 * (2 * zz - xx - yy), -a * x * z, (a / 2) * (xx - yy),
        -b * y * (3 * xx - yy), c * x * y * z, -d * y * (4 * zz - xx - yy), root(7) / 4 * z * (2 * zz - 3 * xx - 3 * yy),
        -d * x * (4 * zz - xx - yy), (c / 2) * z * (xx - yy), -b * x * (xx - 3 * yy),
    ];
};

/** Coefficients of the lobe exp(kappa (a.d - 1)): c_i = b_i(a) times the integral 2 pi exp(kappa (t - 1)) P_l(t), -1 <= t <= 1.
 *
 *  By parts, with I_l for the integral: I_0 = (1 - e^(-2 kappa)) / kappa, I_1 = (1 + e^(-2 kappa) - I_0) / kappa, and
 *  I_(l+1) = I_(l-1) - (2 l + 1) I_l / kappa. The recursion loses about (2 l + 1) / kappa per degree: kappa >= 0.5 here.
 */
gsplatPlay.lobe = function (axis, kappa) {
    const edge = Math.exp(-2 * kappa), I = [(1 - edge) / kappa];
    I.push((1 + edge - I[0]) / kappa);
    for (const l of [1, 2]) I.push(I[l - 1] - ((2 * l + 1) * I[l]) / kappa);
    const energy = (Math.PI * (1 - edge * edge)) / kappa; // the integral of the lobe's square
    const c = gsplatPlay.harmonics(axis).map((value, i) => 2 * Math.PI * I[Math.floor(Math.sqrt(i))] * value);
    return { c, energy };
};

/** A splat's colour along d: max(0, sum of b_i(d) (gloss c_i) + body). */
gsplatPlay.glossy = function (d, c, body, gloss, degree) {
    const b = gsplatPlay.harmonics(d);
    let sum = 0;
    for (let i = 0; i < (degree + 1) ** 2; i++) sum += b[i] * c[i];
    return body.map((value) => Math.max(0, value + gloss * sum));
};

/** What the coefficients leave out of a lobe, relative: by Pythagoras, |f|² - 2 c.a + |c|², with its own coefficients a. */
gsplatPlay.leftOut = function (c, lobe, degree) {
    let left = lobe.energy;
    for (let i = 0; i < (degree + 1) ** 2; i++) left += c[i] * (c[i] - 2 * lobe.c[i]);
    return Math.sqrt(Math.max(0, left) / lobe.energy);
};

gsplatPlay.figures.harmonics = function (place) {
    const { element, number } = gsplatPlay, SIZE = 120, BODY = [0.2, 0.3, 0.4], GLOSS = 0.7;
    const axis = gsplatPlay.unit([-0.35, -0.45, 0.82]);
    const state = { azimuth: 0, elevation: 0, degree: 3, sharpness: 4, chosen: 0, c: gsplatPlay.lobe(axis, 4).c };
    const told = element("output", { class: "play-told" });
    const smalls = [0, 1].map(() => element("canvas", { width: String(SIZE), height: String(SIZE) }));
    const balls = gsplatPlay.canvas((width) => Math.min(width / 2, 240) + 20, drawBalls, {
        tabindex: "0", role: "application", class: "play-drag play-turn",
        "aria-label": "Two balls: the lobe, and what the coefficients make of it. Arrow keys walk around them.",
    });
    const bars = gsplatPlay.canvas(() => 160, drawBars, {
        tabindex: "0", role: "application", class: "play-drag",
        "aria-label": "Sixteen coefficients. Left and right choose one, up and down change it.",
    });

    /** The point of the ball in direction n has the colour that a camera there sees: it looks along d = -n. */
    function ball(small, colour) {
        const { R } = gsplatPlay.orbit(state.azimuth, state.elevation), image = new Float64Array(3 * SIZE * SIZE);
        for (let i = 0; i < SIZE * SIZE; i++) {
            const x = (2 * ((i % SIZE) + 0.5)) / SIZE - 1, y = (2 * (Math.floor(i / SIZE) + 0.5)) / SIZE - 1;
            const inside = 1 - x * x - y * y, z = Math.sqrt(Math.max(0, inside));
            const d = [0, 1, 2].map((k) => z * R[2][k] - x * R[0][k] - y * R[1][k]);
            if (inside > -0.1) image.set(colour(d), 3 * i);
        }
        return gsplatPlay.raster(small, image);
    }

    function drawBalls(context, width, height) {
        const edge = height - 20, middle = width / 2;
        const peak = (d) => Math.exp(state.sharpness * (d.reduce((sum, v, k) => sum + v * axis[k], 0) - 1));
        const { c, degree } = state;
        const images = [(d) => BODY.map((v) => v + GLOSS * peak(d)), (d) => gsplatPlay.glossy(d, c, BODY, GLOSS, degree)];
        context.clearRect(0, 0, width, height);
        context.fillStyle = gsplatPlay.color("foreground-primary");
        context.textBaseline = "top";
        context.textAlign = "center";
        ["the lobe", `degree ${degree}: ${(degree + 1) ** 2} numbers`].forEach((title, i) => {
            const left = middle + (i - 1) * edge;
            context.fillText(title, left + edge / 2, 0);
            context.save();
            context.beginPath();
            context.arc(left + edge / 2, 16 + edge / 2, edge / 2 - 4, 0, 2 * Math.PI);
            context.clip();
            context.drawImage(ball(smalls[i], images[i]), left + 4, 20, edge - 8, edge - 8);
            context.restore();
        });
        const { R } = gsplatPlay.orbit(state.azimuth, state.elevation);
        const colour = gsplatPlay.glossy(R[2], c, BODY, GLOSS, degree), row = (values) => values.map((v) => number(v, 3)).join("  ");
        const b = gsplatPlay.harmonics(R[2]), i = state.chosen;
        told.textContent = [
            `d of this camera    ${row(R[2])}`,
            `colour, r g b       ${row(colour)}`,
            `b${i}(d) c${i}`.padEnd(20) + `${number(b[i])} · ${number(c[i])}`,
            `relative error      ${number(100 * gsplatPlay.leftOut(c, gsplatPlay.lobe(axis, state.sharpness), degree), 1)} %`,
        ].join("\n");
    }

    const HIGH = 1; // a coefficient at the top of the bars

    function drawBars(context, width, height) {
        const step = width / 16, zero = height / 2;
        context.fillStyle = gsplatPlay.color("background-secondary");
        context.fillRect(0, 0, width, height);
        state.c.forEach((value, i) => {
            const used = i < (state.degree + 1) ** 2;
            context.globalAlpha = used ? 1 : 0.3;
            context.fillStyle = gsplatPlay.color(i === state.chosen ? "brand-primary" : "foreground-secondary");
            const tall = (value / HIGH) * (zero - 16);
            context.fillRect(i * step + 2, Math.min(zero, zero - tall), step - 4, Math.max(2, Math.abs(tall)));
            context.textAlign = "center";
            context.fillText(String(i), (i + 0.5) * step, height - 3);
        });
        context.globalAlpha = 1;
        context.strokeStyle = gsplatPlay.color("foreground-muted");
        for (const i of [1, 4, 9]) context.strokeRect(i * step, 0, 0, height); // where a degree begins
    }

    function change(values) {
        Object.assign(state, values);
        state.elevation = Math.min(1.4, Math.max(-1.4, state.elevation));
        balls.redraw();
        bars.redraw();
    }

    function set(i, value) {
        change({ chosen: i, c: state.c.map((old, k) => (k === i ? Math.min(HIGH, Math.max(-HIGH, value)) : old)) });
    }

    gsplatPlay.drag(balls.canvas, () => {}, (_, [dx, dy]) =>
        change({ azimuth: state.azimuth - dx / 100, elevation: state.elevation - dy / 100 }));
    let held = 0;
    const raise = ([, y]) => set(held, ((80 - y) / (80 - 16)) * HIGH);
    gsplatPlay.drag(bars.canvas, (point) => {
        held = Math.min(15, Math.max(0, Math.floor((16 * point[0]) / bars.canvas.clientWidth)));
        raise(point);
    }, raise);
    const walk = (by, up) => () => change({ azimuth: state.azimuth + by, elevation: state.elevation + up });
    gsplatPlay.keys(balls.canvas, { ArrowLeft: walk(0.1, 0), ArrowRight: walk(-0.1, 0), ArrowUp: walk(0, 0.1), ArrowDown: walk(0, -0.1) });
    const choose = (by) => () => change({ chosen: (state.chosen + by + 16) % 16 });
    const move = (by) => () => set(state.chosen, state.c[state.chosen] + by);
    gsplatPlay.keys(bars.canvas, { ArrowLeft: choose(-1), ArrowRight: choose(1), ArrowUp: move(0.05), ArrowDown: move(-0.05) });
    const degree = gsplatPlay.slider("degree", { min: "0", max: "3", step: "1", value: "3" }, (to) => {
        change({ degree: to });
        return `degree ${to}`;
    });
    const sharpness = gsplatPlay.slider("sharpness", { min: "0.5", max: "80", step: "0.5", value: "4" }, (to) => {
        change({ sharpness: to, c: gsplatPlay.lobe(axis, to).c });
        return `sharpness ${number(to, 1)}`;
    });
    const help = "Drag a ball, or use its arrow keys, to walk around the splat: each point of a ball has the colour that a " +
        "camera on that side sees. Drag a bar, or choose it with left and right and change it with up and down. The slider of " +
        "sharpness sets all sixteen to the lobe's own coefficients, and no others come closer to the lobe.";
    place.append(balls.canvas, degree.row, sharpness.row, bars.canvas, told, element("p", { class: "play-help" }, help));
    return { state, change, told };
};
