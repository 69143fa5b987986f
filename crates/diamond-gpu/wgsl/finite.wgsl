// finite: the first number of an array that is none, or infinite. After frame.wgsl.

@group(0) @binding(1) var<storage, read> values: array<u32>;
// Place of the first such number, or all ones.
@group(0) @binding(2) var<storage, read_write> first: atomic<u32>;

@compute @workgroup_size(256)
fn finite(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i < arrayLength(&values) && (values[i] & 0x7F800000u) == 0x7F800000u {
        atomicMin(&first, i);
    }
}
