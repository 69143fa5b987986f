// One row of what the residual network is told [eq:residual-inputs] [eq:positional-encoding]. After frame.wgsl, elementary.wgsl,
// model_view.wgsl.

@group(0) @binding(1) var<storage, read> view: ModelView;
@group(0) @binding(2) var<storage, read> means: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> form_a: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> form_b: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> features: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> codes: array<f32>;
@group(0) @binding(8) var<storage, read_write> inputs: array<f32>;

// As on the CPU, where each reason is said.
const MAGNITUDE_LIMIT: f32 = 1e12;
const MIN_QUATERNION: f32 = 1e-12;

fn put(at: u32, v: vec3<f32>) {
    inputs[at] = v.x;
    inputs[at + 1u] = v.y;
    inputs[at + 2u] = v.z;
}

fn normal_of(i: u32) -> vec3<f32> {
    return vec3<f32>(features[4u * i + 1u].zw, features[4u * i + 2u].x);
}

// Of Gaussian i; a light at infinity has the distance −1.
fn write_row(row: u32, i: u32, viewer: vec3<f32>, light: vec3<f32>, distance: f32, seen: f32) {
    let at = row * view.width;
    let limit = vec3<f32>(MAGNITUDE_LIMIT);
    let x = clamp((means[i].xyz - view.centre) * view.inverse_half, -limit, limit);
    let reduced = x - 2.0 * round(0.5 * x);
    for (var axis = 0u; axis < 3u; axis++) {
        var turn = sin_cos_pi(reduced[axis]);
        for (var k = 0u; k < 4u; k++) {
            inputs[at + 6u * k + axis] = turn.x;
            inputs[at + 6u * k + 3u + axis] = turn.y;
            turn = vec2<f32>(2.0 * turn.x * turn.y, (turn.y - turn.x) * (turn.y + turn.x));
        }
    }
    let free = form_a[i];
    let length = sqrt(dot(free, free));
    var q = vec4<f32>(0.0, 0.0, 0.0, 1.0);
    if length > MIN_QUATERNION {
        q = free / length;
    }
    inputs[at + 24u] = q.w;
    put(at + 25u, q.xyz);
    put(at + 28u, form_b[i].xyz);
    put(at + 31u, viewer);
    put(at + 34u, light);
    put(at + 37u, normal_of(i));
    inputs[at + 40u] = seen;
    inputs[at + 41u] = select(1.0 - 2.0 * (view.light_reference / (distance + view.light_reference)), 1.0, distance < 0.0);
    for (var k = 0u; k < view.codes; k++) {
        inputs[at + 42u + k] = codes[i * view.codes + k];
    }
}
