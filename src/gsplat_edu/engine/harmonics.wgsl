// Real spherical harmonics 1 to 15 in the direction d, and their gradients.

fn harmonic(j: u32, d: vec3<f32>) -> f32 {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    switch j {
        case 1u: { return -C1 * y; }
        case 2u: { return C1 * z; }
        case 3u: { return -C1 * x; }
        case 4u: { return C2_0 * x * y; }
        case 5u: { return C2_1 * y * z; }
        case 6u: { return C2_2 * (2.0 * zz - xx - yy); }
        case 7u: { return C2_3 * x * z; }
        case 8u: { return C2_4 * (xx - yy); }
        case 9u: { return C3_0 * y * (3.0 * xx - yy); }
        case 10u: { return C3_1 * x * y * z; }
        case 11u: { return C3_2 * y * (4.0 * zz - xx - yy); }
        case 12u: { return C3_3 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy); }
        case 13u: { return C3_4 * x * (4.0 * zz - xx - yy); }
        case 14u: { return C3_5 * z * (xx - yy); }
        default: { return C3_6 * x * (xx - 3.0 * yy); }
    }
}

fn harmonic_slope(j: u32, d: vec3<f32>) -> vec3<f32> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    switch j {
        case 1u: { return vec3<f32>(0.0, -C1, 0.0); }
        case 2u: { return vec3<f32>(0.0, 0.0, C1); }
        case 3u: { return vec3<f32>(-C1, 0.0, 0.0); }
        case 4u: { return C2_0 * vec3<f32>(y, x, 0.0); }
        case 5u: { return C2_1 * vec3<f32>(0.0, z, y); }
        case 6u: { return C2_2 * vec3<f32>(-2.0 * x, -2.0 * y, 4.0 * z); }
        case 7u: { return C2_3 * vec3<f32>(z, 0.0, x); }
        case 8u: { return C2_4 * vec3<f32>(2.0 * x, -2.0 * y, 0.0); }
        case 9u: { return C3_0 * vec3<f32>(6.0 * x * y, 3.0 * (xx - yy), 0.0); }
        case 10u: { return C3_1 * vec3<f32>(y * z, x * z, x * y); }
        case 11u: { return C3_2 * vec3<f32>(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z); }
        case 12u: { return C3_3 * vec3<f32>(-6.0 * x * z, -6.0 * y * z, 3.0 * (2.0 * zz - xx - yy)); }
        case 13u: { return C3_4 * vec3<f32>(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z); }
        case 14u: { return C3_5 * vec3<f32>(2.0 * x * z, -2.0 * y * z, xx - yy); }
        default: { return C3_6 * vec3<f32>(3.0 * (xx - yy), -6.0 * x * y, 0.0); }
    }
}

// The same number, which does not exceed i + 16. Mesa's lavapipe inlines uniforms that alone bound a loop, and compiles the
// shader again for each dispatch; a bound that also depends on the Gaussian keeps it from that.
fn bound_of(i: u32, number: u32) -> u32 {
    return min(number, i + 16u);
}

// The colour of a Gaussian seen along d, before the floor at 0: sum_j b_j(d) sh_j + 0.5.
fn color_along(i: u32, d: vec3<f32>) -> vec3<f32> {
    var color = C0 * core3(i * CORE + 10u) + SH_OFFSET;
    let used = bound_of(i, (view.degree + 1u) * (view.degree + 1u));
    for (var j = 1u; j < used; j++) {
        let at = 3u * (i * view.rest + j - 1u);
        color += harmonic(j, d) * vec3<f32>(rest[at], rest[at + 1u], rest[at + 2u]);
    }
    return color;
}
