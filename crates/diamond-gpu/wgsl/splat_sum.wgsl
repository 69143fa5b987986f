// splat_sum: adds up the rows of each Gaussian's entries, in the order of entries. After frame.wgsl.

@group(0) @binding(1) var<storage, read> depth_order: array<u32>;
@group(0) @binding(2) var<storage, read> offsets: array<u32>;
@group(0) @binding(3) var<storage, read> rows: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> sums: array<vec4<f32>>;

// Groups of four numbers in a row, and those that are summed: so many from this one on.
override ROW: u32 = 3u;
override FROM: u32 = 0u;
override TAKE: u32 = 2u;

@compute @workgroup_size(256)
fn sum_rows(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    let rank = i / TAKE;
    let quad = i % TAKE;
    if rank >= frame.gaussians {
        return;
    }
    var sum = vec4<f32>(0.0);
    let end = min(offsets[rank + 1u], frame.capacity);
    for (var entry = offsets[rank]; entry < end; entry++) {
        sum += rows[entry * ROW + FROM + quad];
    }
    sums[depth_order[rank] * TAKE + quad] = sum;
}
