// Chapter 02: drag a splat over a grid of pixels and watch its ellipse, its conic, and the derivative of one pixel.
"use strict";

/** The splat's covariance, conic, and at a pixel its alpha and the derivative of alpha by the centre, in 1/px.
 *
 *  Sigma = R S S R' + 0.3 I,   alpha = o exp(-d' Sigma^-1 d / 2),   d alpha / d mu = alpha Sigma^-1 d
 */
gsplatPlay.splat = function ({ u, v, s1, s2, angle, opacity = 0.8, dilation = 0.3 }, x, y) {
    const c = Math.cos(angle), s = Math.sin(angle);
    const xx = c * c * s1 * s1 + s * s * s2 * s2 + dilation;
    const yy = s * s * s1 * s1 + c * c * s2 * s2 + dilation;
    const xy = c * s * (s1 * s1 - s2 * s2);
    const det = xx * yy - xy * xy;
    const conic = [yy / det, -xy / det, xx / det];
    const dx = x - u, dy = y - v;
    const pull = [conic[0] * dx + conic[1] * dy, conic[1] * dx + conic[2] * dy];
    const alpha = opacity * Math.exp(-0.5 * (pull[0] * dx + pull[1] * dy));
    return { cov: [xx, xy, yy], conic, alpha, grad: [alpha * pull[0], alpha * pull[1]] };
};

gsplatPlay.figures.ellipse = function (place) {
    const { element, number } = gsplatPlay;
    const WIDE = 25, TALL = 17;
    const state = { u: 11, v: 8.6, s1: 3.2, s2: 1.4, angle: -0.5, x: 14, y: 7 };
    const told = element("output", { class: "play-told" });
    let held = "centre", edge = 1;
    const shown = gsplatPlay.canvas((width) => (width * TALL) / WIDE, draw, {
        tabindex: "0",
        role: "application",
        "aria-label": "A splat on a grid of pixels. Arrow keys move it, plus and minus change its long axis, " +
            "the comma and the full stop turn it, W, A, S and D move the marked pixel.",
        class: "play-drag",
    });

    function tip() {
        return [state.u + 2 * state.s1 * Math.cos(state.angle), state.v + 2 * state.s1 * Math.sin(state.angle)];
    }

    function draw(context, width) {
        edge = width / WIDE;
        const dark = gsplatPlay.color("background-primary"), line = gsplatPlay.color("foreground-primary");
        const brand = gsplatPlay.color("brand-primary"), grid = gsplatPlay.color("background-border");
        context.fillStyle = dark;
        context.fillRect(0, 0, width, TALL * edge);
        for (let y = 0; y < TALL; y++) {
            for (let x = 0; x < WIDE; x++) {
                const { alpha } = gsplatPlay.splat(state, x, y);
                context.globalAlpha = alpha < 1 / 255 ? 0 : alpha;
                context.fillStyle = brand;
                context.fillRect(x * edge, y * edge, edge, edge);
                context.globalAlpha = 0.6;
                context.strokeStyle = grid;
                context.strokeRect(x * edge + 0.5, y * edge + 0.5, edge, edge);
            }
        }
        context.globalAlpha = 1;
        const here = gsplatPlay.splat(state, state.x, state.y);
        outline(context, here.cov, line);
        marks(context, here, line);
        told.textContent = words(here);
    }

    // The centre of pixel (x, y) is drawn in the middle of its square.
    const at = (value) => (value + 0.5) * edge;

    function outline(context, [xx, xy, yy], line) {
        const middle = (xx + yy) / 2, half = Math.hypot((xx - yy) / 2, xy);
        const angle = 0.5 * Math.atan2(2 * xy, xx - yy);
        context.strokeStyle = line;
        for (const [sigmas, dash] of [[1, []], [2, [5, 4]]]) {
            context.setLineDash(dash);
            context.beginPath();
            const axes = [middle + half, middle - half].map((value) => sigmas * Math.sqrt(value) * edge);
            context.ellipse(at(state.u), at(state.v), axes[0], axes[1], angle, 0, 2 * Math.PI);
            context.stroke();
        }
        context.setLineDash([]);
    }

    function marks(context, here, line) {
        context.fillStyle = context.strokeStyle = line;
        for (const [x, y, radius] of [[state.u, state.v, 4], [...tip(), 6]]) {
            context.beginPath();
            context.arc(at(x), at(y), radius, 0, 2 * Math.PI);
            radius === 6 ? context.stroke() : context.fill();
        }
        context.lineWidth = 3;
        context.strokeRect(state.x * edge + 1.5, state.y * edge + 1.5, edge - 3, edge - 3);
        const [gx, gy] = here.grad, length = Math.hypot(gx, gy);
        if (length > 1e-4) arrow(context, gx, gy, 14 * length * edge);
        context.lineWidth = 1;
    }

    function arrow(context, gx, gy, reach) {
        const turn = Math.atan2(gy, gx), x = at(state.u), y = at(state.v);
        const end = [x + reach * Math.cos(turn), y + reach * Math.sin(turn)];
        context.beginPath();
        context.moveTo(x, y);
        context.lineTo(...end);
        for (const side of [2.6, -2.6]) {
            context.moveTo(...end);
            context.lineTo(end[0] + 9 * Math.cos(turn + side), end[1] + 9 * Math.sin(turn + side));
        }
        context.stroke();
    }

    function words({ cov, conic, alpha, grad }) {
        const row = (values, decimals) => values.map((value) => number(value, decimals)).join("  ");
        return [
            `covariance, px²   ${row(cov, 2)}`,
            `conic, px⁻²       ${row(conic)}`,
            `alpha there       ${number(alpha)}${alpha < 1 / 255 ? ", not drawn" : ""}`,
            `by centre, px⁻¹   ${row(grad)}`,
        ].join("\n");
    }

    const between = (value, low, high) => Math.min(high, Math.max(low, value));

    function change(values) {
        Object.assign(state, values);
        state.u = between(state.u, 0, WIDE - 1);
        state.v = between(state.v, 0, TALL - 1);
        state.s1 = between(state.s1, 0.3, 6);
        state.x = between(state.x, 0, WIDE - 1);
        state.y = between(state.y, 0, TALL - 1);
        shown.redraw();
    }

    const near = ([x, y], [u, v]) => Math.hypot(x - at(u), y - at(v));
    gsplatPlay.drag(
        shown.canvas,
        (point) => {
            const places = { tip: tip(), centre: [state.u, state.v], pixel: [state.x, state.y] };
            const [name, spot] = Object.entries(places).sort((a, b) => near(point, a[1]) - near(point, b[1]))[0];
            // Far from all marks, the marked pixel goes there.
            held = near(point, spot) < Math.max(22, edge) ? name : "pixel";
            if (held === "pixel") change({ x: Math.floor(point[0] / edge), y: Math.floor(point[1] / edge) });
        },
        ([x, y]) => {
            const [u, v] = [x / edge - 0.5, y / edge - 0.5];
            if (held === "centre") change({ u, v });
            else if (held === "pixel") change({ x: Math.floor(x / edge), y: Math.floor(y / edge) });
            else change({ s1: Math.hypot(u - state.u, v - state.v) / 2, angle: Math.atan2(v - state.v, u - state.u) });
        },
    );
    const longer = () => change({ s1: state.s1 + 0.2 });
    gsplatPlay.keys(shown.canvas, {
        ArrowLeft: () => change({ u: state.u - 0.25 }),
        ArrowRight: () => change({ u: state.u + 0.25 }),
        ArrowUp: () => change({ v: state.v - 0.25 }),
        ArrowDown: () => change({ v: state.v + 0.25 }),
        "+": longer,
        "=": longer,
        "-": () => change({ s1: state.s1 - 0.2 }),
        ",": () => change({ angle: state.angle - 0.1 }),
        ".": () => change({ angle: state.angle + 0.1 }),
        a: () => change({ x: state.x - 1 }),
        d: () => change({ x: state.x + 1 }),
        w: () => change({ y: state.y - 1 }),
        s: () => change({ y: state.y + 1 }),
    });
    const help = "Drag the dot to move the splat and the ring to stretch and turn it; touch a pixel to mark it. Keys: arrows " +
        "move, + and − stretch, comma and full stop turn, W A S D mark a pixel. The lines are at one and two standard " +
        "deviations. Covariance and conic are given as xx, xy, yy. The arrow says where the marked pixel pulls the centre: alpha times the conic times the offset.";
    place.append(shown.canvas, told, element("p", { class: "play-help" }, help));
    return { state, change, told };
};
