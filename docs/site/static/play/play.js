// The course's moving figures: what they share. Each figure registers itself under its name and is built in every element
// with the attribute data-play="name". Nothing is loaded: pages also open from disk.
"use strict";

const Play = {
    figures: {},
    live: {}, // the figures on this page, for tests and for readers with a console

    /** Build the figures of the page. */
    start() {
        for (const place of document.querySelectorAll("[data-play]")) {
            const make = Play.figures[place.dataset.play];
            if (make && !place.dataset.built) {
                place.dataset.built = "yes";
                Play.live[place.dataset.play] = make(place);
            }
        }
    },

    /** Make an element with properties and children. */
    element(tag, properties = {}, ...children) {
        const made = document.createElement(tag);
        for (const [name, value] of Object.entries(properties)) {
            if (name in made && typeof value !== "string") made[name] = value;
            else made.setAttribute(name, value);
        }
        made.append(...children);
        return made;
    },

    /** Return a colour of the theme, light or dark, as the page has it now. */
    color(name) {
        return getComputedStyle(document.body).getPropertyValue(`--color-${name}`).trim() || "#888888";
    },

    /** A canvas that is as wide as its place and redrawn when its size or the theme changes. */
    canvas(height, draw, properties = {}) {
        const canvas = Play.element("canvas", properties);
        const redraw = () => {
            const width = canvas.clientWidth, ratio = window.devicePixelRatio || 1;
            if (!width) return;
            const tall = height(width);
            canvas.style.height = `${tall}px`;
            canvas.width = Math.round(width * ratio);
            canvas.height = Math.round(tall * ratio);
            const context = canvas.getContext("2d");
            context.setTransform(ratio, 0, 0, ratio, 0, 0);
            context.font = `13px ${getComputedStyle(document.body).fontFamily}`;
            draw(context, width, tall);
        };
        new ResizeObserver(redraw).observe(canvas);
        new MutationObserver(redraw).observe(document.body, { attributeFilter: ["data-theme"] });
        matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
        return { canvas, redraw };
    },

    /** Report drags with mouse, pen or finger, in CSS pixels from the canvas's corner. */
    drag(canvas, began, moved) {
        const place = (event) => {
            const box = canvas.getBoundingClientRect();
            return [event.clientX - box.left, event.clientY - box.top];
        };
        let held = null;
        canvas.addEventListener("pointerdown", (event) => {
            held = place(event);
            canvas.setPointerCapture(event.pointerId);
            canvas.focus({ preventScroll: true });
            began(held);
            event.preventDefault();
        });
        canvas.addEventListener("pointermove", (event) => {
            if (!held) return;
            const now = place(event);
            moved(now, [now[0] - held[0], now[1] - held[1]]);
            held = now;
        });
        for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (held = null));
    },

    /** Call an action for keys; those without one keep their meaning for the page. */
    keys(canvas, actions) {
        canvas.addEventListener("keydown", (event) => {
            const action = event.ctrlKey || event.metaKey || event.altKey ? null : actions[event.key];
            if (!action) return;
            action();
            event.preventDefault();
        });
    },

    /** A labelled slider; its value text is read aloud. */
    slider(label, range, changed) {
        const input = Play.element("input", { type: "range", ...range });
        const told = () => {
            const text = changed(Number(input.value));
            input.setAttribute("aria-valuetext", text);
        };
        input.addEventListener("input", told);
        return { input, told, row: Play.element("label", { class: "play-row" }, label, input) };
    },

    /** Write a number with a fixed number of decimals and a true minus sign. */
    number(value, decimals = 3) {
        const text = value.toFixed(decimals);
        return (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "\u2212");
    },
};

window.gsplatPlay = Play;
document.addEventListener("DOMContentLoaded", Play.start);
