// reduce: sums of arrays side by side, a block of 2048 at a time, in one order. After frame.wgsl.

// `Reduction` in step.rs.
struct Reduction {
    // Numbers per array, and from the first of one array to the first of the next.
    count: u32,
    stride: u32,
    // The same of the sums, and where the first is put.
    out_stride: u32,
    out_first: u32,
}

@group(0) @binding(1) var<storage, read> reduction: Reduction;
@group(0) @binding(2) var<storage, read> terms: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> sums: array<vec4<f32>>;

var<workgroup> partial: array<vec4<f32>, 256>;

@compute @workgroup_size(256)
fn reduce(@builtin(workgroup_id) id: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    var sum = vec4<f32>(0.0);
    for (var k = 0u; k < 8u; k++) {
        let i = (id.x * 8u + k) * 256u + lane;
        if i < reduction.count {
            sum += terms[id.y * reduction.stride + i];
        }
    }
    partial[lane] = sum;
    for (var half = 128u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if lane < half {
            partial[lane] += partial[lane + half];
        }
    }
    if lane == 0u {
        sums[reduction.out_first + id.y * reduction.out_stride + id.x] = partial[0];
    }
}
