// transfer_smoothness: shrinkage of the transfer vectors, band by band, and its gradient [eq:transfer-smoothness]. After frame.wgsl,
// model_view.wgsl.

@group(0) @binding(1) var<storage, read> view: ModelView;
@group(0) @binding(2) var<storage, read> transfer: array<f32>;
@group(0) @binding(3) var<storage, read_write> d_transfer: array<f32>;
@group(0) @binding(4) var<storage, read_write> values: array<vec4<f32>>;

@compute @workgroup_size(256)
fn transfer_smoothness(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= frame.gaussians {
        return;
    }
    let share = 1.0 / f32(frame.gaussians);
    var sum = 0.0;
    for (var k = 0u; k < view.harmonics; k++) {
        // l² of the k-th harmonic.
        var band = 0u;
        while (band + 1u) * (band + 1u) <= k {
            band++;
        }
        let factor = f32(band * band) * share;
        for (var c = 0u; c < 3u; c++) {
            let at = (3u * i + c) * view.harmonics + k;
            let t = transfer[at];
            sum = fma(factor * t, t, sum);
            d_transfer[at] += view.weight * 2.0 * factor * t;
        }
    }
    values[i] = vec4<f32>(sum, 0.0, 0.0, 0.0);
}
