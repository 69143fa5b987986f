// What the stages between Gaussians and their residual know of the view, the light and the network: `ModelView` in model_view.rs.
// After frame.wgsl.
struct ModelView {
    // The camera's centre, world.
    eye: vec3<f32>,
    // 1: `light` is a direction.
    directional: u32,
    // Centre of the scene's box, and 1 over half its side.
    centre: vec3<f32>,
    inverse_half: f32,
    // Of a point light its position, of a directional one its direction.
    light: vec3<f32>,
    // Distance that counts as 0 to the network.
    light_reference: f32,
    // Bit c: the shader's channel c is blended.
    channels: u32,
    // Latent codes per Gaussian.
    codes: u32,
    // Harmonics per colour of the transfer vectors; 0: there are none.
    harmonics: u32,
    // 1: there is a network; 2: it has a head for incident light; 4: that head learns; 8: normals learn by the network.
    network: u32,
    // First Gaussian and number of Gaussians that go through the network together, and numbers per row of its inputs.
    first: u32,
    rows: u32,
    width: u32,
    // Weight of a term.
    weight: f32,
    // Of a medium: what leaves where it enters, and the subsurfaceness that transport is divided by.
    local: vec3<f32>,
    whole: f32,
    // Of the inverse square of the lights; 0: no falloff.
    falloff_reference: f32,
    // A Gaussian's tint over its base colour.
    tint: f32,
    // Distance of lights that were drawn.
    sample_distance: f32,
    unused_0: f32,
}

// As on the CPU, where each reason is said.
const MAX_OFFSET: f32 = 1e15;
const MIN_LIGHT_DISTANCE: f32 = 1e-4;
const SMALLEST: f32 = 1.1754944e-38;

// Unit direction to the light; its distance, −1 for a light at infinity [eq:light-incidence].
fn toward_light(view: ModelView, at: vec3<f32>) -> vec4<f32> {
    if view.directional != 0u {
        return vec4<f32>(view.light, -1.0);
    }
    let offset = clamp(view.light - at, vec3<f32>(-MAX_OFFSET), vec3<f32>(MAX_OFFSET));
    let length = sqrt(dot(offset, offset));
    var direction = vec3<f32>(0.0, 0.0, 1.0);
    if length >= SMALLEST {
        direction = offset / length;
    }
    return vec4<f32>(direction, max(length, MIN_LIGHT_DISTANCE));
}

// The sixteen real harmonics up to degree 3 [eq:sh-basis].
fn harmonics_of(d: vec3<f32>) -> array<f32, 16> {
    let s = d * d;
    return array<f32, 16>(
        0.28209479,
        -0.48860251 * d.y,
        0.48860251 * d.z,
        -0.48860251 * d.x,
        1.0925484 * d.x * d.y,
        -1.0925484 * d.y * d.z,
        0.31539157 * (3.0 * s.z - 1.0),
        -1.0925484 * d.x * d.z,
        0.5462742 * (s.x - s.y),
        -0.5900436 * d.y * (3.0 * s.x - s.y),
        2.8906114 * d.x * d.y * d.z,
        -0.4570458 * d.y * (5.0 * s.z - 1.0),
        0.37317634 * d.z * (5.0 * s.z - 3.0),
        -0.4570458 * d.x * (5.0 * s.z - 1.0),
        1.4453057 * d.z * (s.x - s.y),
        -0.5900436 * d.x * (s.x - 3.0 * s.y),
    );
}
