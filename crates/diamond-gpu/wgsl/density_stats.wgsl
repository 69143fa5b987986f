// density_stats: what density control wants to know of a view [eq:density-gradient]. After frame.wgsl.

// By Gaussian four groups of four numbers; the last holds the gradient of the projected mean, per px.
@group(0) @binding(1) var<storage, read> gradient: array<vec4<f32>>;
// Extents, px; 0 where culled.
@group(0) @binding(2) var<storage, read> outlines: array<vec4<f32>>;
// Sum of norms per normalised device unit, views, largest radius in px.
@group(0) @binding(3) var<storage, read_write> stats: array<vec4<f32>>;

@compute @workgroup_size(256)
fn record_view(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= frame.gaussians {
        return;
    }
    let radius = max(outlines[i].x, outlines[i].y);
    if radius <= 0.0 {
        return;
    }
    let d = gradient[4u * i + 3u].xy * 0.5 * vec2<f32>(frame.size);
    let norm = sqrt(dot(d, d));
    let finite = (bitcast<u32>(norm) & 0x7F800000u) != 0x7F800000u;
    let before = stats[i];
    stats[i] = vec4<f32>(before.x + select(0.0, norm, finite), before.y + 1.0, max(before.z, radius), 0.0);
}
