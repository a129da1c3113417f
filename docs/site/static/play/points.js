// Chapter 01: points on a ball, a camera around it, and the pixel that each point gets.
"use strict";

/** Camera coordinates x_cam = R (x - eye), and the pixel u = f x/z + c, v = f y/z + c of a point. */
gsplatPlay.pinhole = function (point, { eye, R, size, fx }) {
    const [x, y, z] = R.map((row) => row.reduce((sum, value, k) => sum + value * (point[k] - eye[k]), 0));
    return { x, y, z, u: (fx * x) / z + size / 2, v: (fx * y) / z + size / 2 };
};

/** Round to the nearest pixel; halves go to the even one, as in NumPy. */
gsplatPlay.nearest = function (value) {
    const below = Math.floor(value), share = value - below;
    return share < 0.5 || (share === 0.5 && below % 2 === 0) ? below : below + 1;
};

/** Which point each pixel shows, -1 for none: the nearest one, or the last of the list, among those that cover it.
 *
 *  Without a radius a point covers one pixel, with one all pixels whose centre is within it.
 */
gsplatPlay.owners = function (points, camera, radius = 0, depthTest = true) {
    const { size } = camera, owner = new Int32Array(size * size).fill(-1), depth = new Float64Array(size * size);
    const reach = Math.ceil(radius);
    points.forEach((point, index) => {
        const { u, v, z } = gsplatPlay.pinhole(point, camera);
        if (!(z > 0.05)) return;
        for (let right = -reach; right <= reach; right++) {
            for (let down = -reach; down <= reach; down++) {
                const column = gsplatPlay.nearest(u) + right, row = gsplatPlay.nearest(v) + down;
                if (column < 0 || column >= size || row < 0 || row >= size) continue;
                if (radius && (column - u) ** 2 + (row - v) ** 2 > radius * radius) continue;
                const pixel = row * size + column;
                if (depthTest && owner[pixel] >= 0 && depth[pixel] < z) continue;
                owner[pixel] = index;
                depth[pixel] = z;
            }
        }
    });
    return owner;
};

/** For each pixel the points of the ball's front that it may expect, n a / (4 pi), a = t² / (f² |nu . d|); NaN beside the ball. */
gsplatPlay.expected = function (count, { eye, R, size, fx }) {
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    return Float64Array.from({ length: size * size }, (_, pixel) => {
        const x = ((pixel % size) - size / 2) / fx, y = (Math.floor(pixel / size) - size / 2) / fx;
        const d = [0, 1, 2].map((k) => x * R[0][k] + y * R[1][k] + R[2][k]);
        const a = dot(d, d), b = dot(d, eye), c = dot(eye, eye) - 1, t = (-b - Math.sqrt(b * b - a * c)) / a;
        const slant = Math.abs(dot(d, eye.map((value, k) => value + t * d[k])));
        // Towards the rim the patch of a pixel changes within the pixel: leave it out, as the chapter does.
        return slant / Math.sqrt(a) > 0.4 ? ((count / (4 * Math.PI)) * t * t) / (fx * fx * slant) : NaN;
    });
};

gsplatPlay.figures.points = function (place) {
    const { element, number } = gsplatPlay, SIZE = 96, COUNT = 12_000, MARKED = 7;
    const state = { azimuth: 0, elevation: -0.2, distance: 4, radius: 0, nearest: true };
    const told = element("output", { class: "play-told" }), small = element("canvas", { width: String(SIZE), height: String(SIZE) });
    const ball = gsplatPlay.normals(COUNT, 1).map(gsplatPlay.unit);
    const front = gsplatPlay.unit([-0.35, -0.3, -0.9]); // one point is put where the first camera sees it
    ball[MARKED] = front;
    const colors = ball.map(([x, y, z]) =>
        Math.sin(12 * Math.atan2(x, z)) * Math.sin(12 * Math.acos(y)) > 0 ? [0.95, 0.65, 0.1] : [0, 0.35, 0.65]);
    const shown = gsplatPlay.canvas((width) => Math.min(width, 400), draw, {
        tabindex: "0", role: "application", class: "play-drag play-turn",
        "aria-label": "A ball of points. Arrow keys move the camera around it, plus and minus change its distance, N switches the " +
            "rule of the nearest point.",
    });

    function draw(context, width, height) {
        const camera = gsplatPlay.orbit(state.azimuth, state.elevation, SIZE, 1.25 * SIZE, state.distance);
        const owner = gsplatPlay.owners(ball, camera, state.radius, state.nearest), image = new Float64Array(3 * SIZE * SIZE);
        const lambda = gsplatPlay.expected(COUNT, camera);
        let seen = 0, holes = 0, chance = 0;
        owner.forEach((index, pixel) => {
            if (index >= 0) image.set(colors[index], 3 * pixel);
            if (Number.isNaN(lambda[pixel])) return;
            const facing = index >= 0 && ball[index].reduce((sum, n, k) => sum + n * (camera.eye[k] - n), 0) > 0;
            seen += 1;
            holes += facing ? 0 : 1;
            chance += Math.exp(-lambda[pixel] * (state.radius ? Math.PI * state.radius ** 2 : 1));
        });
        const zoom = height / SIZE, left = (width - height) / 2;
        context.fillStyle = "#000000"; // the scene's background, in either theme
        context.fillRect(0, 0, width, height);
        context.imageSmoothingEnabled = false;
        context.drawImage(gsplatPlay.raster(small, image), left, 0, height, height);
        const { x, y, z, u, v } = gsplatPlay.pinhole(ball[MARKED], camera), pixel = [u, v].map(gsplatPlay.nearest);
        context.strokeStyle = "#ffffff";
        context.lineWidth = 2;
        context.beginPath();
        context.arc(left + (u + 0.5) * zoom, (v + 0.5) * zoom, 7, 0, 2 * Math.PI);
        context.stroke();
        const row = (values, decimals) => values.map((value) => number(value, decimals).padStart(7)).join("");
        const shows = pixel.every((place) => place >= 0 && place < SIZE) && owner[pixel[1] * SIZE + pixel[0]] === MARKED;
        told.textContent = [
            `x, y, z of the ring ${row([x, y, z], 3)}`,
            `u = f x/z + c       ${row([u], 2)}`,
            `v = f y/z + c       ${row([v], 2)}`,
            `its pixel shows     ${shows ? "this point" : "another point"}`,
            `holes in the front  ${row([(100 * holes) / Math.max(seen, 1)], 1)} %`,
            `by e^(−λ)           ${row([(100 * chance) / Math.max(seen, 1)], 1)} %`,
        ].join("\n");
    }

    function change(values) {
        Object.assign(state, values);
        state.elevation = Math.min(1.4, Math.max(-1.4, state.elevation));
        box.checked = state.nearest;
        shown.redraw();
    }

    const turn = (by, up) => () => change({ azimuth: state.azimuth + by, elevation: state.elevation + up });
    gsplatPlay.drag(shown.canvas, () => {}, (_, [dx, dy]) => turn(-dx / 150, -dy / 150)());
    const distance = gsplatPlay.slider("distance", { min: "1.5", max: "20", step: "0.1", value: "4" }, (to) => {
        change({ distance: to });
        return `${number(to, 1)} world units`;
    });
    const radius = gsplatPlay.slider("radius", { min: "0", max: "4", step: "0.25", value: "0" }, (to) => {
        change({ radius: to });
        return to ? `discs of ${number(to, 2)} pixels` : "one pixel";
    });
    const walk = (by) => () => {
        distance.input.value = String(state.distance + by);
        distance.told();
    };
    const box = element("input", { type: "checkbox", checked: true }), rule = () => change({ nearest: !state.nearest });
    box.addEventListener("change", () => change({ nearest: box.checked }));
    gsplatPlay.keys(shown.canvas, {
        ArrowLeft: turn(0.1, 0), ArrowRight: turn(-0.1, 0), ArrowUp: turn(0, 0.1), ArrowDown: turn(0, -0.1),
        "+": walk(-0.5), "=": walk(-0.5), "-": walk(0.5), n: rule, N: rule,
    });
    const help = `Drag to move the camera around ${COUNT.toLocaleString("en")} points of a ball. The ring marks one of them, and the ` +
        "lines below follow it through the pinhole. A hole is a pixel whose front no point has hit: black, or a point of the far " +
        "side. With the nearest point switched off, the later one of the list is shown. Keys: arrows, + and − for the distance, N for the rule.";
    place.append(shown.canvas, distance.row, radius.row, element("label", { class: "play-row" }, box, "the nearest point wins"), told,
        element("p", { class: "play-help" }, help));
    return { state, change, told };
};
