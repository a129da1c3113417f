// Chapter 14: wipe between a held-out photo and its render, or between the photo and the error.
"use strict";

/** Return where the picture lies on a canvas: left edge, width and height, CSS pixels. */
gsplatPlay.wipePlace = function (width, data) {
    const across = Math.min(width, 640);
    return { left: (width - across) / 2, across, tall: (across * data.height) / data.width };
};

gsplatPlay.figures.wipe = function (place) {
    const { element, number } = gsplatPlay, data = window.gsplatData.wipe;
    const state = { view: 0, share: 0.5, error: false };
    const told = element("output", { class: "play-told" });
    const strip = element("img", { src: `${place.dataset.base}wipe.jpg`, alt: "" });
    const shown = gsplatPlay.canvas((width) => gsplatPlay.wipePlace(width, data).tall, draw, {
        role: "img",
        "aria-label": "A held-out photo on the left of a line that can be dragged; on its right the render or the error.",
        class: "play-drag play-turn",
    });
    strip.addEventListener("load", shown.redraw);

    function draw(context, width) {
        const { left, across, tall } = gsplatPlay.wipePlace(width, data);
        if (!strip.complete || !strip.naturalWidth) return;
        const line = state.share * data.width;
        const part = (layer, from, to) => {
            if (to <= from) return;
            const zoom = across / data.width;
            context.drawImage(strip, state.view * data.width + from, layer * data.height, to - from, data.height,
                left + zoom * from, 0, zoom * (to - from), tall);
        };
        part(0, 0, line);
        part(state.error ? 2 : 1, line, data.width);
        const x = left + state.share * across;
        context.fillStyle = "#000000"; // the line and the labels lie on the picture, in either theme
        context.fillRect(x - 2, 0, 4, tall);
        context.fillStyle = "#ffffff";
        context.fillRect(x - 1, 0, 2, tall);
        context.textBaseline = "middle";
        label(context, "photo", left + 6, x - 8, "left");
        label(context, state.error ? "error" : "render", x + 8, left + across - 6, "right");
    }

    /** Write a name at one end of the space between two places, if it has room there. */
    function label(context, text, from, to, side) {
        const wide = context.measureText(text).width + 12;
        if (to - from < wide) return;
        const start = side === "left" ? from : to - wide;
        context.fillStyle = "rgba(0, 0, 0, 0.65)";
        context.fillRect(start, 6, wide, 22);
        context.fillStyle = "#ffffff";
        context.textAlign = "left";
        context.fillText(text, start + 6, 17);
    }

    const wipe = gsplatPlay.slider("line", { min: "0", max: "100", value: "50", step: "1" }, (percent) => {
        state.share = percent / 100;
        return tell();
    });
    const pages = { min: "0", max: String(data.views.length - 1), value: "0", step: "1" };
    const turn = gsplatPlay.slider("view", pages, (view) => {
        state.view = view;
        return tell();
    });
    const box = element("input", { type: "checkbox" });
    box.addEventListener("change", () => {
        state.error = box.checked;
        tell();
    });

    function tell() {
        const { name, psnr } = data.views[state.view], right = state.error ? "error" : "render";
        told.textContent = `${name}, ${number(psnr, 2)} dB: photo ${number(100 * state.share, 0)} %, then ${right}`;
        shown.redraw();
        return told.textContent;
    }

    const move = ([x]) => {
        const { left, across } = gsplatPlay.wipePlace(shown.canvas.clientWidth, data);
        wipe.input.value = String(Math.round(Math.min(100, Math.max(0, (100 * (x - left)) / across))));
        wipe.told();
    };
    gsplatPlay.drag(shown.canvas, move, move);
    const help = "Drag the line in the picture or move the sliders, also with the arrow keys. The views were held out; the " +
        `scene is that of the picture above. The error is black at 0 and white at ${data.brightest} and more.`;
    place.append(shown.canvas, wipe.row, turn.row,
        element("label", { class: "play-row" }, box, "error instead of the render"), told,
        element("p", { class: "play-help" }, help));
    wipe.told();
    turn.told();
    return { state, told, slider: wipe.input };
};
