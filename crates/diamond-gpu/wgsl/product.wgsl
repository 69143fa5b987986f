// product: matrices multiplied tile by tile, with rows and columns wherever strides say, and what a dense layer needs beside it
// [eq:mlp]. After frame.wgsl.
//
// C[p][i][j] = Σ over the p-th part of k of A[i·a_i + k·a_k] · B[k·b_k + j·b_j]. Parts are summed afterwards in order, so that long sums
// (over all rows of a batch) are shared by many workgroups and still have one order.

struct Product {
    m: u32,
    n: u32,
    k: u32,
    // Length of a part of k; a multiple of 16.
    part: u32,
    a_i: u32,
    a_k: u32,
    b_k: u32,
    b_j: u32,
    // First number of A, B and C.
    a_first: u32,
    b_first: u32,
    c_first: u32,
    // 0 linear, 1 leaky with the slope below (0 is ReLU), 2 sigmoid.
    activation: u32,
    slope: f32,
    // First number of the bias.
    bias_first: u32,
    // 1: sums are added to what is there.
    add: u32,
    unused_1: u32,
}

@group(0) @binding(1) var<storage, read> product: Product;
@group(0) @binding(2) var<storage, read> a: array<f32>;
@group(0) @binding(3) var<storage, read> b: array<f32>;
@group(0) @binding(4) var<storage, read_write> c: array<f32>;

const TILE: u32 = 64u;
const DEPTH: u32 = 16u;
var<workgroup> a_tile: array<f32, 1024>;
var<workgroup> b_tile: array<f32, 1024>;

@compute @workgroup_size(256)
fn multiply(@builtin(workgroup_id) id: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let rows = (product.m + TILE - 1u) / TILE;
    let part = id.y / rows;
    let first_i = id.y % rows * TILE;
    let first_j = id.x * TILE;
    // Each thread has four rows and four columns of the tile.
    let i0 = lane / 16u * 4u;
    let j0 = lane % 16u * 4u;
    var sum: array<vec4<f32>, 4>;
    let end = min((part + 1u) * product.part, product.k);
    for (var k0 = part * product.part; k0 < end; k0 += DEPTH) {
        for (var n = lane; n < TILE * DEPTH; n += 256u) {
            // Along what lies side by side in memory.
            let along_k = vec2<u32>(n / DEPTH, n % DEPTH);
            let across_k = vec2<u32>(n % TILE, n / TILE);
            let at_a = select(across_k, along_k, product.a_k == 1u);
            let at_b = select(across_k, along_k, product.b_k == 1u);
            var value_a = 0.0;
            if first_i + at_a.x < product.m && k0 + at_a.y < end {
                value_a = a[product.a_first + (first_i + at_a.x) * product.a_i + (k0 + at_a.y) * product.a_k];
            }
            var value_b = 0.0;
            if first_j + at_b.x < product.n && k0 + at_b.y < end {
                value_b = b[product.b_first + (first_j + at_b.x) * product.b_j + (k0 + at_b.y) * product.b_k];
            }
            a_tile[at_a.y * TILE + at_a.x] = value_a;
            b_tile[at_b.y * TILE + at_b.x] = value_b;
        }
        workgroupBarrier();
        for (var k = 0u; k < DEPTH; k++) {
            let at = k * TILE + j0;
            let right = vec4<f32>(b_tile[at], b_tile[at + 1u], b_tile[at + 2u], b_tile[at + 3u]);
            let at_i = k * TILE + i0;
            sum[0] = fma(vec4<f32>(a_tile[at_i]), right, sum[0]);
            sum[1] = fma(vec4<f32>(a_tile[at_i + 1u]), right, sum[1]);
            sum[2] = fma(vec4<f32>(a_tile[at_i + 2u]), right, sum[2]);
            sum[3] = fma(vec4<f32>(a_tile[at_i + 3u]), right, sum[3]);
        }
        workgroupBarrier();
    }
    for (var r = 0u; r < 4u; r++) {
        for (var s = 0u; s < 4u; s++) {
            let i = first_i + i0 + r;
            let j = first_j + j0 + s;
            if i < product.m && j < product.n {
                c[product.c_first + (part * product.m + i) * product.n + j] = sum[r][s];
            }
        }
    }
}

// c[c_first + i] = Σ over parts of a[p][i], i < m·n.
@compute @workgroup_size(256)
fn sum_parts(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    let size = product.m * product.n;
    if i >= size {
        return;
    }
    var sum = 0.0;
    for (var part = 0u; part < (product.k + product.part - 1u) / product.part; part++) {
        sum += a[part * size + i];
    }
    if product.add != 0u {
        sum += c[product.c_first + i];
    }
    c[product.c_first + i] = sum;
}

// c += a.
@compute @workgroup_size(256)
fn add_to(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i < product.m * product.n {
        c[i] += a[i];
    }
}

// c += bias, then the activation; b holds the parameters.
@compute @workgroup_size(256)
fn activate(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= product.m * product.n {
        return;
    }
    let x = c[i] + b[product.bias_first + i % product.n];
    var y = x;
    if product.activation == 1u {
        y = select(product.slope * x, x, x > 0.0);
    } else if product.activation == 2u {
        y = 1.0 / (1.0 + exp(-x));
    }
    c[i] = y;
}

// c, the cotangent of an activation's output, becomes that of its input; a holds the output.
@compute @workgroup_size(256)
fn activate_pull(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= product.m * product.n {
        return;
    }
    let y = a[i];
    if product.activation == 1u {
        c[i] *= select(product.slope, 1.0, y > 0.0);
    } else if product.activation == 2u {
        c[i] *= y * (1.0 - y);
    }
}
