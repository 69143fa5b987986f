// tile_entries: one entry per Gaussian and tile that it meets, Gaussians in the order of depth. After frame.wgsl and
// tile_span.wgsl.

@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> outlines: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> depth_order: array<u32>;
@group(0) @binding(4) var<storage, read> offsets: array<u32>;
@group(0) @binding(5) var<storage, read_write> tile_keys: array<u32>;
@group(0) @binding(6) var<storage, read_write> owners: array<u32>;

@compute @workgroup_size(256)
fn enter_tiles(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let rank = linear_workgroup(id, grid) * 256u + lane;
    if rank >= frame.gaussians {
        return;
    }
    var at = offsets[rank];
    let end = min(offsets[rank + 1u], frame.capacity);
    if at >= end {
        return;
    }
    let gaussian = depth_order[rank];
    let splat = splats[gaussian];
    let outline = outlines[gaussian];
    let rows = tile_rows(splat, outline);
    for (var row = rows.x; row < rows.y; row++) {
        let columns = tile_columns(splat, outline, row);
        for (var column = columns.x; column < columns.y && at < end; column++) {
            tile_keys[at] = row * frame.tiles.x + column;
            owners[at] = gaussian;
            at++;
        }
    }
    // Only if this kernel rounded otherwise than the one that counted: entries of no tile.
    for (; at < end; at++) {
        tile_keys[at] = frame.tiles.x * frame.tiles.y;
        owners[at] = gaussian;
    }
}
