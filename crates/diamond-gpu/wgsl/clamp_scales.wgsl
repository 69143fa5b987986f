// clamp_scales: logarithms of standard deviations kept between their limits, after the step. After frame.wgsl.

// `Limits` in step.rs.
struct Limits {
    low: f32,
    high: f32,
    count: u32,
    unused_0: u32,
}

@group(0) @binding(1) var<storage, read> limits: Limits;
@group(0) @binding(2) var<storage, read_write> values: array<f32>;

@compute @workgroup_size(256)
fn clamp_scales(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= limits.count {
        return;
    }
    let v = values[i];
    // What is no number stays none, so that it is found.
    values[i] = select(v, select(limits.low, limits.high, v > limits.high), v > limits.high || v < limits.low);
}
