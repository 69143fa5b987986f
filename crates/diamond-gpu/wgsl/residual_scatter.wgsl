// residual_scatter: cotangents of the network's inputs added to those of normals and codes, which learn by them
// [eq:residual-inputs]. After frame.wgsl, model_view.wgsl.

@group(0) @binding(1) var<storage, read> view: ModelView;
@group(0) @binding(2) var<storage, read> d_inputs: array<f32>;
@group(0) @binding(3) var<storage, read_write> d_features: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> d_codes: array<f32>;

@compute @workgroup_size(256)
fn residual_scatter(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = linear_workgroup(id, grid) * 256u + lane;
    if row >= view.rows {
        return;
    }
    let i = view.first + row;
    let at = row * view.width;
    if (view.network & 8u) != 0u {
        d_features[4u * i + 1u] += vec4<f32>(0.0, 0.0, d_inputs[at + 37u], d_inputs[at + 38u]);
        d_features[4u * i + 2u] += vec4<f32>(d_inputs[at + 39u], 0.0, 0.0, 0.0);
    }
    for (var k = 0u; k < view.codes; k++) {
        d_codes[i * view.codes + k] += d_inputs[at + 42u + k];
    }
}
