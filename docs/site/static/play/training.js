// Chapter 09: scrub through the training. Frames of the held-out camera, the loss and the number of splats.
"use strict";

gsplatPlay.figures.training = function (place) {
    const { element, number } = gsplatPlay, run = window.gsplatData.training;
    const last = run.frames.length - 1, end = run.losses.length;
    const state = { frame: 0 };
    const told = element("output", { class: "play-told" });
    const film = element("img", { src: `${place.dataset.base}frames.jpg`, alt: "" });
    const shown = gsplatPlay.canvas((width) => (width < 560 ? width / 2 + 190 : 280), draw, {
        role: "img",
        "aria-label": "Left, the held-out view during the training; beside it the true view; below or right, the loss.",
    });
    film.addEventListener("load", shown.redraw);

    function draw(context, width, height) {
        const narrow = width < 560, edge = narrow ? width / 2 - 4 : 240;
        const text = gsplatPlay.color("foreground-primary");
        context.fillStyle = text;
        context.textBaseline = "top";
        ["in training", "the truth"].forEach((name, i) => context.fillText(name, i * (edge + 8), 0));
        if (film.complete && film.naturalWidth) {
            [state.frame, last + 1].forEach((frame, i) =>
                context.drawImage(film, frame * run.size, 0, run.size, run.size, i * (edge + 8), 20, edge, edge));
        }
        if (narrow) curve(context, 36, edge + 46, width - 44, height - edge - 72);
        else curve(context, 2 * edge + 56, 20, width - 2 * edge - 64, height - 60);
    }

    function curve(context, left, top, width, height) {
        const text = gsplatPlay.color("foreground-primary"), faint = gsplatPlay.color("foreground-muted");
        const low = Math.log10(0.005), high = Math.log10(0.5);
        const x = (iteration) => left + (width * iteration) / end;
        const y = (loss) => top + (height * (high - Math.log10(loss))) / (high - low);
        context.strokeStyle = faint;
        context.fillStyle = text;
        context.strokeRect(left, top, width, height);
        context.textAlign = "right";
        for (const loss of [0.01, 0.1]) context.fillText(String(loss), left - 4, y(loss) - 6);
        context.textAlign = "center";
        context.fillText("iteration", left + width / 2, top + height + 4);
        context.textAlign = "left";
        context.fillText("0", left, top + height + 4);
        context.textAlign = "right";
        context.fillText(String(end), left + width, top + height + 4);
        context.textAlign = "left";
        context.fillText("L1 of the iteration's view", left, top - 18);
        context.save();
        context.beginPath();
        context.rect(left, top, width, height);
        context.clip();
        context.strokeStyle = gsplatPlay.color("brand-primary");
        context.beginPath();
        run.losses.forEach((loss, i) => context.lineTo(x(i), y(loss)));
        context.stroke();
        context.strokeStyle = text;
        context.beginPath();
        context.moveTo(x(run.frames[state.frame]), top);
        context.lineTo(x(run.frames[state.frame]), top + height);
        context.stroke();
        context.restore();
    }

    const range = { min: "0", max: String(last), value: "0", step: "1" };
    const scrub = gsplatPlay.slider("iteration", range, (frame) => {
        state.frame = frame;
        const iteration = run.frames[frame], count = run.counts[Math.min(iteration, end - 1)];
        const text = `after ${iteration} iterations: ${count} splats, held-out L1 ${number(run.errors[frame], 4)}`;
        told.textContent = text;
        shown.redraw();
        return text;
    });
    const help = "Move the slider, also with the arrow keys. The loss jumps after iterations 400 and 500: two children are a " +
        "worse guess than the parent that was fitted. Trained by the kernels of chapter 12, in the steps of this chapter.";
    place.append(shown.canvas, scrub.row, told, element("p", { class: "play-help" }, help));
    scrub.told();
    return { state, told, slider: scrub.input };
};
