// One splat as a quad: projection, extent and colour as in native/project.cpp.
//
//     Sigma2d = J W Sigma W' J' + 0.3 I,   u = fx x/z + cx,   colour = max(0, sum_i b_i sh_i + 0.5)

precision highp float;

// One texture per parameter, one texel per splat; for sh, one texel per coefficient.
uniform highp sampler2D means;
uniform highp sampler2D log_scales;
uniform highp isampler2D quats;
uniform highp sampler2D logit_opacities;
uniform highp sampler2D sh;
uniform highp usampler2D order;  // splats, far to near
uniform int first;               // where in the sorted order this draw call begins
uniform int end;                 // place behind the last one
uniform int batch_splats;        // per instance
uniform float thinning;          // of a sample of the splats, see sorted_splats.js; 0 if all are drawn
#ifdef EDITING
uniform highp usampler2D flags;  // 0, 1: selected; above: hidden or deleted
uniform vec3 highlight;          // colour of selected splats
uniform highp usampler2D turned; // which rotation a moved splat has; 0 for none
uniform highp sampler2D turns;   // rows of the rotations, three texels each
uniform int turns_across;        // rotations in a row of that texture; 0 if no splat has one
uniform bool moving;             // whether the selected splats are being moved:
uniform mat3 moving_turn;        // turned about one point, which goes to another one
uniform vec3 moving_from;
uniform vec3 moving_to;
uniform float highlight_share;   // of it in their colour
uniform float kept;              // share of the selected splats that every sample contains
#endif
#ifdef SEEN
uniform highp usampler2D photos_seen;  // number of photos that saw a splat
uniform uint fewest;             // splats that fewer photos saw are tinted, the others grey; 0 for neither
uniform uint faded;              // splats that fewer photos saw are nearly transparent; 0 for none
uniform vec3 tint;
const float FADED = 0.15;        // of their opacity
#endif
uniform int texture_width;
uniform int coefficients;  // stored per splat
uniform int degree;        // drawn

uniform mat3 R;  // world to camera
uniform vec3 eye;
uniform vec2 focal;
uniform vec2 middle;
uniform vec2 size;
uniform vec2 ratio_low;  // bounds of x/z and y/z in the Jacobian
uniform vec2 ratio_high;
uniform vec2 widest;     // largest |x/z| and |y/z| of a mean that is drawn
uniform bool antialiased;
uniform float farthest;  // largest camera depth that is drawn

flat out vec2 mean2d;  // px
flat out vec3 conic;   // (A, B, C) of A dx² + 2 B dx dy + C dy²
flat out vec4 paint;   // colour and opacity

// The rasteriser snaps corners to a grid of 1/16 px or finer; the margin keeps it from losing pixels at the rim. Pixels
// outside the ellipse are discarded anyway.
const float SLACK = 0.125;

const float MOST_ENLARGED = 6.0;

ivec2 texel(int i) {
    return ivec2(i % texture_width, i / texture_width);
}

mat3 rotation(vec4 q) {
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
                2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
                2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));  // columns
}

vec3 coefficient(int splat, int k) {
    return texelFetch(sh, texel(splat * coefficients + k), 0).rgb;
}

vec3 color(int splat, vec3 d) {
    vec3 sum = C0 * coefficient(splat, 0) + SH_OFFSET;
    if (degree < 1) return sum;
    float x = d.x, y = d.y, z = d.z;
    sum += C1 * (-y * coefficient(splat, 1) + z * coefficient(splat, 2) - x * coefficient(splat, 3));
    if (degree < 2) return sum;
    float xx = x * x, yy = y * y, zz = z * z;
    sum += C2[0] * x * y * coefficient(splat, 4) + C2[1] * y * z * coefficient(splat, 5) + C2[3] * x * z * coefficient(splat, 7);
    sum += C2[2] * (2.0 * zz - xx - yy) * coefficient(splat, 6) + C2[4] * (xx - yy) * coefficient(splat, 8);
    if (degree < 3) return sum;
    sum += C3[0] * y * (3.0 * xx - yy) * coefficient(splat, 9) + C3[6] * x * (xx - 3.0 * yy) * coefficient(splat, 15);
    sum += C3[1] * x * y * z * coefficient(splat, 10) + C3[5] * z * (xx - yy) * coefficient(splat, 14);
    sum += (4.0 * zz - xx - yy) * (C3[2] * y * coefficient(splat, 11) + C3[4] * x * coefficient(splat, 13));
    return sum + C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(splat, 12);
}

#ifdef EDITING
// The rotation of a splat since the scene was opened.
mat3 turn_of(ivec2 place) {
    if (turns_across == 0) return mat3(1.0);
    int index = int(texelFetch(turned, place, 0).r);
    ivec2 at = ivec2(3 * (index % turns_across), index / turns_across);
    return transpose(mat3(texelFetch(turns, at, 0).xyz, texelFetch(turns, at + ivec2(1, 0), 0).xyz,
                          texelFetch(turns, at + ivec2(2, 0), 0).xyz));
}
#endif

// By how much a splat of a sample is enlarged, to cover for others; a little less than they covered, as these overlap.
// `least` is a lower bound of the probability that the sample contains it.
float enlarged(vec3 scales, float logit, float least) {
    float area = scales.x * scales.y * scales.z / min(scales.x, min(scales.y, scales.z));
    float chance = clamp(thinning * sqrt(area / (1.0 + exp(-logit))), least, 1.0);
    return min(MOST_ENLARGED, pow(chance, -0.4));
}

// Half the extent of the ellipse d' Sigma2d^-1 d = level along a direction.
float reach(vec2 direction, float a, float b, float c, float level) {
    vec2 squares = direction * direction;
    float variance = a * squares.x + 2.0 * b * direction.x * direction.y + c * squares.y;
    return sqrt(level * variance) + SLACK;
}

void main() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside the clip volume unless the splat is visible
    int rank = first + gl_InstanceID * batch_splats + gl_VertexID / 4;
    if (rank >= end) return;
    int splat = int(texelFetch(order, texel(rank), 0).r);
    ivec2 place = texel(splat);
#ifdef EDITING
    uint flag = texelFetch(flags, place, 0).r;
    if (flag > 1u) return;
#endif
    vec3 mean = texelFetch(means, place, 0).xyz;
#ifdef EDITING
    mat3 turn = turn_of(place);
    if (moving && flag == 1u) {
        mean = moving_turn * (mean - moving_from) + moving_to;
        turn = moving_turn * turn;
    }
#endif
    vec3 offset = mean - eye;
    vec3 p = R * offset;
    if (!(p.z > Z_NEAR && p.z <= farthest)) return;
    if (any(greaterThan(abs(p.xy), widest * p.z))) return;

    vec4 q = vec4(texelFetch(quats, place, 0));
    float length2 = dot(q, q);
    if (length2 == 0.0) return;
    mat3 RS = rotation(q / sqrt(length2));
#ifdef EDITING
    RS = turn * RS;
#endif
    vec3 scales = exp(texelFetch(log_scales, place, 0).xyz);
    float least = 0.0;
#ifdef EDITING
    if (flag == 1u) least = kept;
#endif
    if (thinning > 0.0) scales *= enlarged(scales, texelFetch(logit_opacities, place, 0).r, least);
    RS[0] *= scales.x, RS[1] *= scales.y, RS[2] *= scales.z;

    vec2 ratio = clamp(p.xy / p.z, ratio_low, ratio_high);
    mat3 W = transpose(R);  // its columns are the camera's axes
    vec3 row0 = focal.x / p.z * (W[0] - ratio.x * W[2]) * RS;  // rows of J W R S
    vec3 row1 = focal.y / p.z * (W[1] - ratio.y * W[2]) * RS;
    float a0 = dot(row0, row0), b = dot(row0, row1), c0 = dot(row1, row1);
    vec3 normal = cross(row0, row1);
    float det0 = dot(normal, normal);  // a0 c0 - b², without the cancellation
    float a = a0 + DILATION, c = c0 + DILATION;
    float det = det0 + DILATION * (a0 + c0) + DILATION * DILATION;

    float opacity = 1.0 / (1.0 + exp(-texelFetch(logit_opacities, place, 0).r));
    if (antialiased) opacity *= sqrt(max(det0, DET_FLOOR) / det);
#ifdef SEEN
    if (texelFetch(photos_seen, place, 0).r < faded) opacity *= FADED;
#endif
    if (!(opacity >= ALPHA_MIN && a * c + det < FINITE)) return;

    mean2d = focal * p.xy / p.z + middle;
    float level = 2.0 * log(opacity / ALPHA_MIN);
    vec2 half_box = sqrt(level * vec2(a, c));
    if (any(lessThan(mean2d + half_box, vec2(-1.0))) || any(greaterThan(mean2d - half_box, size))) return;

    vec3 direction = offset / sqrt(dot(offset, offset));
#ifdef EDITING
    direction = direction * turn;  // seen from the splat, whose harmonics turn with it
#endif
    vec3 seen = color(splat, direction);
    if (!(all(lessThanEqual(abs(seen), vec3(COLOR_LIMIT))))) return;
    paint = vec4(max(seen, 0.0), opacity);
#ifdef EDITING
    if (flag == 1u) paint.rgb = mix(paint.rgb, highlight, highlight_share);
#endif
#ifdef SEEN
    if (fewest > 0u) {
        float grey = dot(paint.rgb, vec3(0.299, 0.587, 0.114));  // Rec. 601
        paint.rgb = texelFetch(photos_seen, place, 0).r < fewest ? mix(vec3(grey), tint, 0.75) : vec3(grey);
    }
#endif
    conic = vec3(c, -b, a) / det;

    // The quad is tightest along the ellipse's long axis. A quad in any direction contains the ellipse, so the axis
    // need not be exact.
    float root = sqrt(0.25 * (a - c) * (a - c) + b * b);
    vec2 axis = a > c ? vec2(0.5 * (a - c) + root, b) : vec2(b, 0.5 * (c - a) + root);
    axis = root > 0.0 ? normalize(axis) : vec2(1.0, 0.0);
    vec2 across = vec2(-axis.y, axis.x);
    vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
    vec2 pixel = mean2d + corner.x * reach(axis, a, b, c, level) * axis;
    pixel += corner.y * reach(across, a, b, c, level) * across;
    vec2 device = 2.0 * (pixel + 0.5) / size - 1.0;  // the centre of pixel (0, 0) is half a pixel inside the corner
    gl_Position = vec4(device.x, -device.y, 0.0, 1.0);
}
