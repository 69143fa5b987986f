// The map from one Gaussian to its footprint up to A = J · W · R diag(s), which the projection and its pullback share.

// Quaternions of smaller squared norm count as the identity, as on the CPU.
const MIN_QUATERNION_NORM2: f32 = 1e-24;

// A column of R diag(s), or of the lower factor, carried to the screen.
struct Column {
    // In camera axes, without the standard deviation.
    v: array<vec2<f32>, 3>,
    // Its screen vector without the standard deviation, px per scene unit.
    ray: array<vec2<f32>, 2>,
    // The standard deviation; 1 for lower factors.
    s: f32,
}

struct Linearised {
    // Mean in camera coordinates.
    p: array<vec2<f32>, 3>,
    inv_z: vec2<f32>,
    // x/z and y/z of the linearisation point, and 1 where they are not at a limit, else 0.
    tangent: array<vec2<f32>, 2>,
    free: vec2<f32>,
    // Unit quaternion x, y, z, w and 1/norm (0 where it counts as the identity).
    q: vec4<f32>,
    inv_norm: f32,
    columns: array<Column, 3>,
}

fn to_camera(m: vec3<f32>, row: vec4<f32>) -> vec2<f32> {
    let xy = pair_add(two_product(m.x, row.x), two_product(m.y, row.y));
    return pair_add(pair_add(xy, two_product(m.z, row.z)), pair_of(row.w));
}

fn limited(raw: vec2<f32>, low: f32, high: f32) -> vec2<f32> {
    if raw.x < low {
        return pair_of(low);
    }
    if raw.x > high {
        return pair_of(high);
    }
    return raw;
}

fn column_of(
    x: vec2<f32>,
    y: vec2<f32>,
    z: vec2<f32>,
    s: f32,
    tangent_x: vec2<f32>,
    tangent_y: vec2<f32>,
    k_x: vec2<f32>,
    k_y: vec2<f32>,
) -> Column {
    var c: Column;
    let v_x = pair_dot(x, y, z, frame.row_x.xyz);
    let v_y = pair_dot(x, y, z, frame.row_y.xyz);
    let v_z = pair_dot(x, y, z, frame.row_z.xyz);
    c.v[0] = v_x;
    c.v[1] = v_y;
    c.v[2] = v_z;
    c.ray[0] = pair_mul(k_x, pair_sub(v_x, pair_mul(tangent_x, v_z)));
    c.ray[1] = pair_mul(k_y, pair_sub(v_y, pair_mul(tangent_y, v_z)));
    c.s = s;
    return c;
}

// 1 − 2(a² + b²).
fn diagonal(a: vec2<f32>, b: vec2<f32>) -> vec2<f32> {
    return pair_sub(pair_of(1.0), 2.0 * pair_add(pair_mul(a, a), pair_mul(b, b)));
}

fn linearise(mean: vec3<f32>, form_a: vec4<f32>, form_b: vec4<f32>) -> Linearised {
    var l: Linearised;
    let p_x = to_camera(mean, frame.row_x);
    let p_y = to_camera(mean, frame.row_y);
    let p_z = to_camera(mean, frame.row_z);
    let inv_z = pair_div(pair_of(1.0), p_z);
    let raw_x = pair_mul(p_x, inv_z);
    let raw_y = pair_mul(p_y, inv_z);
    let t_x = limited(raw_x, frame.tangent_low.x, frame.tangent_high.x);
    let t_y = limited(raw_y, frame.tangent_low.y, frame.tangent_high.y);
    l.p[0] = p_x;
    l.p[1] = p_y;
    l.p[2] = p_z;
    l.inv_z = inv_z;
    l.tangent[0] = t_x;
    l.tangent[1] = t_y;
    l.free = vec2<f32>(select(0.0, 1.0, all(t_x == raw_x)), select(0.0, 1.0, all(t_y == raw_y)));
    let k_x = pair_scale(inv_z, frame.focal.x);
    let k_y = pair_scale(inv_z, frame.focal.y);
    l.q = vec4<f32>(0.0, 0.0, 0.0, 1.0);
    l.inv_norm = 0.0;
    if frame.factors != 0u {
        let zero = vec2<f32>(0.0, 0.0);
        l.columns[0] =
            column_of(pair_of(form_a.x), pair_of(form_a.y), pair_of(form_a.w), 1.0, t_x, t_y, k_x, k_y);
        l.columns[1] = column_of(zero, pair_of(form_a.z), pair_of(form_b.x), 1.0, t_x, t_y, k_x, k_y);
        l.columns[2] = column_of(zero, zero, pair_of(form_b.y), 1.0, t_x, t_y, k_x, k_y);
        return l;
    }
    var x = vec2<f32>(0.0, 0.0);
    var y = x;
    var z = x;
    var w = pair_of(1.0);
    // As bits, so that infinity is large.
    if bitcast<u32>(dot(form_a, form_a)) >= bitcast<u32>(MIN_QUATERNION_NORM2) {
        let largest = max(max(abs(form_a.x), abs(form_a.y)), max(abs(form_a.z), abs(form_a.w)));
        // Squares of numbers scaled to about 1 neither overflow nor lose their low parts.
        let scale = power_of_two(largest, 1.1754944e-38);
        let raw = form_a * scale.y;
        let low = pair_add(two_product(raw.x, raw.x), two_product(raw.y, raw.y));
        let norm2 = pair_add(low, pair_add(two_product(raw.z, raw.z), two_product(raw.w, raw.w)));
        let inv = pair_div(pair_of(1.0), pair_sqrt(norm2));
        x = pair_scale(inv, raw.x);
        y = pair_scale(inv, raw.y);
        z = pair_scale(inv, raw.z);
        w = pair_scale(inv, raw.w);
        l.q = vec4<f32>(x.x, y.x, z.x, w.x);
        l.inv_norm = inv.x * scale.y;
    }
    let xy = pair_mul(x, y);
    let xz = pair_mul(x, z);
    let yz = pair_mul(y, z);
    let wx = pair_mul(w, x);
    let wy = pair_mul(w, y);
    let wz = pair_mul(w, z);
    let s = form_b.xyz;
    l.columns[0] =
        column_of(diagonal(y, z), 2.0 * pair_add(xy, wz), 2.0 * pair_sub(xz, wy), s.x, t_x, t_y, k_x, k_y);
    l.columns[1] =
        column_of(2.0 * pair_sub(xy, wz), diagonal(x, z), 2.0 * pair_add(yz, wx), s.y, t_x, t_y, k_x, k_y);
    l.columns[2] =
        column_of(2.0 * pair_add(xz, wy), 2.0 * pair_sub(yz, wx), diagonal(x, y), s.z, t_x, t_y, k_x, k_y);
    return l;
}
