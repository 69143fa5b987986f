// photometric: absolute, squared and structural difference of two pictures, and the gradient [eq:ssim] [eq:photometric]. After
// frame.wgsl.
//
// Window sums are taken of differences from the window's centre, so that variances do not come out of a cancellation: 121
// products per value, from memory that a tile of pixels shares.

struct Photometric {
    width: u32,
    height: u32,
    channels: u32,
    // Pixels at the edge whose windows do not count.
    border: u32,
    // 0 linear, 1 sRGB, 2 gamma 2.2.
    space: u32,
    // Factors of the gradients of the sum of SSIM, of |a − b| and of (a − b)²/2.
    step_ssim: f32,
    step_l1: f32,
    step_l2: f32,
    // Numbers per pixel of the photograph; 1: the last is how much the pixel counts [eq:believed].
    stride: u32,
    weighted: u32,
    unused_0: u32,
    unused_1: u32,
}

@group(0) @binding(1) var<storage, read> settings: Photometric;
// The rendered picture, linear; its encoding; the photograph, encoded. Channels interleaved.
@group(0) @binding(2) var<storage, read> linear: array<f32>;
@group(0) @binding(3) var<storage, read_write> rendered: array<f32>;
@group(0) @binding(4) var<storage, read> photograph: array<f32>;
// Derivatives of SSIM by the mean of a, its variance, the covariance; and mean of a. Mean of b.
@group(0) @binding(5) var<storage, read_write> fields: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> means: array<f32>;
@group(0) @binding(7) var<storage, read_write> gradient: array<f32>;
// 1 − SSIM, |a − b|, (a − b)².
@group(0) @binding(8) var<storage, read_write> sums: array<vec4<f32>>;

const C1: f32 = 1e-4;
const C2: f32 = 9e-4;
const SRGB_STRAIGHT: f32 = 0.0031308;
const GAMMA_FLOOR: f32 = 1e-6;
const GAMMA_STEEPEST: f32 = 851.7352;
const REACH: u32 = 5u;
const SIDE: u32 = 26u;
// A Gaussian of σ 1.5 at 0 to 5 from its middle, so that all eleven sum to one.
const TAPS = array<f32, 6>(0.266011725, 0.213005538, 0.10936069, 0.0360007721, 0.00759875814, 0.00102838008);

var<workgroup> tile_a: array<f32, 676>;
var<workgroup> tile_b: array<f32, 676>;
var<workgroup> tile_fields: array<vec4<f32>, 676>;

// v^(5/n) for n 11 or 12: what the device calls a power, corrected once.
fn root_of(v: f32, n: f32) -> f32 {
    let y = pow(v, 5.0 / n);
    if v < 1e-6 || v > 1e6 {
        return y;
    }
    let y2 = y * y;
    let y4 = y2 * y2;
    let v2 = v * v;
    let power = y4 * y4 * y2 * y * select(1.0, y, n > 11.5);
    return y * (1.0 + (v2 * v2 * v / power - 1.0) / n);
}

@compute @workgroup_size(256)
fn encode(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= settings.width * settings.height * settings.channels {
        return;
    }
    let x = linear[i];
    let v = abs(x);
    var y = v;
    if settings.space == 1u {
        y = select(1.055 * root_of(v, 12.0) - 0.055, 12.92 * v, v <= SRGB_STRAIGHT);
    } else if settings.space == 2u {
        y = root_of(v, 11.0);
    }
    rendered[i] = select(y, -y, x < 0.0);
}

fn slope_of(x: f32, stored: f32) -> f32 {
    let v = abs(x);
    let y = abs(stored);
    if settings.space == 1u {
        return select((y + 0.055) / (max(v, SRGB_STRAIGHT) * 2.4), 12.92, v <= SRGB_STRAIGHT);
    }
    if settings.space == 2u {
        return select(y / (max(v, GAMMA_FLOOR) * 2.2), GAMMA_STEEPEST, v < GAMMA_FLOOR);
    }
    return 1.0;
}

// How much a pixel counts.
fn weight_of(pixel: u32) -> f32 {
    return select(1.0, photograph[pixel * settings.stride + settings.stride - 1u], settings.weighted != 0u);
}

// The number of the value at this place of the tile with its surroundings; the last bit says whether it is outside.
fn place(tile: vec2<u32>, n: u32) -> vec2<u32> {
    let x = tile.x * 16u + n % SIDE;
    let y = tile.y * 16u + n / SIDE;
    let outside = x < REACH || y < REACH || x >= settings.width + REACH || y >= settings.height + REACH;
    return vec2<u32>(select((y - REACH) * settings.width + x - REACH, 0u, outside), u32(outside));
}

// One workgroup per tile of 16 × 16 pixels; channels one after the other.
@compute @workgroup_size(256)
fn compare_windows(@builtin(workgroup_id) tile: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let x = tile.x * 16u + lane % 16u;
    let y = tile.y * 16u + lane / 16u;
    let inside = x < settings.width && y < settings.height;
    let e = settings.border;
    let counted = inside && x >= e && y >= e && x + e < settings.width && y + e < settings.height;
    for (var c = 0u; c < settings.channels; c++) {
        workgroupBarrier();
        for (var n = lane; n < SIDE * SIDE; n += 256u) {
            let at = place(tile.xy, n);
            let i = at.x * settings.channels + c;
            tile_a[n] = select(rendered[i], 0.0, at.y != 0u);
            tile_b[n] = select(photograph[at.x * settings.stride + c], 0.0, at.y != 0u);
        }
        workgroupBarrier();
        let corner = lane / 16u * SIDE + lane % 16u;
        let centre = corner + REACH * SIDE + REACH;
        let a = tile_a[centre];
        let b = tile_b[centre];
        var m_a = 0.0;
        var m_b = 0.0;
        var s_aa = 0.0;
        var s_bb = 0.0;
        var s_ab = 0.0;
        var m_d = 0.0;
        var s_dd = 0.0;
        var taps = TAPS;
        for (var dy = 0u; dy < 11u; dy++) {
            let w_y = taps[u32(abs(i32(dy) - 5))];
            for (var dx = 0u; dx < 11u; dx++) {
                let w = w_y * taps[u32(abs(i32(dx) - 5))];
                let d_a = tile_a[corner + dy * SIDE + dx] - a;
                let d_b = tile_b[corner + dy * SIDE + dx] - b;
                m_a += w * d_a;
                m_b += w * d_b;
                s_aa += w * d_a * d_a;
                s_bb += w * d_b * d_b;
                s_ab += w * d_a * d_b;
                m_d += w * (d_a - d_b);
                s_dd += w * (d_a - d_b) * (d_a - d_b);
            }
        }
        if inside {
            let mean_a = a + m_a;
            let mean_b = b + m_b;
            let a_1 = 2.0 * mean_a * mean_b + C1;
            let a_2 = 2.0 * (s_ab - m_a * m_b) + C2;
            let b_1 = mean_a * mean_a + mean_b * mean_b + C1;
            let b_2 = (s_aa - m_a * m_a) + (s_bb - m_b * m_b) + C2;
            let similarity = (a_1 / b_1) * (a_2 / b_2);
            let i = (y * settings.width + x) * settings.channels + c;
            // 1 − SSIM as a sum of what makes it, not as a difference.
            let apart = (a - b) + m_d;
            let spread = s_dd - m_d * m_d;
            let dissimilarity = apart * apart / b_1 + (a_1 / b_1) * (spread / b_2);
            let by_mean = 2.0 * mean_b / b_1 * (a_2 / b_2) - similarity * 2.0 * mean_a / b_1;
            let derivatives = vec3<f32>(by_mean, -similarity / b_2, 2.0 * (a_1 / b_1) / b_2);
            let weight = weight_of(y * settings.width + x);
            fields[i] = vec4<f32>(select(vec3<f32>(0.0), weight * derivatives, counted), mean_a);
            means[i] = mean_b;
            sums[i] = weight * vec4<f32>(select(0.0, dissimilarity, counted), abs(a - b), (a - b) * (a - b), 0.0);
        }
    }
}

@compute @workgroup_size(256)
fn gather_gradient(@builtin(workgroup_id) tile: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let x = tile.x * 16u + lane % 16u;
    let y = tile.y * 16u + lane / 16u;
    let inside = x < settings.width && y < settings.height;
    for (var c = 0u; c < settings.channels; c++) {
        workgroupBarrier();
        for (var n = lane; n < SIDE * SIDE; n += 256u) {
            let at = place(tile.xy, n);
            let i = at.x * settings.channels + c;
            tile_fields[n] = select(fields[i], vec4<f32>(0.0), at.y != 0u);
            tile_b[n] = means[i];
        }
        workgroupBarrier();
        let corner = lane / 16u * SIDE + lane % 16u;
        let pixel = min(y, settings.height - 1u) * settings.width + min(x, settings.width - 1u);
        let i = pixel * settings.channels + c;
        let a = rendered[i];
        let b = photograph[pixel * settings.stride + c];
        var sum = 0.0;
        var taps = TAPS;
        for (var dy = 0u; dy < 11u; dy++) {
            let w_y = taps[u32(abs(i32(dy) - 5))];
            for (var dx = 0u; dx < 11u; dx++) {
                let n = corner + dy * SIDE + dx;
                let f = tile_fields[n];
                let d = f.x + 2.0 * f.y * (a - f.w) + f.z * (b - tile_b[n]);
                sum += w_y * taps[u32(abs(i32(dx) - 5))] * d;
            }
        }
        if inside {
            let direct = settings.step_l1 * sign(a - b) + settings.step_l2 * (a - b);
            let d = settings.step_ssim * sum + weight_of(pixel) * direct;
            gradient[i] = d * slope_of(linear[i], a);
        }
    }
}

var<workgroup> partial: array<vec4<f32>, 256>;

// Each block of 2048 becomes one sum, at the block's number; `means` holds how many there are.
@compute @workgroup_size(256)
fn add_up(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = linear_workgroup(id, grid);
    let n = arrayLength(&sums);
    var sum = vec4<f32>(0.0);
    for (var k = 0u; k < 8u; k++) {
        let i = (block * 8u + k) * 256u + lane;
        if i < n {
            sum += sums[i];
        }
    }
    partial[lane] = sum;
    for (var half = 128u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if lane < half {
            partial[lane] += partial[lane + half];
        }
    }
    if lane == 0u && block < arrayLength(&fields) {
        fields[block] = partial[0];
    }
}
