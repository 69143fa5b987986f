// tile_ranges: where each tile's entries begin and end, and who they are. After frame.wgsl. Ranges are 0 before.

@group(0) @binding(1) var<storage, read> tile_keys: array<u32>;
@group(0) @binding(2) var<storage, read> entries: array<u32>;
@group(0) @binding(3) var<storage, read> owners: array<u32>;
@group(0) @binding(4) var<storage, read> counts: array<u32>;
@group(0) @binding(5) var<storage, read_write> ranges: array<vec2<u32>>;
// Gaussian, and number of the entry before sorting.
@group(0) @binding(6) var<storage, read_write> pairs: array<vec2<u32>>;

@compute @workgroup_size(256)
fn find_ranges(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    let n = counts[1];
    if i >= n {
        return;
    }
    let entry = entries[i];
    pairs[i] = vec2<u32>(owners[entry], entry);
    let tile = tile_keys[i];
    if tile >= frame.tiles.x * frame.tiles.y {
        return;
    }
    if i == 0u || tile_keys[max(i, 1u) - 1u] != tile {
        ranges[tile].x = i;
    }
    if i + 1u == n || tile_keys[min(i + 1u, n - 1u)] != tile {
        ranges[tile].y = i + 1u;
    }
}
