// projection_pull: sums over pixels to gradients of the Gaussians [eq:splat-footprint-pull]. After frame.wgsl, pair.wgsl,
// linearised.wgsl.
//
// With B = Lᵀ A and M = Σ g w wᵀ the cotangent of A is L M B. A long thin ellipse has a long L and a long A, but B is never
// longer than 1: it is found in more than f32, and nothing after it cancels.

struct GaussianGrad {
    // Mean, opacity.
    mean: vec4<f32>,
    // Quaternion, or the first four numbers of the factor.
    form_a: vec4<f32>,
    // Standard deviations, or the last two numbers of the factor.
    form_b: vec4<f32>,
    // Projected mean, per px.
    screen: vec4<f32>,
}

@group(0) @binding(1) var<storage, read> means: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> form_a: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> form_b: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> splats: array<Splat>;
@group(0) @binding(5) var<storage, read> moments: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> gradient: array<GaussianGrad>;

const LARGEST: f32 = 3.4028234e38;

// A finite cotangent must give a finite gradient.
fn finite(v: vec4<f32>) -> vec4<f32> {
    return clamp(v, vec4<f32>(-LARGEST), vec4<f32>(LARGEST));
}

fn to_world_axes(d: vec3<f32>) -> vec3<f32> {
    return d.x * frame.row_x.xyz + d.y * frame.row_y.xyz + d.z * frame.row_z.xyz;
}

@compute @workgroup_size(256)
fn pull(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) count: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, count) * 256u + lane;
    if i >= frame.gaussians {
        return;
    }
    var out: GaussianGrad;
    let splat = splats[i];
    let opacity = splat.rest.z;
    if opacity <= 0.0 {
        gradient[i] = out;
        return;
    }
    let low = moments[2u * i];
    let high = moments[2u * i + 1u];
    let l = linearise(means[i].xyz, form_a[i], form_b[i]);
    let l11 = splat.chol.xy;
    let l21 = splat.chol.zw;
    let l22 = splat.rest.xy;
    // κ L is what is kept: 1/κ² is 2 ln 2.
    let d_screen = vec2<f32>(l11.x * low.y, fma(l21.x, low.y, l22.x * low.z)) * 1.3862944;
    let m_uu = low.w;
    let m_uv = high.x;
    let m_vv = high.y;
    let inv_z = l.inv_z.x;
    let k = vec2<f32>(frame.focal.x, frame.focal.y) * inv_z;
    let tangent = vec2<f32>(l.tangent[0].x, l.tangent[1].x);
    var d_v: array<vec3<f32>, 3>;
    var d_s = vec3<f32>(0.0);
    var d_tangent = vec2<f32>(0.0);
    var d_k = 0.0;
    for (var j = 0u; j < 3u; j++) {
        let c = l.columns[j];
        // κ Lᵀ of the screen vector without the standard deviation.
        let u = pair_add(pair_mul(l11, c.ray[0]), pair_mul(l21, c.ray[1])).x;
        let v = pair_mul(l22, c.ray[1]).x;
        // κ² M B / κ² with the factor 1/κ⁴ of the two κ L: (2 ln 2)².
        let n_u = (m_uu * u + m_uv * v) * 1.9218121;
        let n_v = (m_uv * u + m_vv * v) * 1.9218121;
        d_s[j] = (u * n_u + v * n_v) * c.s;
        let d_a = vec2<f32>(l11.x * n_u, fma(l21.x, n_u, l22.x * n_v)) * c.s;
        let scaled = d_a * k;
        d_v[j] = vec3<f32>(scaled, -dot(scaled, tangent)) * c.s;
        d_tangent -= scaled * (c.v[2].x * c.s);
        // Both axes of dA·A together: without the cancellation between them.
        d_k += d_s[j] * c.s;
    }
    var d_p = vec3<f32>(0.0, 0.0, high.z);
    let d_ratio = d_screen * frame.focal + l.free * d_tangent;
    d_p.x = d_ratio.x * inv_z;
    d_p.y = d_ratio.y * inv_z;
    // A is k times something, and k falls with z: d_k is already times k.
    d_p.z -= d_k * inv_z;
    d_p.z -= (d_ratio.x * l.p[0].x + d_ratio.y * l.p[1].x) * inv_z * inv_z;
    out.mean = finite(vec4<f32>(to_world_axes(d_p), low.x / opacity));
    out.screen = finite(vec4<f32>(d_screen, 0.0, 0.0));
    let x_column = to_world_axes(d_v[0]);
    let y_column = to_world_axes(d_v[1]);
    let z_column = to_world_axes(d_v[2]);
    if frame.factors != 0u {
        out.form_a = finite(vec4<f32>(x_column.x, x_column.y, y_column.y, x_column.z));
        out.form_b = finite(vec4<f32>(y_column.z, z_column.z, 0.0, 0.0));
        gradient[i] = out;
        return;
    }
    let q = l.q;
    let s01 = y_column.x + x_column.y;
    let s02 = z_column.x + x_column.z;
    let s12 = z_column.y + y_column.z;
    let a21 = y_column.z - z_column.y;
    let a02 = z_column.x - x_column.z;
    let a10 = x_column.y - y_column.x;
    let diagonal = vec3<f32>(x_column.x, y_column.y, z_column.z);
    let d_q = 2.0 * vec4<f32>(
        q.y * s01 + q.z * s02 - 2.0 * q.x * (diagonal.y + diagonal.z) + q.w * a21,
        q.x * s01 + q.z * s12 - 2.0 * q.y * (diagonal.x + diagonal.z) + q.w * a02,
        q.x * s02 + q.y * s12 - 2.0 * q.z * (diagonal.x + diagonal.y) + q.w * a10,
        q.x * a21 + q.y * a02 + q.z * a10,
    );
    out.form_a = finite((d_q - q * dot(d_q, q)) * l.inv_norm);
    out.form_b = finite(vec4<f32>(d_s, 0.0));
    gradient[i] = out;
}
