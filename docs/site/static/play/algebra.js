// What several figures compute: products of matrices (arrays of rows), rotations, cameras, ellipses.
"use strict";

Object.assign(gsplatPlay, {
    multiply(A, B) {
        return A.map((row) => B[0].map((_, j) => row.reduce((sum, value, k) => sum + value * B[k][j], 0)));
    },

    transposed(A) {
        return A[0].map((_, j) => A.map((row) => row[j]));
    },

    /** Multiply two quaternions (w, x, y, z). */
    hamilton([w, x, y, z], [s, a, b, c]) {
        return [
            w * s - x * a - y * b - z * c, w * a + s * x + y * c - z * b,
            w * b + s * y + z * a - x * c, w * c + s * z + x * b - y * a,
        ];
    },

    unit(vector) {
        const length = Math.hypot(...vector);
        return vector.map((value) => value / length);
    },

    /** The rotation v -> q v q* of a quaternion, which is divided by its length unless it is taken as it is. */
    rotation(quat, asStored = false) {
        const [w, x, y, z] = asStored ? quat : gsplatPlay.unit(quat);
        return [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ];
    },

    /** The factor R S of a covariance (R S)(R S)'. */
    stretched(R, scales) {
        return R.map((row) => row.map((value, k) => value * scales[k]));
    },

    /** The Jacobian of the pinhole at a mean in camera coordinates; the ratios x/z and y/z may be clamped. */
    jacobian([x, y, z], fx, fy, ratios = [x / z, y / z]) {
        return [[fx / z, 0, (-fx * ratios[0]) / z], [0, fy / z, (-fy * ratios[1]) / z]];
    },

    /** The inverse of a symmetric 2 x 2 matrix given as rows: (xx, xy, yy). */
    conic([[xx, xy], [, yy]]) {
        const det = xx * yy - xy * xy;
        return [yy / det, -xy / det, xx / det];
    },

    /** Draw the ellipse of a covariance (rows, px²) around a place on the canvas; `zoom` is CSS pixels per px. */
    outline(context, [u, v], [[xx, xy], [, yy]], zoom = 1, sigmas = 1) {
        const middle = (xx + yy) / 2, half = Math.hypot((xx - yy) / 2, xy);
        const axes = [middle + half, Math.max(0, middle - half)].map((value) => sigmas * zoom * Math.sqrt(value));
        context.beginPath();
        context.ellipse(u, v, ...axes, 0.5 * Math.atan2(2 * xy, xx - yy), 0, 2 * Math.PI);
        context.stroke();
    },

    /** Pseudo-random numbers in (0, 1), the same on every page: a linear congruential generator whose bits are then mixed. */
    uniforms(count, seed) {
        let now = seed >>> 0;
        return Array.from({ length: count }, () => {
            now = (Math.imul(1664525, now) + 1013904223) >>> 0;
            const mixed = Math.imul(now ^ (now >>> 16), 0x85ebca6b);
            return ((Math.imul(mixed ^ (mixed >>> 13), 0xc2b2ae35) >>> 0) + 0.5) / 2 ** 32;
        });
    },

    /** Normal numbers in groups of three, by the formula of Box and Muller. */
    normals(count, seed) {
        const drawn = gsplatPlay.uniforms(4 * count, seed);
        return Array.from({ length: count }, (_, i) => {
            const [a, b, c, d] = drawn.slice(4 * i, 4 * i + 4);
            const [first, second] = [a, b].map((value) => Math.sqrt(-2 * Math.log(value)));
            return [first * Math.cos(2 * Math.PI * c), first * Math.sin(2 * Math.PI * c), second * Math.cos(2 * Math.PI * d)];
        });
    },

    /** Put an image (values 0 to 1, three a pixel) on a small canvas, which is drawn without smoothing. */
    raster(small, image) {
        const target = small.getContext("2d"), pixels = target.createImageData(small.width, small.height);
        for (let i = 0; i < small.width * small.height; i++) {
            for (let k = 0; k < 3; k++) pixels.data[4 * i + k] = 255 * Math.min(1, Math.max(0, image[3 * i + k])) + 0.5;
            pixels.data[4 * i + 3] = 255;
        }
        target.putImageData(pixels, 0, 0);
        return small;
    },

    /** An orbit camera: eye, and the rows (right, down, forward) of its rotation. */
    orbit(azimuth, elevation, size, fx, radius = 3) {
        const forward = [
            -Math.cos(elevation) * Math.sin(azimuth), -Math.sin(elevation), Math.cos(elevation) * Math.cos(azimuth),
        ];
        const right = [Math.cos(azimuth), 0, Math.sin(azimuth)];
        const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
        return { eye: forward.map((value) => -radius * value), R: [right, cross(forward, right), forward], size, fx };
    },
});
