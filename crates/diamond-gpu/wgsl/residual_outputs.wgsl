// residual_outputs: the channels that depend on the light, from the network, the transfer vectors [eq:light-transfer] and the
// visibility. After frame.wgsl, model_view.wgsl.

@group(0) @binding(1) var<storage, read> view: ModelView;
@group(0) @binding(2) var<storage, read> means: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> residual: array<f32>;
@group(0) @binding(4) var<storage, read> incident: array<f32>;
@group(0) @binding(5) var<storage, read> visibility: array<f32>;
@group(0) @binding(6) var<storage, read> transfer: array<f32>;
@group(0) @binding(7) var<storage, read_write> features: array<vec4<f32>>;

fn wanted(channel: u32, value: f32) -> f32 {
    return select(0.0, value, ((view.channels >> channel) & 1u) == 1u);
}

@compute @workgroup_size(256)
fn residual_outputs(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = linear_workgroup(id, grid) * 256u + lane;
    if row >= view.rows {
        return;
    }
    let i = view.first + row;
    var sum = vec3<f32>(0.0);
    var arriving = 0.0;
    if (view.network & 1u) != 0u {
        sum = vec3<f32>(residual[3u * row], residual[3u * row + 1u], residual[3u * row + 2u]);
    }
    if (view.network & 2u) != 0u {
        arriving = incident[row];
    }
    if view.harmonics > 0u {
        var y = harmonics_of(toward_light(view, means[i].xyz).xyz);
        for (var c = 0u; c < 3u; c++) {
            let at = (3u * i + c) * view.harmonics;
            var part = 0.0;
            for (var k = 0u; k < view.harmonics; k++) {
                part = fma(transfer[at + k], y[k], part);
            }
            sum[c] += part;
        }
    }
    features[4u * i + 2u] = vec4<f32>(features[4u * i + 2u].x, wanted(9u, sum.x), wanted(10u, sum.y), wanted(11u, sum.z));
    features[4u * i + 3u] = vec4<f32>(wanted(12u, arriving), wanted(13u, visibility[i]), 0.0, 0.0);
}
