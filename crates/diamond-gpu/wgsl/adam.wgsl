// adam: one update of values along a gradient [eq:adam]. After frame.wgsl.

struct Update {
    // rate / (1 − β₁ᵗ) and 1/√(1 − β₂ᵗ).
    step: f32,
    scale: f32,
    // Numbers in a row; 1 where all rows are updated.
    width: u32,
    // 1: only rows whose gradient is not all 0.
    seen: u32,
}

@group(0) @binding(1) var<storage, read> update: Update;
@group(0) @binding(2) var<storage, read> gradient: array<f32>;
@group(0) @binding(3) var<storage, read_write> values: array<f32>;
@group(0) @binding(4) var<storage, read_write> first_moment: array<f32>;
@group(0) @binding(5) var<storage, read_write> second_moment: array<f32>;
// How many values there are.
@group(0) @binding(6) var<storage, read> count: array<u32>;

const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const EPSILON: f32 = 1e-15;

@compute @workgroup_size(256)
fn adam(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= count[0] {
        return;
    }
    if update.seen != 0u {
        let row = i / update.width * update.width;
        var bits = 0u;
        for (var k = 0u; k < update.width; k++) {
            bits |= bitcast<u32>(gradient[row + k]) << 1u;
        }
        if bits == 0u {
            return;
        }
    }
    let g = gradient[i];
    let m = fma(first_moment[i], BETA_1, g * (1.0 - BETA_1));
    let v = fma(second_moment[i], BETA_2, g * g * (1.0 - BETA_2));
    first_moment[i] = m;
    second_moment[i] = v;
    values[i] -= m * update.step / (sqrt(v) * update.scale + EPSILON);
}
