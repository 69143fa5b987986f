// projection: Gaussians to ellipses on the screen, and how many tiles each meets [eq:ewa-projection].
// After frame.wgsl, pair.wgsl, linearised.wgsl, tile_span.wgsl.

@group(0) @binding(1) var<storage, read> means: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> form_a: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> form_b: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(5) var<storage, read_write> outlines: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> depth_keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> tile_counts: array<u32>;
// The last of four: how many are visible.
@group(0) @binding(8) var<storage, read_write> counts: array<atomic<u32>>;

const EXTENT_SLACK: f32 = 1e-4;
// As on the CPU: beyond these, f32 would overflow when squared.
const MAX_MEAN: f32 = 1e15;
const MAX_COVARIANCE: f32 = 1e30;
const MAX_DEPTH: f32 = 1e18;
// κ in two parts: κ² = ½ log2 e.
const KAPPA_PAIR: vec2<f32> = vec2<f32>(0.849321783, 1.769906e-8);

// Whether a pixel centre of the axis lies within `extent` of `mean`.
fn meets(mean: f32, extent: f32, size: u32) -> bool {
    let first = max(ceil(mean - extent - 0.5), 0.0);
    let past = min(floor(mean + extent - 0.5) + 1.0, f32(size));
    return first < past;
}

@compute @workgroup_size(256)
fn project(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) count: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, count) * 256u + lane;
    if i >= frame.gaussians {
        return;
    }
    var splat: Splat;
    var outline = vec4<f32>(0.0);
    let opacity = means[i].w;
    let l = linearise(means[i].xyz, form_a[i], form_b[i]);
    let z = l.p[2].x;
    var visible = opacity >= frame.min_alpha && opacity > 0.0 && z > frame.near && z < MAX_DEPTH;
    if visible {
        let a0 = pair_scale(l.columns[0].ray[0], l.columns[0].s);
        let a1 = pair_scale(l.columns[1].ray[0], l.columns[1].s);
        let a2 = pair_scale(l.columns[2].ray[0], l.columns[2].s);
        let b0 = pair_scale(l.columns[0].ray[1], l.columns[0].s);
        let b1 = pair_scale(l.columns[1].ray[1], l.columns[1].s);
        let b2 = pair_scale(l.columns[2].ray[1], l.columns[2].s);
        let of_a = max(max(abs(a0.x), abs(a1.x)), abs(a2.x));
        let of_b = max(max(abs(b0.x), abs(b1.x)), abs(b2.x));
        // Everything divided by a power of two that makes A about 1, so that its fourth powers are numbers.
        let scale = power_of_two(max(of_a, of_b), 1.0);
        let s = scale.y;
        let xx = pair_add(pair_add(pair_mul(a0 * s, a0 * s), pair_mul(a1 * s, a1 * s)), pair_mul(a2 * s, a2 * s));
        let yy = pair_add(pair_add(pair_mul(b0 * s, b0 * s), pair_mul(b1 * s, b1 * s)), pair_mul(b2 * s, b2 * s));
        let xy = pair_add(pair_add(pair_mul(a0 * s, b0 * s), pair_mul(a1 * s, b1 * s)), pair_mul(a2 * s, b2 * s));
        let m01 = pair_sub(pair_mul(a0 * s, b1 * s), pair_mul(a1 * s, b0 * s));
        let m02 = pair_sub(pair_mul(a0 * s, b2 * s), pair_mul(a2 * s, b0 * s));
        let m12 = pair_sub(pair_mul(a1 * s, b2 * s), pair_mul(a2 * s, b1 * s));
        let low = pair_of(frame.low_pass * s * s);
        let minors = pair_add(pair_add(pair_mul(m01, m01), pair_mul(m02, m02)), pair_mul(m12, m12));
        let det = pair_add(minors, pair_mul(pair_add(pair_add(xx, yy), low), low));
        let c_xx = pair_add(xx, low);
        let c_yy = pair_add(yy, low);
        let root_yy = pair_sqrt(c_yy);
        let root_det = pair_sqrt(det);
        let kappa = KAPPA_PAIR * s;
        let l11 = pair_mul(pair_div(root_yy, root_det), kappa);
        let l21 = -pair_mul(pair_div(xy, pair_mul(root_yy, root_det)), kappa);
        let l22 = pair_div(kappa, root_yy);
        let m_x = pair_add(pair_mul(pair_scale(l.p[0], frame.focal.x), l.inv_z), pair_of(frame.principal.x));
        let m_y = pair_add(pair_mul(pair_scale(l.p[1], frame.focal.y), l.inv_z), pair_of(frame.principal.y));
        let two_tau = 2.0 * (1.0 + EXTENT_SLACK) * max(log(opacity / frame.min_alpha), 0.0) + EXTENT_SLACK;
        let root_xx = sqrt(two_tau * c_xx.x);
        let extent = vec2<f32>(root_xx, sqrt(two_tau * c_yy.x)) * scale.x;
        let limit = MAX_COVARIANCE * s * s;
        visible = within(m_x.x, MAX_MEAN) && within(m_y.x, MAX_MEAN) && within(xx.x, limit) && within(yy.x, limit)
            && within(l11.x, MAX_MEAN) && within(l21.x, MAX_MEAN) && within(l22.x, MAX_MEAN)
            && within(extent.x, MAX_MEAN * 16.0) && within(extent.y, MAX_MEAN * 16.0)
            && meets(m_x.x, extent.x, frame.size.x) && meets(m_y.x, extent.y, frame.size.y);
        if visible {
            splat.mean = vec4<f32>(m_x, m_y);
            splat.chol = vec4<f32>(l11, l21);
            splat.rest = vec4<f32>(l22, opacity, z);
            outline = vec4<f32>(extent, two_tau, xy.x / c_xx.x * extent.x);
        }
    }
    var tiles = 0u;
    if visible {
        let rows = tile_rows(splat, outline);
        for (var row = rows.x; row < rows.y; row++) {
            let columns = tile_columns(splat, outline, row);
            tiles += columns.y - columns.x;
        }
    }
    if visible {
        atomicAdd(&counts[3], 1u);
    }
    splats[i] = splat;
    outlines[i] = outline;
    // Depths above 0 sort like their bits; culled Gaussians go last.
    depth_keys[i] = select(0xFFFFFFFFu, bitcast<u32>(z), visible);
    tile_counts[i] = tiles;
}
