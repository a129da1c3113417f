// Chapter 10: the naive kernel, an invocation a pixel, on the reader's GPU; mark a pixel and follow its loop.
"use strict";

gsplatPlay.figures.naive = function (place) {
    const { element, number, screen } = gsplatPlay, { program } = window.gsplatData.naive;
    const W = 72, H = 48, MOST = 400, STRIP = 0.22;
    const everything = screen.scatter(MOST, W, H, 10, 2, 5);
    const state = { count: 120, x: 30, y: 20, gpu: null };
    const told = element("output", { class: "play-told" });
    let scale = 1, ours = null;
    const marks = () => everything.subarray(0, screen.MARK * state.count);
    const shown = gsplatPlay.canvas((width) => (width * H * (1 + STRIP)) / W, draw, {
        tabindex: "0",
        role: "application",
        "aria-label": `A picture of ${W} by ${H} pixels. Arrow keys move the marked pixel, ` +
            "plus and minus change the number of splats.",
        class: "play-drag",
    });
    const range = { min: "1", max: String(MOST), step: "1", value: String(state.count) };
    const slider = gsplatPlay.slider("splats", range, (value) => {
        change({ count: value });
        return told.textContent;
    });

    const runner = gsplatPlay.gpu.runner((result, reason) => {
        if (result) {
            const image = new Float32Array(result.found.image);
            state.gpu = { image, passes: result.passes, groups: result.groups, gap: screen.gap(image, 4, ours) };
        } else state.gpu = { reason };
        shown.redraw();
    });

    function compute() {
        ours = screen.dense(marks(), W, H);
        state.gpu = null;
        runner.run({
            program, counts: screen.counts(everything, W, H, 0), view: screen.view(W, H), parts: ["naive"],
            writes: { live: new Uint32Array([state.count, 0, 0, 0]), marks: marks() }, reads: ["image"],
        });
    }

    function draw(context, width) {
        scale = width / W;
        screen.paint(context, state.gpu?.image ?? ours, 4, W, H, width, H * scale);
        context.strokeStyle = "#000000";
        context.lineWidth = 4;
        const square = [state.x * scale, state.y * scale, scale, scale];
        context.strokeRect(...square);
        context.strokeStyle = "#ffffff";
        context.lineWidth = 2;
        context.strokeRect(...square);
        context.lineWidth = 1;
        const walked = screen.walk(screen.all(marks()), state.x, state.y);
        strip(context, walked, width, H * scale, H * scale * STRIP);
        told.textContent = words(walked);
    }

    // The loop of the marked pixel: a bar a splat, as high as its alpha, and the transmittance that is left as a line.
    function strip(context, { steps }, width, top, height) {
        context.fillStyle = gsplatPlay.color("background-primary");
        context.fillRect(0, top, width, height);
        const each = width / state.count, at = (value) => top + height - 3 - value * (height - 12);
        context.fillStyle = gsplatPlay.color("brand-primary");
        context.strokeStyle = gsplatPlay.color("foreground-primary");
        context.beginPath();
        context.moveTo(0, at(1));
        let before = 1;
        for (const { i, alpha, T } of steps) {
            context.fillRect(i * each, at(alpha), Math.max(each, 2), at(0) - at(alpha));
            context.lineTo(i * each, at(before));
            context.lineTo((i + 1) * each, at(T));
            before = T;
        }
        context.lineTo(width, at(before));
        context.stroke();
    }

    function words({ color, T, steps }) {
        const evaluations = W * H * state.count;
        const place = state.y * W + state.x;
        const lines = [
            `pixel (${state.x}, ${state.y}): invocation ${place % 64} of workgroup ${Math.floor(place / 64)}`,
            `it reads ${state.count} splats; ${steps.length} are above the floor; T falls to ${number(T)}`,
            `colour ${color.map((value) => number(value)).join("  ")}`,
            `${W * H} pixels x ${state.count} splats = ${evaluations.toLocaleString("en")} evaluations`,
        ];
        return [...lines, gpuWords()].join("\n");
    }

    function gpuWords() {
        const { gpu } = state;
        if (!gpu) return "…";
        if (!gpu.image) return gpu.reason;
        return `GPU: ${gpu.passes} pass, ${gpu.groups} workgroups of 64; the image differs from JavaScript's float64 by ` +
            `${gpu.gap.toExponential(0)} at most`;
    }

    const between = (value, low, high) => Math.min(high, Math.max(low, value));

    function change(values) {
        const before = state.count;
        Object.assign(state, values);
        state.count = between(state.count, 1, MOST);
        state.x = between(state.x, 0, W - 1);
        state.y = between(state.y, 0, H - 1);
        if (state.count !== before) compute();
        slider.input.value = String(state.count);
        shown.redraw();
    }

    const mark = ([x, y]) => change({ x: Math.floor(x / scale), y: Math.floor(y / scale) });
    gsplatPlay.drag(shown.canvas, mark, mark);
    shown.canvas.addEventListener("pointermove", (event) => {
        if (event.pointerType === "mouse" && !event.buttons) mark([event.offsetX, event.offsetY]);
    });
    const step = (dx, dy) => () => change({ x: state.x + dx, y: state.y + dy });
    const more = (by) => () => change({ count: state.count + by });
    gsplatPlay.keys(shown.canvas, {
        ArrowLeft: step(-1, 0), ArrowRight: step(1, 0), ArrowUp: step(0, -1), ArrowDown: step(0, 1),
        "+": more(10), "=": more(10), "-": more(-10),
    });
    const help = "Point at a pixel, touch one or move the mark with the arrow keys. Below the picture is the pixel's loop, near " +
        "to far: a bar is the alpha of a splat, and the line the transmittance that is left. Most splats are read for nothing.";
    place.append(shown.canvas, slider.row, told, element("p", { class: "play-help" }, help));
    compute();
    return { state, change, told, marks, idle: runner.idle };
};
