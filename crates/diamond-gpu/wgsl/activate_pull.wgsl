// activate_pull: gradients of Gaussians and channels added to those of the raw parameters [eq:activations]. After frame.wgsl,
// elementary.wgsl, raw.wgsl.

// `GaussianGrad` in frame.rs.
struct GaussianGrad {
    mean: vec4<f32>,
    form_a: vec4<f32>,
    form_b: vec4<f32>,
    screen: vec4<f32>,
}

@group(0) @binding(1) var<storage, read> places: Raw;
@group(0) @binding(2) var<storage, read> raw: array<f32>;
@group(0) @binding(3) var<storage, read> gradient: array<GaussianGrad>;
@group(0) @binding(4) var<storage, read> d_features: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> d_raw: array<f32>;

fn three(first: u32, i: u32) -> vec3<f32> {
    let at = first + 3u * i;
    return vec3<f32>(raw[at], raw[at + 1u], raw[at + 2u]);
}

fn add_three(first: u32, i: u32, d: vec3<f32>) {
    let at = first + 3u * i;
    d_raw[at] += d.x;
    d_raw[at + 1u] += d.y;
    d_raw[at + 2u] += d.z;
}

// Cotangent of a logit.
fn logit_pull(raw_value: f32, d: f32) -> f32 {
    let y = sigmoid_of(raw_value);
    return d * y * (1.0 - y);
}

@compute @workgroup_size(256)
fn activate_pull(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= frame.gaussians {
        return;
    }
    let g = gradient[i];
    let f0 = d_features[4u * i];
    let f1 = d_features[4u * i + 1u];
    let f2 = d_features[4u * i + 2u];
    add_three(places.mean, i, g.mean.xyz);
    d_raw[places.opacity + i] += logit_pull(raw[places.opacity + i], g.mean.w);
    let log_scale = three(places.scale, i);
    let scale = vec3<f32>(exp_of(log_scale.x), exp_of(log_scale.y), exp_of(log_scale.z));
    add_three(places.scale, i, g.form_b.xyz * scale);
    let q = places.rotation + 4u * i;
    d_raw[q] += g.form_a.w;
    d_raw[q + 1u] += g.form_a.x;
    d_raw[q + 2u] += g.form_a.y;
    d_raw[q + 3u] += g.form_a.z;
    let free = three(places.normal, i);
    let length = sqrt(dot(free, free));
    if length > MIN_NORMAL {
        let normal = free / length;
        let d = vec3<f32>(f1.z, f1.w, f2.x);
        add_three(places.normal, i, (d - normal * dot(normal, d)) / length);
    }
    let color = three(places.base_color, i);
    add_three(
        places.base_color,
        i,
        vec3<f32>(logit_pull(color.x, f0.x), logit_pull(color.y, f0.y), logit_pull(color.z, f0.z)),
    );
    let c = places.channels;
    d_raw[places.roughness + i] += logit_pull(raw[places.roughness + i], wanted(c, 3u, f0.w));
    d_raw[places.metalness + i] += logit_pull(raw[places.metalness + i], wanted(c, 4u, f1.x));
    d_raw[places.subsurfaceness + i] += logit_pull(raw[places.subsurfaceness + i], wanted(c, 5u, f1.y));
}
