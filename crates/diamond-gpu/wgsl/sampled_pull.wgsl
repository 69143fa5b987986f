// sampled_pull: mean square of what the residual adds where it is asked to add nothing, and the cotangents of network and transfer
// vectors [eq:residual-pull] [eq:light-transfer]. After frame.wgsl, model_view.wgsl, sample.wgsl.

@group(0) @binding(1) var<storage, read> view: ModelView;
@group(0) @binding(2) var<storage, read> samples: array<Sample>;
@group(0) @binding(3) var<storage, read> residual: array<f32>;
@group(0) @binding(4) var<storage, read> transfer: array<f32>;
@group(0) @binding(5) var<storage, read_write> d_residual: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_transfer: array<f32>;
@group(0) @binding(7) var<storage, read_write> values: array<vec4<f32>>;

@compute @workgroup_size(256)
fn sampled_pull(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = linear_workgroup(id, grid) * 256u + lane;
    if row >= view.rows {
        return;
    }
    let s = samples[row];
    var sum = vec3<f32>(0.0);
    if (view.network & 1u) != 0u {
        sum = vec3<f32>(residual[3u * row], residual[3u * row + 1u], residual[3u * row + 2u]);
    }
    var y = harmonics_of(s.light);
    for (var c = 0u; c < 3u && view.harmonics > 0u; c++) {
        let at = (3u * s.gaussian + c) * view.harmonics;
        for (var k = 0u; k < view.harmonics; k++) {
            sum[c] = fma(transfer[at + k], y[k], sum[c]);
        }
    }
    let d = (2.0 * view.weight / f32(3u * view.rows)) * sum;
    values[row] = vec4<f32>(dot(sum, sum), 0.0, 0.0, 0.0);
    if (view.network & 1u) != 0u {
        d_residual[3u * row] = d.x;
        d_residual[3u * row + 1u] = d.y;
        d_residual[3u * row + 2u] = d.z;
    }
    for (var c = 0u; c < 3u && view.harmonics > 0u; c++) {
        let at = (3u * s.gaussian + c) * view.harmonics;
        for (var k = 0u; k < view.harmonics; k++) {
            d_transfer[at + k] = fma(d[c], y[k], d_transfer[at + k]);
        }
    }
}
