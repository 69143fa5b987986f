// pack_transport: the five channels of a Gaussian that depend on the light, with what a medium sends out, beside those of other lights: three lights are
// blended together. After frame.wgsl.

// Which of the three; 1: there is a medium.
@group(0) @binding(1) var<storage, read> slot: array<u32>;
@group(0) @binding(2) var<storage, read> features: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> sent: array<f32>;
@group(0) @binding(4) var<storage, read_write> packed: array<f32>;

@compute @workgroup_size(256)
fn pack_transport(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= frame.gaussians {
        return;
    }
    var residual = features[4u * i + 2u].yzw;
    if slot[1] != 0u {
        residual += vec3<f32>(sent[3u * i], sent[3u * i + 1u], sent[3u * i + 2u]);
    }
    let others = features[4u * i + 3u].xy;
    let at = 16u * i + 5u * slot[0];
    packed[at] = residual.x;
    packed[at + 1u] = residual.y;
    packed[at + 2u] = residual.z;
    packed[at + 3u] = others.x;
    packed[at + 4u] = others.y;
}
