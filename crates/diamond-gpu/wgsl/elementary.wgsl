// Functions that a device may compute with errors that a threshold would not forgive, to about one unit in the last place.

// e^x for −86 ≤ x ≤ 88, where it is cut: x = n·ln 2 + r with n·(355/512) exact, and the series of e^r to r⁷.
fn exp_of(x: f32) -> f32 {
    let bounded = clamp(x, -86.0, 88.0);
    let whole = round(bounded * 1.442695);
    let r = fma(whole, 0.00021219444, fma(-whole, 0.693359375, bounded));
    var p = fma(1.0 / 5040.0, r, 1.0 / 720.0);
    p = fma(p, r, 1.0 / 120.0);
    p = fma(p, r, 1.0 / 24.0);
    p = fma(p, r, 1.0 / 6.0);
    p = fma(p, r, 0.5);
    p = fma(p * r, r, r) + 1.0;
    return bitcast<f32>(bitcast<u32>(p) + (u32(i32(whole)) << 23u));
}

fn sigmoid_of(x: f32) -> f32 {
    return 1.0 / (1.0 + exp_of(-x));
}

// sin(π·x) and cos(π·x) for |x| ≤ 1: the quarter turn nearest to x, and series on what is left of it.
fn sin_cos_pi(x: f32) -> vec2<f32> {
    let quarter = round(2.0 * x);
    let r = (x - 0.5 * quarter) * 3.1415927;
    let square = r * r;
    var s = fma(-1.0 / 5040.0, square, 1.0 / 120.0);
    s = fma(s, square, -1.0 / 6.0);
    s = fma(s * square, r, r);
    var c = fma(1.0 / 40320.0, square, -1.0 / 720.0);
    c = fma(c, square, 1.0 / 24.0);
    c = fma(c, square, -0.5);
    c = fma(c, square, 1.0);
    let turn = u32(i32(quarter)) & 3u;
    let a = select(s, c, (turn & 1u) == 1u);
    let b = select(c, s, (turn & 1u) == 1u);
    return vec2<f32>(select(a, -a, turn >= 2u), select(b, -b, turn == 1u || turn == 2u));
}
