// radiance: linear RGB out of the shaded picture's records. After frame.wgsl.

@group(0) @binding(1) var<storage, read> record: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> linear: array<f32>;

@compute @workgroup_size(256)
fn radiance(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= frame.size.x * frame.size.y {
        return;
    }
    let rgb = record[6u * i].xyz;
    linear[3u * i] = rgb.x;
    linear[3u * i + 1u] = rgb.y;
    linear[3u * i + 2u] = rgb.z;
}
