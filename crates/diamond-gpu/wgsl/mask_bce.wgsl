// mask_bce: cross-entropy of the opacity against a mask, and its gradient [eq:mask-bce]. After frame.wgsl.

@group(0) @binding(1) var<storage, read> opacity: array<f32>;
@group(0) @binding(2) var<storage, read> mask: array<f32>;
@group(0) @binding(3) var<storage, read_write> gradient: array<f32>;
@group(0) @binding(4) var<storage, read_write> values: array<f32>;

// As on the CPU: where opacity ends.
const MARGIN: f32 = 1e-6;

@compute @workgroup_size(256)
fn mask_bce(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    let n = frame.size.x * frame.size.y;
    if i >= n {
        return;
    }
    let m = mask[i];
    let o = opacity[i];
    // The distance from the upper end by itself: 1 − (1 − 1e-6) keeps two digits.
    let through = max(1.0 - o, MARGIN);
    let cut = max(o, MARGIN);
    values[i] = -(m * log(cut) + (1.0 - m) * log(through));
    // The margin in f32 is a little less than in f64.
    let passes = o > MARGIN && 1.0 - o > MARGIN;
    gradient[i] = select(0.0, (o - m) / (cut * through) / f32(n), passes);
}
