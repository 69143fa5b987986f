// visibility_fit: the visibility of the light by spherical harmonics, per Gaussian [eq:sh-visibility]. After frame.wgsl,
// model_view.wgsl.

@group(0) @binding(1) var<storage, read> view: ModelView;
@group(0) @binding(2) var<storage, read> means: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> coefficients: array<f32>;
@group(0) @binding(4) var<storage, read_write> visibility: array<f32>;

@compute @workgroup_size(256)
fn visibility_fit(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= frame.gaussians {
        return;
    }
    var y = harmonics_of(toward_light(view, means[i].xyz).xyz);
    var sum = 0.5;
    for (var k = 0u; k < 16u; k++) {
        sum = fma(coefficients[16u * i + k], y[k], sum);
    }
    visibility[i] = clamp(sum, 0.0, 1.0);
}
