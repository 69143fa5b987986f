// join_transport: a light's five blended channels put beside those that do not depend on the light. After frame.wgsl.

@group(0) @binding(1) var<storage, read> slot: array<u32>;
@group(0) @binding(2) var<storage, read> blended: array<f32>;
@group(0) @binding(3) var<storage, read_write> picture: array<vec4<f32>>;

@compute @workgroup_size(256)
fn join_transport(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= frame.size.x * frame.size.y {
        return;
    }
    let at = 16u * i + 5u * slot[0];
    let residual = vec3<f32>(blended[at], blended[at + 1u], blended[at + 2u]);
    picture[4u * i + 2u] = vec4<f32>(picture[4u * i + 2u].x, residual);
    picture[4u * i + 3u] = vec4<f32>(blended[at + 3u], blended[at + 4u], 0.0, 0.0);
}
