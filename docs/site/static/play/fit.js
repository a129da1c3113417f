// Chapter 08: fit splats to a photo. Render, compare, go back, step: the chapter's formulas, in double precision.
"use strict";

/** Composite splats (rows u, v, log s1, log s2, angle, r, g, b, logit; near to far) on black, and keep what goes back needs. */
gsplatPlay.render2d = function (splats, wide, tall) {
    const count = wide * tall, image = new Float64Array(3 * count), T = new Float64Array(count).fill(1);
    const seen = splats.map(([u, v, a, b, angle, red, green, blue, logit]) => {
        const R = [[Math.cos(angle), -Math.sin(angle)], [Math.sin(angle), Math.cos(angle)]];
        const M = gsplatPlay.stretched(R, [Math.exp(a), Math.exp(b)]);
        const [[xx, xy], [, yy]] = gsplatPlay.multiply(M, gsplatPlay.transposed(M));
        const cov = [[xx + 0.3, xy], [xy, yy + 0.3]], conic = gsplatPlay.conic(cov), opacity = 1 / (1 + Math.exp(-logit));
        const before = Float64Array.from(T), alpha = new Float64Array(count);
        for (let i = 0; i < count; i++) {
            const dx = (i % wide) - u, dy = Math.floor(i / wide) - v;
            const falls = -0.5 * (conic[0] * dx * dx + conic[2] * dy * dy) - conic[1] * dx * dy;
            const value = Math.min(0.99, opacity * Math.exp(falls));
            if (value < 1 / 255) continue;
            alpha[i] = value;
            [red, green, blue].forEach((c, k) => (image[3 * i + k] += T[i] * value * c));
            T[i] *= 1 - value;
        }
        return { M, cov, conic, opacity, before, alpha };
    });
    return { image, seen };
};

/** The mean squared error, and its slope by every number of every splat. */
gsplatPlay.slopes2d = function (splats, { image, seen }, photo, wide) {
    const { multiply } = gsplatPlay, g = image.map((value, i) => (2 * (value - photo[i])) / photo.length);
    const error = image.reduce((sum, value, i) => sum + (value - photo[i]) ** 2, 0) / photo.length;
    const behind = new Float64Array(photo.length / 3);
    for (let i = 0; i < photo.length; i++) behind[Math.floor(i / 3)] += g[i] * image[i];
    const slopes = seen.map(({ M, conic, opacity, before, alpha }, n) => {
        const [u, v, , , , ...rest] = splats[n], color = [0, 0, 0];
        const moments = [0, 0, 0, 0, 0, 0];
        for (let i = 0; i < alpha.length; i++) {
            if (!alpha[i]) continue;
            const facing = g[3 * i] * rest[0] + g[3 * i + 1] * rest[1] + g[3 * i + 2] * rest[2], weight = before[i] * alpha[i];
            for (let k = 0; k < 3; k++) color[k] += weight * g[3 * i + k];
            behind[i] -= weight * facing;
            if (alpha[i] >= 0.99) continue;
            const h = alpha[i] * (before[i] * facing - behind[i] / (1 - alpha[i]));
            const dx = (i % wide) - u, dy = Math.floor(i / wide) - v;
            [1, dx, dy, dx * dx, dx * dy, dy * dy].forEach((moment, k) => (moments[k] += h * moment));
        }
        const [sum, hx, hy, xx, xy, yy] = moments, conics = [[conic[0], conic[1]], [conic[1], conic[2]]];
        const mean = multiply(conics, [[hx], [hy]]).map(([value]) => value);
        const factor = [[[xx, xy], [xy, yy]], conics, M].reduce((A, B) => multiply(A, B), conics); // Lambda H Lambda M
        const scales = [0, 1].map((k) => factor[0][k] * M[0][k] + factor[1][k] * M[1][k]);
        const angle = [0, 1].reduce((all, k) => all - factor[0][k] * M[1][k] + factor[1][k] * M[0][k], 0);
        return [...mean, ...scales, angle, ...color, (1 - opacity) * sum];
    });
    return { error, slopes };
};

gsplatPlay.RATES = [0.8, 0.8, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05, 0.1];

/** One step of Adam on all numbers, or of plain descent at one rate; returns the new splats, and changes `memory`. */
gsplatPlay.stepped = function (splats, slopes, memory, plain = 0) {
    memory.t += 1;
    const [b1, b2] = [1 - 0.9 ** memory.t, 1 - 0.999 ** memory.t];
    return splats.map((row, n) => row.map((value, j) => {
        const g = slopes[n][j];
        if (plain) return value - plain * g;
        memory.m[n][j] = 0.9 * memory.m[n][j] + 0.1 * g;
        memory.v[n][j] = 0.999 * memory.v[n][j] + 0.001 * g * g;
        return value - (gsplatPlay.RATES[j] * memory.m[n][j]) / b1 / (Math.sqrt(memory.v[n][j] / b2) + 1e-12);
    }));
};

gsplatPlay.figures.fit = function (place) {
    const { element, number } = gsplatPlay, { wide, tall, pixels, start } = window.gsplatData.fit;
    const photo = Float64Array.from(atob(pixels), (letter) => letter.charCodeAt(0) / 255), PLAIN = 0.025 * photo.length;
    const state = { steps: 0, plain: false, running: false, losses: [] };
    const told = element("output", { class: "play-told" }), smalls = [0, 1].map(() => element("canvas", { width: String(wide), height: String(tall) }));
    let splats, memory, drawn;
    const shown = gsplatPlay.canvas((width) => ((Math.min(width, 600) / 3) * tall) / wide + 130, draw, {
        tabindex: "0", role: "application", class: "play-turn",
        "aria-label": "A photo, the picture of the splats, their ellipses, and the error by steps. The right arrow takes a " +
            "step, the space bar runs, R starts again.",
    });

    function restart() {
        Object.assign(state, { steps: 0, losses: [], running: false });
        splats = start;
        const zeros = () => start.map((row) => row.map(() => 0));
        memory = { t: 0, m: zeros(), v: zeros() };
        look(start);
    }

    function look(before) {
        const rendered = gsplatPlay.render2d(splats, wide, tall);
        const { error, slopes } = gsplatPlay.slopes2d(splats, rendered, photo, wide);
        drawn = { rendered, slopes, before };
        state.losses.push(error);
        name();
        shown.redraw();
    }

    function step() {
        const before = splats;
        splats = gsplatPlay.stepped(splats, drawn.slopes, memory, state.plain ? PLAIN : 0);
        state.steps += 1;
        look(before);
    }

    function draw(context, width) {
        const edge = Math.min(width, 600) / 3, zoom = edge / wide, high = tall * zoom, left = (width - 3 * edge) / 2;
        const line = gsplatPlay.color("foreground-primary");
        context.clearRect(0, 0, width, high + 130);
        context.imageSmoothingEnabled = false;
        [photo, drawn.rendered.image].forEach((image, i) =>
            context.drawImage(gsplatPlay.raster(smalls[i], image), left + i * edge, 0, edge - 4, high));
        context.save();
        context.beginPath();
        context.rect(left + 2 * edge, 0, edge, high);
        context.clip();
        context.fillStyle = "#555555"; // grey behind colours of the photo, in either theme
        context.fill();
        drawn.rendered.seen.forEach(({ cov }, n) => {
            const [u, v, , , , ...rest] = splats[n], at = [left + 2 * edge + (u + 0.5) * zoom, (v + 0.5) * zoom];
            context.strokeStyle = `rgb(${rest.slice(0, 3).map((c) => Math.round(255 * Math.min(1, Math.max(0, c)))).join()})`;
            gsplatPlay.outline(context, at, cov, zoom);
            context.strokeStyle = "#ffffff";
            context.beginPath(); // five times the last step
            context.moveTo(...at);
            context.lineTo(at[0] + 5 * zoom * (u - drawn.before[n][0]), at[1] + 5 * zoom * (v - drawn.before[n][1]));
            context.stroke();
        });
        context.restore();
        const top = high + 22, reach = Math.max(50, state.losses.length - 1);
        const row = (error) => top + 92 * Math.min(1, Math.log(state.losses[0] / error) / Math.log(60) + 0.1);
        context.strokeStyle = line;
        context.strokeRect(0.5, top - 6.5, width - 1, 106);
        context.fillStyle = line;
        context.fillText("mean squared error (logarithmic)", 8, top + 90);
        context.lineWidth = 2;
        context.beginPath();
        state.losses.forEach((error, i) => context.lineTo(4 + ((width - 8) * i) / reach, row(error)));
        context.stroke();
        context.lineWidth = 1;
        const error = state.losses.at(-1), moved = drawn.before.map((r, n) => Math.hypot(splats[n][0] - r[0], splats[n][1] - r[1]));
        told.textContent = `step ${state.steps}  error ${number(error, 5)}  ${number(-10 * Math.log10(error), 2)} dB\n` +
            `the last step moved a centre by ${number(moved.reduce((a, b) => a + b, 0) / moved.length, 3)} px in the mean`;
    }

    const name = () => (run.textContent = state.running ? "pause" : "run");
    const frame = () => state.running && requestAnimationFrame(() => state.running && (step(), frame()));

    function toggle() {
        state.running = !state.running;
        name();
        frame();
    }

    const button = (text, onclick) => element("button", { type: "button", onclick }, text);
    const run = button("run", toggle), box = element("input", { type: "checkbox" });
    box.addEventListener("change", () => ((state.plain = box.checked), restart()));
    gsplatPlay.keys(shown.canvas, { ArrowRight: step, " ": toggle, r: restart, R: restart });
    const help = `Left to right: the photo of ${wide} by ${tall} pixels, the picture of ${start.length} splats, and their ` +
        "ellipses with five times the last step of each centre. One step changes all nine numbers of every splat. With one " +
        "rate for all numbers, colours learn and centres hardly move. Keys: the right arrow steps, the space bar runs, R starts again.";
    place.append(shown.canvas, element("div", { class: "play-row" }, button("step", step), run, button("start again", restart)),
        element("label", { class: "play-row" }, box, "one rate for all numbers"), told,
        element("p", { class: "play-help" }, help));
    restart();
    return { state, told, step, splats: () => splats };
};
