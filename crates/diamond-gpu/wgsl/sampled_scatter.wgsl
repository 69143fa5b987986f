// sampled_scatter: cotangents of the network's inputs added to those of the codes, of the Gaussians that were drawn [eq:residual-pull].
// After frame.wgsl, model_view.wgsl, sample.wgsl.

@group(0) @binding(1) var<storage, read> view: ModelView;
@group(0) @binding(2) var<storage, read> samples: array<Sample>;
@group(0) @binding(3) var<storage, read> d_inputs: array<f32>;
@group(0) @binding(4) var<storage, read_write> d_codes: array<f32>;

@compute @workgroup_size(256)
fn sampled_scatter(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let n = linear_workgroup(id, grid) * 256u + lane;
    if n >= view.rows * view.codes {
        return;
    }
    let row = n / view.codes;
    let k = n % view.codes;
    d_codes[samples[row].gaussian * view.codes + k] += d_inputs[row * view.width + 42u + k];
}
