// activate: raw parameters to Gaussians and to the channels that do not depend on the light [eq:activations]. After frame.wgsl,
// elementary.wgsl, raw.wgsl.

@group(0) @binding(1) var<storage, read> places: Raw;
@group(0) @binding(2) var<storage, read> raw: array<f32>;
@group(0) @binding(3) var<storage, read_write> means: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> form_a: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> form_b: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> features: array<vec4<f32>>;

fn three(first: u32, i: u32) -> vec3<f32> {
    let at = first + 3u * i;
    return vec3<f32>(raw[at], raw[at + 1u], raw[at + 2u]);
}

@compute @workgroup_size(256)
fn activate(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= frame.gaussians {
        return;
    }
    means[i] = vec4<f32>(three(places.mean, i), sigmoid_of(raw[places.opacity + i]));
    let q = places.rotation + 4u * i;
    form_a[i] = vec4<f32>(raw[q + 1u], raw[q + 2u], raw[q + 3u], raw[q]);
    let log_scale = three(places.scale, i);
    form_b[i] = vec4<f32>(exp_of(log_scale.x), exp_of(log_scale.y), exp_of(log_scale.z), 0.0);
    let free = three(places.normal, i);
    let length = sqrt(dot(free, free));
    var normal = vec3<f32>(0.0, 0.0, 1.0);
    if length > MIN_NORMAL {
        normal = free / length;
    }
    let color = three(places.base_color, i);
    let base_color = vec3<f32>(sigmoid_of(color.x), sigmoid_of(color.y), sigmoid_of(color.z));
    let roughness = wanted(places.channels, 3u, sigmoid_of(raw[places.roughness + i]));
    let metalness = wanted(places.channels, 4u, sigmoid_of(raw[places.metalness + i]));
    let subsurfaceness = wanted(places.channels, 5u, sigmoid_of(raw[places.subsurfaceness + i]));
    features[4u * i] = vec4<f32>(base_color, roughness);
    features[4u * i + 1u] = vec4<f32>(metalness, subsurfaceness, normal.xy);
    features[4u * i + 2u] = vec4<f32>(normal.z, 0.0, 0.0, 0.0);
    features[4u * i + 3u] = vec4<f32>(0.0);
}
