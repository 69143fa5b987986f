// residual_gather: cotangents of the channels that the residual made, as rows for the network, and added to those of the transfer
// vectors [eq:light-transfer]. After frame.wgsl, model_view.wgsl.

@group(0) @binding(1) var<storage, read> view: ModelView;
@group(0) @binding(2) var<storage, read> means: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> d_features: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> d_residual: array<f32>;
@group(0) @binding(5) var<storage, read_write> d_incident: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_transfer: array<f32>;

fn wanted(channel: u32, value: f32) -> f32 {
    return select(0.0, value, ((view.channels >> channel) & 1u) == 1u);
}

@compute @workgroup_size(256)
fn residual_gather(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = linear_workgroup(id, grid) * 256u + lane;
    if row >= view.rows {
        return;
    }
    let i = view.first + row;
    let given = d_features[4u * i + 2u];
    let d = vec3<f32>(wanted(9u, given.y), wanted(10u, given.z), wanted(11u, given.w));
    if (view.network & 1u) != 0u {
        d_residual[3u * row] = d.x;
        d_residual[3u * row + 1u] = d.y;
        d_residual[3u * row + 2u] = d.z;
    }
    if (view.network & 2u) != 0u {
        d_incident[row] = select(0.0, wanted(12u, d_features[4u * i + 3u].x), (view.network & 4u) != 0u);
    }
    if view.harmonics > 0u {
        var y = harmonics_of(toward_light(view, means[i].xyz).xyz);
        for (var c = 0u; c < 3u; c++) {
            let at = (3u * i + c) * view.harmonics;
            for (var k = 0u; k < view.harmonics; k++) {
                d_transfer[at + k] = fma(d[c], y[k], d_transfer[at + k]);
            }
        }
    }
}
