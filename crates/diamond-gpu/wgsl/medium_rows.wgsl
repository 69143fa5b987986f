// medium_rows: what a medium sends out of each Gaussian, added to the residual's channels [eq:medium-residual]. After frame.wgsl,
// model_view.wgsl, medium.wgsl.

@group(0) @binding(6) var<storage, read_write> features: array<vec4<f32>>;

@compute @workgroup_size(256)
fn medium_rows(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= frame.gaussians {
        return;
    }
    let f2 = features[4u * i + 2u];
    let normal = vec3<f32>(features[4u * i + 1u].zw, f2.x);
    let sent = untinted(i, normal) * features[4u * i].xyz * view.tint;
    features[4u * i + 2u] = vec4<f32>(f2.x, f2.yzw + sent);
}
