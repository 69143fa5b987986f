// image_terms: every term of the objective on one view beside the photometric one, and the gradient of all by the shaded picture
// [eq:mask-bce] [eq:normal] [eq:pseudo-normal] [eq:smoothness] [eq:enhancement] [eq:incident]. After frame.wgsl, elementary.wgsl.
//
// A thread per pixel. What a pixel adds to its neighbours' gradients they gather themselves, so that nothing is added by two threads.

// `ImageTerms` in image_terms.rs: each weight over what it is a mean of, times the share of the batch.
struct ImageTerms {
    // 1: there is a mask.
    masked: u32,
    // 1: there is such a term.
    pseudo: u32,
    mask: f32,
    normal: f32,
    smooth_base_color: f32,
    smooth_metalness: f32,
    smooth_roughness: f32,
    smooth_subsurfaceness: f32,
    enhancement: f32,
    incident: f32,
    // From one array of values to the next.
    stride: u32,
    unused_0: u32,
}

@group(0) @binding(1) var<storage, read> terms: ImageTerms;
// 24 numbers per pixel, as `shade` writes them.
@group(0) @binding(2) var<storage, read> record: array<vec4<f32>>;
// Linear RGB of the photograph, and its mask (1 where there is none).
@group(0) @binding(3) var<storage, read> photograph: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> coverage: array<vec4<f32>>;
// Gradient of the photometric term by the radiance.
@group(0) @binding(5) var<storage, read> d_linear: array<f32>;
// As `shade_pull` reads it: 18 numbers per pixel, the opacity's own cotangent, and one of padding.
@group(0) @binding(6) var<storage, read_write> d_record: array<vec4<f32>>;
// Three arrays: mask, normal, smooth base colour, metalness | roughness, subsurfaceness, enhancement, incident | squared error in
// display sRGB.
@group(0) @binding(7) var<storage, read_write> values: array<vec4<f32>>;

// As on the CPU, where each reason is said.
const MARGIN: f32 = 1e-6;
const MIN_COVERAGE: f32 = 0.5;
const MIN_SINE: f32 = 1e-6;
const SMALLEST: f32 = 1.1754944e-38;

struct Maps {
    base_color: vec3<f32>,
    roughness: f32,
    metalness: f32,
    subsurfaceness: f32,
    normal: vec3<f32>,
    incident: f32,
    visibility: f32,
}

fn maps_of(i: u32) -> Maps {
    let r2 = record[6u * i + 2u];
    let r3 = record[6u * i + 3u];
    let r4 = record[6u * i + 4u];
    let r5 = record[6u * i + 5u];
    return Maps(r2.yzw, r3.x, r3.y, r3.z, vec3<f32>(r3.w, r4.xy), r5.y, r5.z);
}

fn through(x: u32, y: u32) -> vec3<f32> {
    return vec3<f32>((vec2<f32>(f32(x), f32(y)) + 0.5 - frame.principal) / frame.focal, 1.0);
}

// The normal of the depth around a pixel, world; 0 where there is none.
fn pseudo_normal(x: u32, y: u32) -> vec3<f32> {
    if x == 0u || y == 0u || x + 1u >= frame.size.x || y + 1u >= frame.size.y {
        return vec3<f32>(0.0);
    }
    var a = vec3<f32>(0.0);
    var b = vec3<f32>(0.0);
    for (var j = 0u; j < 3u; j++) {
        for (var i = 0u; i < 3u; i++) {
            let u = x + i - 1u;
            let v = y + j - 1u;
            let n = v * frame.size.x + u;
            let z = record[6u * n + 5u].w;
            if !(coverage[n].x > MIN_COVERAGE && z > 0.0) {
                return vec3<f32>(0.0);
            }
            let p = through(u, v) * z;
            a += p * ((f32(i) - 1.0) * select(0.125, 0.25, j == 1u));
            b += p * ((f32(j) - 1.0) * select(0.125, 0.25, i == 1u));
        }
    }
    let across = cross(a, b);
    let area = sqrt(dot(across, across));
    let spans = area > MIN_SINE * sqrt(dot(a, a)) * sqrt(dot(b, b)) && area > SMALLEST;
    if !(spans && dot(across, through(x, y)) > 0.0) {
        return vec3<f32>(0.0);
    }
    let n = -across / area;
    return n.x * frame.row_x.xyz + n.y * frame.row_y.xyz + n.z * frame.row_z.xyz;
}

// Gradients and values of the four smooth maps by one pair of neighbours.
struct Smooth {
    base_color: vec3<f32>,
    others: vec3<f32>,
    values: vec4<f32>,
}

// Of pixel i, which is the first of the pair or the second.
fn pair_of_pixels(i: u32, j: u32, here: Maps, second: bool) -> Smooth {
    let p = photograph[i];
    let r = photograph[j];
    let edge = abs(r.xyz - p.xyz);
    let weight = p.w * r.w * exp_of(-(edge.x + edge.y + edge.z) / 3.0);
    let there = maps_of(j);
    // Of a difference (second − first) the first's share is −sign.
    let color = here.base_color - there.base_color;
    let other = vec3<f32>(
        here.metalness - there.metalness,
        here.roughness - there.roughness,
        here.subsurfaceness - there.subsurfaceness,
    );
    var out: Smooth;
    out.base_color = weight * sign(color);
    out.others = weight * sign(other);
    // Each pair counts once, at its first pixel.
    let size = vec4<f32>(abs(color.x) + abs(color.y) + abs(color.z), abs(other));
    out.values = select(weight * size, vec4<f32>(0.0), second);
    return out;
}

fn display(linear: f32) -> f32 {
    let v = clamp(linear, 0.0, 1.0);
    return select(1.055 * pow(v, 1.0 / 2.4) - 0.055, 12.92 * v, v <= 0.0031308);
}

@compute @workgroup_size(256)
fn image_terms(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= frame.size.x * frame.size.y {
        return;
    }
    let x = i % frame.size.x;
    let y = i / frame.size.x;
    let here = maps_of(i);
    let target_pixel = photograph[i];
    let inside = target_pixel.w;
    let opacity = coverage[i].x;

    // Mask. The distance from the upper end by itself: 1 − (1 − 1e-6) keeps two digits.
    var mask_value = 0.0;
    var d_opacity = 0.0;
    if terms.masked != 0u {
        let free = max(1.0 - opacity, MARGIN);
        let cut = max(opacity, MARGIN);
        mask_value = -(inside * log(cut) + (1.0 - inside) * log(free));
        let passes = opacity > MARGIN && 1.0 - opacity > MARGIN;
        d_opacity = select(0.0, terms.mask * (opacity - inside) / (cut * free), passes);
    }

    // Normals.
    var normal_value = 0.0;
    var d_normal = vec3<f32>(0.0);
    if terms.pseudo != 0u {
        let pseudo = pseudo_normal(x, y);
        if any(pseudo != vec3<f32>(0.0)) {
            let d = here.normal - pseudo;
            normal_value = inside * dot(d, d);
            d_normal = (2.0 * terms.normal * inside) * d;
        }
    }

    // Smoothness.
    var smooth_sum: Smooth;
    if x + 1u < frame.size.x {
        let s = pair_of_pixels(i, i + 1u, here, false);
        smooth_sum = Smooth(smooth_sum.base_color + s.base_color, smooth_sum.others + s.others, smooth_sum.values + s.values);
    }
    if y + 1u < frame.size.y {
        let s = pair_of_pixels(i, i + frame.size.x, here, false);
        smooth_sum = Smooth(smooth_sum.base_color + s.base_color, smooth_sum.others + s.others, smooth_sum.values + s.values);
    }
    if x > 0u {
        let s = pair_of_pixels(i, i - 1u, here, true);
        smooth_sum = Smooth(smooth_sum.base_color + s.base_color, smooth_sum.others + s.others, smooth_sum.values + s.values);
    }
    if y > 0u {
        let s = pair_of_pixels(i, i - frame.size.x, here, true);
        smooth_sum = Smooth(smooth_sum.base_color + s.base_color, smooth_sum.others + s.others, smooth_sum.values + s.values);
    }
    let smooth_steps = vec3<f32>(terms.smooth_metalness, terms.smooth_roughness, terms.smooth_subsurfaceness);
    var d_base_color = terms.smooth_base_color * smooth_sum.base_color;
    let d_others = smooth_steps * smooth_sum.others;

    // Enhancement.
    let g = clamp(target_pixel.xyz, vec3<f32>(0.0), vec3<f32>(1.0));
    let w = sigmoid_of(5.0 * (max(max(g.x, g.y), g.z) - 0.5));
    let enhanced = w * g * g + (1.0 - w) * (1.0 - (1.0 - g) * (1.0 - g));
    let apart = here.base_color - enhanced;
    let enhancement_value = inside * (abs(apart.x) + abs(apart.y) + abs(apart.z));
    d_base_color += (terms.enhancement * inside) * sign(apart);

    // Incident light.
    let arriving = clamp(here.incident, 0.0, 1.0) - here.visibility;
    let free_incident = here.incident >= 0.0 && here.incident <= 1.0;
    let d_incident = select(0.0, terms.incident * sign(arriving), free_incident);

    let rgb = record[6u * i].xyz;
    var error = 0.0;
    for (var c = 0u; c < 3u; c++) {
        let e = display(rgb[c]) - display(target_pixel[c]);
        error += e * e;
    }
    values[i] = vec4<f32>(mask_value, normal_value, smooth_sum.values.xy);
    values[terms.stride + i] = vec4<f32>(smooth_sum.values.zw, enhancement_value, abs(arriving));
    values[2u * terms.stride + i] = vec4<f32>(error, 0.0, 0.0, 0.0);
    let d_rgb = vec3<f32>(d_linear[3u * i], d_linear[3u * i + 1u], d_linear[3u * i + 2u]);
    // Radiance, base colour, roughness, metalness, subsurfaceness, normal, residual, incident, visibility, depth, opacity.
    d_record[5u * i] = vec4<f32>(d_rgb, d_base_color.x);
    d_record[5u * i + 1u] = vec4<f32>(d_base_color.yz, d_others.y, d_others.x);
    d_record[5u * i + 2u] = vec4<f32>(d_others.z, d_normal);
    d_record[5u * i + 3u] = vec4<f32>(0.0, 0.0, 0.0, d_incident);
    d_record[5u * i + 4u] = vec4<f32>(0.0, 0.0, d_opacity, 0.0);
}
