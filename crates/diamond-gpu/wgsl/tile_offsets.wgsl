// tile_offsets: where each Gaussian's entries begin, Gaussians in the order of depth. After frame.wgsl; a scan lies between the
// two kernels.

@group(0) @binding(1) var<storage, read> depth_order: array<u32>;
@group(0) @binding(2) var<storage, read> tile_counts: array<u32>;
@group(0) @binding(3) var<storage, read_write> offsets: array<u32>;
// Gaussians, entries that are made, entries that would be wanted, visible Gaussians.
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;

@compute @workgroup_size(256)
fn order_counts(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let rank = linear_workgroup(id, grid) * 256u + lane;
    if rank < frame.gaussians {
        offsets[rank] = tile_counts[depth_order[rank]];
    } else if rank == frame.gaussians {
        offsets[rank] = 0u;
    }
}

@compute @workgroup_size(1)
fn total() {
    let wanted = offsets[frame.gaussians];
    counts[1] = min(wanted, frame.capacity);
    counts[2] = wanted;
}
