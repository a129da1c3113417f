// Chapter 13: from the pixels of two pictures back to the raw numbers of one Gaussian, link by link.
"use strict";

/** A camera of the chapter: at (x, 0, -3), looking along +z. */
gsplatPlay.beside = (x) => ({ eye: [x, 0, -3], fx: 60, fy: 60, wide: 64, tall: 48 });

/** Everything on the way from raw numbers (means, log_scales, quats, logit, sh of degree 0) to one picture. */
gsplatPlay.toScreen = function (one, camera) {
    const { multiply, transposed } = gsplatPlay, p = one.means.map((value, k) => value - camera.eye[k]);
    const u = [(camera.fx * p[0]) / p[2] + camera.wide / 2, (camera.fy * p[1]) / p[2] + camera.tall / 2];
    const J = gsplatPlay.jacobian(p, camera.fx, camera.fy);
    const M = gsplatPlay.stretched(gsplatPlay.rotation(one.quats), one.log_scales.map(Math.exp)), N = multiply(J, M);
    const cov = multiply(N, transposed(N)).map((row, i) => row.map((value, j) => value + (i === j ? 0.3 : 0)));
    const [A, B, C] = gsplatPlay.conic(cov), unfloored = one.sh.map((value) => value / (2 * Math.sqrt(Math.PI)) + 0.5);
    const opacity = 1 / (1 + Math.exp(-one.logit[0])), color = unfloored.map((value) => Math.max(0, value));
    return { p, u, J, M, N, cov, conic: [[A, B], [B, C]], unfloored, opacity, color };
};

/** The alpha of one Gaussian at each pixel: min(0.99, o exp(-d' Lambda d / 2)), zero below 1/255 or where `kept` is zero. */
gsplatPlay.alphas = function ({ u, conic, opacity }, { wide, tall }, kept = null) {
    return Float64Array.from({ length: wide * tall }, (_, i) => {
        const dx = (i % wide) - u[0], dy = Math.floor(i / wide) - u[1];
        const falls = -0.5 * (conic[0][0] * dx * dx + conic[1][1] * dy * dy) - conic[0][1] * dx * dy;
        const alpha = Math.min(0.99, opacity * Math.exp(falls));
        return (kept ? kept[i] > 0 : alpha >= 1 / 255) ? alpha : 0;
    });
};

/** The picture of one Gaussian on black. */
gsplatPlay.painted = function (one, camera, kept = null) {
    const x = gsplatPlay.toScreen(one, camera), alpha = gsplatPlay.alphas(x, camera, kept);
    return Float64Array.from({ length: 3 * alpha.length }, (_, i) => alpha[Math.floor(i / 3)] * x.color[i % 3]);
};

/** The mean squared error of one picture. */
gsplatPlay.lossOf = function (one, camera, photo, kept = null) {
    return gsplatPlay.painted(one, camera, kept).reduce((all, value, i) => all + (value - photo[i]) ** 2, 0) / photo.length;
};

/** The mean squared error of one picture, and its derivatives by all raw numbers: the chapter's links, from the end. */
gsplatPlay.chain = function (one, camera, photo) {
    const { multiply, transposed, unit } = gsplatPlay, x = gsplatPlay.toScreen(one, camera), alpha = gsplatPlay.alphas(x, camera);
    let error = 0, first = [0, 0], colorBar = [0, 0, 0], xx = 0, xy = 0, yy = 0, sum = 0;
    for (let i = 0; i < alpha.length; i++) {
        let facing = 0;
        for (let k = 0; k < 3; k++) {
            const gap = alpha[i] * x.color[k] - photo[3 * i + k], g = (2 * gap) / photo.length;
            error += (gap * gap) / photo.length;
            facing += g * x.color[k];
            colorBar[k] += alpha[i] * g;
        }
        const h = alpha[i] < 0.99 ? alpha[i] * facing : 0, dx = (i % camera.wide) - x.u[0], dy = Math.floor(i / camera.wide) - x.u[1];
        first = [first[0] + h * dx, first[1] + h * dy];
        [xx, xy, yy, sum] = [xx + h * dx * dx, xy + h * dx * dy, yy + h * dy * dy, sum + h];
    }
    const uBar = multiply(x.conic, first.map((value) => [value])).map(([value]) => value);
    // The conic's derivative is -H/2; through the inverse it changes its sign: Sigma_bar = Lambda H Lambda / 2.
    const SigmaBar = multiply(multiply(x.conic, [[xx / 2, xy / 2], [xy / 2, yy / 2]]), x.conic);
    const NBar = multiply(SigmaBar, x.N).map((row) => row.map((value) => 2 * value));
    const MBar = multiply(transposed(x.J), NBar), JBar = multiply(NBar, transposed(x.M));
    const [px, py, z] = x.p, f = [camera.fx, camera.fy], dot = (A, B) => A.reduce((all, row, i) =>
        all + row.reduce((part, value, j) => part + value * B[i][j], 0), 0);
    const rBar = [0, 1].map((i) => f[i] * uBar[i] - (f[i] * JBar[i][2]) / z);
    const scales = one.log_scales.map(Math.exp), RBar = MBar.map((row) => row.map((value, k) => value * scales[k]));
    const n = unit(one.quats), [w, a, b, c] = n.map((value) => 2 * value);
    const nBar = [
        [[0, -c, b], [c, 0, -a], [-b, a, 0]], [[0, b, c], [b, -2 * a, -w], [c, w, -2 * a]],
        [[-2 * b, a, w], [a, 0, c], [-w, c, -2 * b]], [[-2 * c, -w, a], [w, -2 * c, b], [a, b, 0]],
    ].map((slope) => dot(slope, RBar));
    const along = nBar.reduce((all, value, k) => all + value * n[k], 0), length = Math.hypot(...one.quats);
    return {
        error,
        slopes: {
            means: [rBar[0] / z, rBar[1] / z, -((rBar[0] * px + rBar[1] * py) / z + dot(JBar, x.J)) / z],
            log_scales: [0, 1, 2].map((k) => MBar.reduce((all, row, i) => all + row[k] * x.M[i][k], 0)),
            quats: nBar.map((value, k) => (value - n[k] * along) / length),
            logit: [sum * (1 - x.opacity)],
            sh: colorBar.map((value, k) => (x.unfloored[k] > 0 ? value / (2 * Math.sqrt(Math.PI)) : 0)),
        },
    };
};

gsplatPlay.figures.chain = function (place) {
    const { element, number } = gsplatPlay, cameras = [-0.5, 0.5].map(gsplatPlay.beside);
    const hidden = { means: [0.2, -0.2, 0.4], log_scales: [0.6, 0.25, 0.1].map(Math.log), quats: [9, 3, -2, 5], logit: [1.5], sh: [1.2, 0.4, -0.6] };
    const photos = cameras.map((camera) => gsplatPlay.painted(hidden, camera));
    const KINDS = { means: ["mean", 1.5], log_scales: ["log-scale", 3], quats: ["quaternion", 1.5], logit: ["logit", 4], sh: ["colour", 2] };
    const NAMES = Object.entries(KINDS).flatMap(([kind, [name, reach]]) => hidden[kind].map((_, k) =>
        ({ kind, k, reach, name: kind === "logit" ? name : `${name} ${{ means: "xyz", log_scales: "123", quats: "wxyz", sh: "rgb" }[kind][k]}` })));
    const state = { chosen: 0, one: { means: [-0.1, 0.1, -0.3], log_scales: [0.4, 0.3, 0.2].map(Math.log), quats: [1, 0.4, 0, 0.2], logit: [0.5], sh: [0, 0, 0] } };
    const told = element("output", { class: "play-told" }), small = element("canvas", { width: "64", height: "48" });
    const shown = gsplatPlay.canvas((width) => Math.min(width, 520) * 0.375 + 150, draw, {
        tabindex: "0", role: "application", class: "play-drag play-turn",
        "aria-label": "Two photos with a Gaussian, and the loss by one of its numbers. Left and right change the number, up and " +
            "down choose another, S goes downhill.",
    });
    const chosen = () => NAMES[state.chosen], value = () => state.one[chosen().kind][chosen().k];
    const put = (to, { kind, k } = chosen()) => ({ ...state.one, [kind]: state.one[kind].map((old, j) => (j === k ? to : old)) });
    const loss = (one, kept) => cameras.reduce((all, camera, i) => all + gsplatPlay.lossOf(one, camera, photos[i], kept && kept[i]), 0);

    /** The chapter's difference, (4 D(h) - D(2h)) / 3, with the pixels that are drawn now. */
    function difference() {
        const h = 2 ** (-52 / 5), kept = cameras.map((camera) => gsplatPlay.alphas(gsplatPlay.toScreen(state.one, camera), camera));
        const D = (step) => (loss(put(value() + step), kept) - loss(put(value() - step), kept)) / (2 * step);
        return (4 * D(h) - D(2 * h)) / 3;
    }

    const chains = () => cameras.map((camera, i) => gsplatPlay.chain(state.one, camera, photos[i]));
    const added = (found, kind) => found[0].slopes[kind].map((slope, k) => slope + found[1].slopes[kind][k]);

    function draw(context, width) {
        const edge = Math.min(width, 520) / 2, left = width / 2 - edge, high = edge * 0.75, zoom = edge / 64, top = high + 10;
        context.clearRect(0, 0, width, top + 140);
        context.imageSmoothingEnabled = false;
        cameras.forEach((camera, i) => {
            const { u, cov } = gsplatPlay.toScreen(state.one, camera), at = left + i * edge;
            context.drawImage(gsplatPlay.raster(small, photos[i]), at, 0, edge - 4, high);
            context.strokeStyle = "#ffffff"; // on a photo with a black background, in either theme
            context.lineWidth = 2;
            gsplatPlay.outline(context, [at + (u[0] + 0.5) * zoom, (u[1] + 0.5) * zoom], cov, zoom);
        });
        const found = chains(), total = found[0].error + found[1].error, slope = added(found, chosen().kind)[chosen().k];
        const { reach, name } = chosen(), across = (v) => ((v + reach) / (2 * reach)) * width, steps = Array.from({ length: 61 });
        const curve = steps.map((_, i) => -reach + (i / 30) * reach).map((v) => [v, loss(put(v))]);
        const [low, up] = [Math.min(...curve.map(([, l]) => l), total), Math.max(...curve.map(([, l]) => l), total)];
        const down = (l) => top + 125 - (105 * (l - low)) / Math.max(up - low, 1e-9);
        context.fillStyle = context.strokeStyle = gsplatPlay.color("foreground-primary");
        context.beginPath();
        for (const [v, l] of curve) context.lineTo(across(v), down(l));
        context.stroke();
        context.fillText(`loss by ${name}`, 4, top + 10);
        context.strokeStyle = context.fillStyle = gsplatPlay.color("brand-primary");
        context.beginPath();
        for (const side of [-0.25, 0.25]) context.lineTo(across(value() + side * reach), down(total + side * reach * slope));
        context.stroke();
        context.fillRect(across(value()) - 5, down(total) - 5, 10, 10);
        told.textContent = `${name} = ${number(value(), 3)},  loss ${number(total, 5)}\n` +
            `slope by the chain      ${number(slope, 10)}\nslope by differences    ${number(difference(), 10)}`;
    }

    function change(values) {
        Object.assign(state, values);
        select.value = String(state.chosen);
        shown.redraw();
    }

    const move = (to) => change({ one: put(Math.min(chosen().reach, Math.max(-chosen().reach, to))) });
    const choose = (by) => () => change({ chosen: (state.chosen + by + NAMES.length) % NAMES.length });
    function descend() {
        for (let step = 0, found; step < 20; step++) {
            found = chains();
            for (const kind in state.one) state.one[kind] = state.one[kind].map((v, k) => v - 0.5 * added(found, kind)[k]);
        }
        change({});
    }

    const select = element("select", { "aria-label": "number" }, ...NAMES.map(({ name }, i) => element("option", { value: String(i) }, name)));
    select.addEventListener("change", () => change({ chosen: Number(select.value) }));
    const slide = ([x]) => move((2 * x / shown.canvas.clientWidth - 1) * chosen().reach);
    gsplatPlay.drag(shown.canvas, slide, slide);
    const by = (share) => () => move(value() + share * chosen().reach);
    gsplatPlay.keys(shown.canvas, { ArrowLeft: by(-0.02), ArrowRight: by(0.02), ArrowUp: choose(-1), ArrowDown: choose(1), s: descend, S: descend });
    const help = "Drag sideways to change the chosen number; the white ellipse is the Gaussian as both cameras see it. The line is " +
        "the slope that the chain delivers. Differences keep the set of drawn pixels, because a pixel that crosses the floor of " +
        "1/255 makes the loss jump. Keys: left and right change the number, up and down choose one, S takes 20 steps downhill.";
    place.append(shown.canvas, element("div", { class: "play-row" }, select,
        element("button", { type: "button", onclick: descend }, "20 steps downhill")), told, element("p", { class: "play-help" }, help));
    return { state, change, told, difference };
};
