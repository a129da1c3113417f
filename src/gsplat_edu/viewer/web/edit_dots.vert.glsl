// The centre of a splat as a dot.

precision highp float;

uniform highp sampler2D means;
uniform highp usampler2D flags;  // 0, 1: selected; above: hidden or deleted
uniform uint wanted;             // only splats of this state are drawn
uniform int stride;              // one splat of so many is drawn
uniform int texture_width;
uniform mat3 R;  // world to camera
uniform vec3 eye;
uniform vec2 focal;
uniform vec2 middle;
uniform vec2 size;
uniform float width;  // of a dot, pixels of the canvas

void main() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside the clip volume unless the splat is drawn
    gl_PointSize = width;
    ivec2 place = ivec2(gl_VertexID * stride % texture_width, gl_VertexID * stride / texture_width);
    if (texelFetch(flags, place, 0).r != wanted) return;
    vec3 p = R * (texelFetch(means, place, 0).xyz - eye);
    if (!(p.z > Z_NEAR)) return;
    vec2 device = 2.0 * (focal * p.xy / p.z + middle + 0.5) / size - 1.0;
    gl_Position = vec4(device.x, -device.y, 0.0, 1.0);
}
