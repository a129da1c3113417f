// Chapter 09: move the threshold of densification and see which splats are cloned, which are split.
"use strict";

/** Decide like the course's rule; rows are u, v, xx, xy, yy, mean gradient, largest scale, opacity, and 1 for the near half. */
gsplatPlay.fates = function (data, threshold) {
    const fates = data.splats.map(([, , , , , gradient, size, opacity]) => {
        if (opacity < data.faint) return "pruned";
        if (gradient <= threshold) return "kept";
        return size > data.large ? "split" : "cloned";
    });
    const counts = { kept: 0, cloned: 0, split: 0, pruned: 0 };
    for (const fate of fates) counts[fate]++;
    const total = Math.min(data.cap, counts.kept + 2 * counts.cloned + 2 * counts.split);
    return { fates, counts, total };
};

gsplatPlay.figures.density = function (place) {
    const { element } = gsplatPlay, data = window.gsplatData.density;
    const state = { threshold: data.threshold };
    const told = element("output", { class: "play-told" });
    // The colours of the course's figures (safe for colour-blind readers), and a pattern of lines for each.
    const LOOKS = {
        kept: ["foreground-muted", [], 1], cloned: ["#009e73", [], 2], split: ["#d55e00", [], 2], pruned: ["#cc79a7", [3, 3], 1],
    };
    const shown = gsplatPlay.canvas((width) => Math.min(width, 480), draw, {
        role: "img",
        "aria-label": "The splats of the held-out view, coloured by what densification does with them.",
    });

    function draw(context, width, height) {
        const zoom = height / data.size, left = (width - height) / 2;
        const { fates, counts } = gsplatPlay.fates(data, state.threshold);
        for (const fate of ["kept", "pruned", "cloned", "split"]) {
            const [color, dash, thick] = LOOKS[fate];
            context.strokeStyle = color.startsWith("#") ? color : gsplatPlay.color(color);
            context.setLineDash(dash);
            context.lineWidth = thick;
            data.splats.forEach(([u, v, xx, xy, yy, , , , near], i) => {
                if (fates[i] !== fate) return;
                context.globalAlpha = near ? 1 : 0.12;
                const middle = (xx + yy) / 2, half = Math.hypot((xx - yy) / 2, xy);
                const axes = [middle + half, Math.max(middle - half, 0)].map((value) => Math.sqrt(value) * zoom);
                context.beginPath();
                context.ellipse(left + (u + 0.5) * zoom, (v + 0.5) * zoom, ...axes, 0.5 * Math.atan2(2 * xy, xx - yy),
                    0, 2 * Math.PI);
                context.stroke();
            });
        }
        context.globalAlpha = 1;
        context.setLineDash([]);
        context.textBaseline = "top";
        ["cloned", "split", "pruned", "kept"].forEach((fate, i) => {
            const color = LOOKS[fate][0];
            context.fillStyle = color.startsWith("#") ? color : gsplatPlay.color("foreground-primary");
            context.fillText(`${fate} ${counts[fate]}`, 0, 17 * i);
        });
    }

    const range = { min: "-5", max: "-2.5", step: "0.01", value: String(Math.log10(data.threshold).toFixed(2)) };
    const move = gsplatPlay.slider("threshold", range, (exponent) => {
        // The slider's steps are hundredths of a power of ten; the course's own threshold is met exactly.
        const near = Math.abs(exponent - Math.log10(data.threshold)) < 0.006;
        state.threshold = near ? data.threshold : 10 ** exponent;
        const { counts, total } = gsplatPlay.fates(data, state.threshold);
        const value = state.threshold.toExponential(1).replace("-", "\u2212");
        const text = `threshold ${value}: ${counts.cloned} cloned, ${counts.split} split, ${counts.pruned} pruned; ` +
            `${data.splats.length} splats become ${total}`;
        told.textContent = text;
        shown.redraw();
        return text;
    });
    const help = `The splats of the held-out view before the densification after iteration ${data.iteration}, drawn at one ` +
        "standard deviation; those on the far side are faint. The threshold is a mean gradient by the position in the image, where the image is two units " +
        "wide. Where did the training pull most: inside the sphere, or at its edge?";
    place.append(shown.canvas, move.row, told, element("p", { class: "play-help" }, help));
    move.told();
    return { state, told, slider: move.input };
};
