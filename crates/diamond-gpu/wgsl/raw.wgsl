// Where the raw parameters of the Gaussians lie among all of them: `Raw` in parameter_arrays.rs. First numbers, in arrays of N × width.
struct Raw {
    mean: u32,
    scale: u32,
    rotation: u32,
    opacity: u32,
    normal: u32,
    base_color: u32,
    roughness: u32,
    metalness: u32,
    subsurfaceness: u32,
    // Bit c: the shader's channel c is blended; others stay 0.
    channels: u32,
    unused_0: u32,
    unused_1: u32,
}

// As on the CPU: shorter normals have no direction.
const MIN_NORMAL: f32 = 1e-12;

fn wanted(channels: u32, channel: u32, value: f32) -> f32 {
    return select(0.0, value, ((channels >> channel) & 1u) == 1u);
}
