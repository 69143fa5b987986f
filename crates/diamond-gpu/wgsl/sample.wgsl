// A Gaussian that is asked what the residual adds, under a light and from a direction that were drawn: `Sample` in model_view.rs.
struct Sample {
    // Unit direction to the viewer, or its opposite.
    viewer: vec3<f32>,
    gaussian: u32,
    // Unit direction to the light.
    light: vec3<f32>,
    // Of the light, for the so manyth sample whose light is in front of its normal.
    visibility: f32,
}
