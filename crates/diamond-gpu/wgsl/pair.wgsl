// Numbers as unevaluated sums (high, low) of two f32: some 45 bits, for what the CPU computes in f64.
//
// The error of a sum or a product is only an error to those who believe in rounding; a compiler that may use the laws
// of real numbers finds it to be 0. `opaque` stands where it must not: it changes no bit, and cannot be seen through.

fn opaque(x: f32) -> f32 {
    return bitcast<f32>(bitcast<u32>(x) ^ frame.zero);
}

// a + b exactly.
fn two_sum(a: f32, b: f32) -> vec2<f32> {
    let s = opaque(a + b);
    let from_b = opaque(s - a);
    let from_a = opaque(s - from_b);
    return vec2<f32>(s, opaque(a - from_a) + opaque(b - from_b));
}

// a + b exactly where |a| ≥ |b|.
fn quick_two_sum(a: f32, b: f32) -> vec2<f32> {
    let s = opaque(a + b);
    return vec2<f32>(s, b - opaque(s - a));
}

// The leading 12 bits.
fn leading(x: f32) -> f32 {
    return bitcast<f32>(bitcast<u32>(x) & 0xFFFFF000u);
}

// a · b exactly: products of halves have no rounding error, fused with an addition or not.
fn two_product(a: f32, b: f32) -> vec2<f32> {
    let p = opaque(a * b);
    let a_high = leading(a);
    let b_high = leading(b);
    let a_low = opaque(a - a_high);
    let b_low = opaque(b - b_high);
    let e0 = opaque(a_high * b_high - p);
    let e1 = opaque(e0 + a_high * b_low);
    let e2 = opaque(e1 + a_low * b_high);
    return vec2<f32>(p, e2 + a_low * b_low);
}

fn pair_add(a: vec2<f32>, b: vec2<f32>) -> vec2<f32> {
    let s = two_sum(a.x, b.x);
    return quick_two_sum(s.x, s.y + (a.y + b.y));
}

fn pair_sub(a: vec2<f32>, b: vec2<f32>) -> vec2<f32> {
    return pair_add(a, -b);
}

fn pair_mul(a: vec2<f32>, b: vec2<f32>) -> vec2<f32> {
    let p = two_product(a.x, b.x);
    return quick_two_sum(p.x, p.y + (a.x * b.y + a.y * b.x));
}

fn pair_scale(a: vec2<f32>, b: f32) -> vec2<f32> {
    let p = two_product(a.x, b);
    return quick_two_sum(p.x, p.y + a.y * b);
}

// a / b: a quotient of f32, corrected twice by what is left.
fn pair_div(a: vec2<f32>, b: vec2<f32>) -> vec2<f32> {
    let q0 = opaque(a.x / b.x);
    let r0 = pair_sub(a, pair_scale(b, q0));
    let q1 = opaque(r0.x / b.x);
    let r1 = pair_sub(r0, pair_scale(b, q1));
    let q2 = opaque(r1.x / b.x);
    let q = quick_two_sum(q0, q1);
    return quick_two_sum(q.x, q.y + q2);
}

// The square root of a number above 0: one of f32, corrected twice.
fn pair_sqrt(a: vec2<f32>) -> vec2<f32> {
    let s0 = opaque(sqrt(a.x));
    let r0 = pair_sub(a, two_product(s0, s0));
    let s1 = quick_two_sum(s0, opaque(r0.x / (2.0 * s0)));
    let r1 = pair_sub(a, pair_mul(s1, s1));
    return quick_two_sum(s1.x, s1.y + r1.x / (2.0 * s0));
}

fn pair_of(x: f32) -> vec2<f32> {
    return vec2<f32>(x, 0.0);
}

// a·x + b·y + c·z.
fn pair_dot(a: vec2<f32>, b: vec2<f32>, c: vec2<f32>, row: vec3<f32>) -> vec2<f32> {
    return pair_add(pair_add(pair_scale(a, row.x), pair_scale(b, row.y)), pair_scale(c, row.z));
}

// Whether |x| ≤ limit; no for what is not a number, also where a compiler may assume that there is no such thing.
fn within(x: f32, limit: f32) -> bool {
    return (bitcast<u32>(x) & 0x7FFFFFFFu) <= bitcast<u32>(limit);
}

// The power of two at or below |x|, at least `least` (a power of two), and its reciprocal.
fn power_of_two(x: f32, least: f32) -> vec2<f32> {
    let bits = clamp(bitcast<u32>(x) & 0x7F800000u, bitcast<u32>(least), 0x7E000000u);
    return vec2<f32>(bitcast<f32>(bits), bitcast<f32>(0x7F000000u - bits));
}
