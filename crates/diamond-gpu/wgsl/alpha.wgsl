// What a Gaussian is to a pixel, as the CPU evaluates it: α = o · 2^(−u² − v²) with (u, v) = κ·Lᵀd, which is found in more
// than f32 at the centre of a tile and is affine in small exact offsets from there [eq:splat-alpha].

struct Prepared {
    // u and v at the tile's centre, du/dx and du/dy.
    affine: vec4<f32>,
    // dv/dy, opacity, view-space z.
    rest: vec4<f32>,
}

fn prepare(splat: Splat, tile: vec2<u32>) -> Prepared {
    let centre = vec2<f32>(tile * 16u + 8u);
    let d_x = pair_sub(pair_of(centre.x), splat.mean.xy);
    let d_y = pair_sub(pair_of(centre.y), splat.mean.zw);
    let u = pair_add(pair_mul(splat.chol.xy, d_x), pair_mul(splat.chol.zw, d_y));
    let v = pair_mul(splat.rest.xy, d_y);
    var p: Prepared;
    p.affine = vec4<f32>(u.x, v.x, splat.chol.x, splat.chol.z);
    p.rest = vec4<f32>(splat.rest.x, splat.rest.z, splat.rest.w, 0.0);
    return p;
}

// 2^t for t ≤ 0, relative error 2.5e-7; at or below −126 the smallest normal number. The CPU's polynomial: what a
// device calls exp2 may be wrong by more than a threshold forgives.
fn power_of_two_at(t: f32) -> f32 {
    let bounded = max(t, -126.0);
    let whole = round(bounded);
    let f = bounded - whole;
    var p = fma(0.0013276472, f, 0.009675541);
    p = fma(p, f, 0.055507133);
    p = fma(p, f, 0.2402212);
    p = fma(p, f, 0.69314697);
    p = fma(p, f, 1.0000001);
    return bitcast<f32>(bitcast<u32>(p) + (u32(i32(whole)) << 23u));
}

// u and v of a pixel at this offset from the tile's centre.
fn whitened(p: Prepared, offset: vec2<f32>) -> vec2<f32> {
    let u = fma(p.affine.w, offset.y, fma(p.affine.z, offset.x, p.affine.x));
    return vec2<f32>(u, fma(p.rest.x, offset.y, p.affine.y));
}

// α before its limits.
fn raw_alpha(p: Prepared, offset: vec2<f32>) -> f32 {
    let uv = whitened(p, offset);
    return p.rest.y * power_of_two_at(-fma(uv.x, uv.x, uv.y * uv.y));
}

// α: 0 below the threshold, and no more than the largest.
fn limited_alpha(a: f32) -> f32 {
    return select(0.0, min(a, frame.max_alpha), a >= frame.min_alpha);
}
