// What every kernel knows of the picture that is made: `Frame` in frame.rs, checked against it by a test.
struct Frame {
    // Rows of the rotation from world to camera; the translation is in w.
    row_x: vec4<f32>,
    row_y: vec4<f32>,
    row_z: vec4<f32>,
    // Focal lengths and principal point, px.
    focal: vec2<f32>,
    principal: vec2<f32>,
    // Limits of x/z and y/z where the perspective map is linearised.
    tangent_low: vec2<f32>,
    tangent_high: vec2<f32>,
    // Pixels, and tiles of 16 × 16 pixels.
    size: vec2<u32>,
    tiles: vec2<u32>,
    gaussians: u32,
    // 1: forms are lower factors; 0: quaternions and standard deviations.
    factors: u32,
    // Always 0, which compilers cannot know: see `opaque`.
    zero: u32,
    // Entries that there is room for.
    capacity: u32,
    low_pass: f32,
    min_alpha: f32,
    max_alpha: f32,
    min_transmittance: f32,
    near: f32,
    // Of a picture's gradient, where it is one: unused otherwise.
    unused_0: f32,
    unused_1: f32,
    unused_2: f32,
}

// One Gaussian on the screen: `Splat` in splat.rs. Numbers come as (high, low) where 24 bits do not suffice.
struct Splat {
    // Projected mean, px: x high, x low, y high, y low.
    mean: vec4<f32>,
    // κ·L, the lower Cholesky factor of the inverse covariance, 1/px: l11 high, low, l21 high, low.
    chol: vec4<f32>,
    // l22 high, low; opacity (0: culled); view-space z.
    rest: vec4<f32>,
}

@group(0) @binding(0) var<uniform> frame: Frame;

// κ² = ½ log2 e.
const KAPPA: f32 = 0.8493218;

// The index of a workgroup in a grid that is two-dimensional where one dimension does not suffice.
fn linear_workgroup(id: vec3<u32>, count: vec3<u32>) -> u32 {
    return id.x + id.y * count.x;
}
