// What leaves a medium at a Gaussian, before its tint [eq:medium-residual]. After frame.wgsl, model_view.wgsl.

@group(0) @binding(1) var<storage, read> view: ModelView;
@group(0) @binding(2) var<storage, read> means: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> visibility: array<f32>;
// By Gaussian six surfels, then the bits of their weights.
@group(0) @binding(4) var<storage, read> attachment: array<u32>;
// By surfel: radiance that leaves it under the light with intensity 1.
@group(0) @binding(5) var<storage, read> leaving: array<f32>;

const NEIGHBOURS: u32 = 6u;
const MAX_RATIO: f32 = 1e15;

// Share of what is sent that is seen: less from behind. No gradient goes through it.
fn front(i: u32, normal: vec3<f32>) -> f32 {
    let away = view.eye - means[i].xyz;
    let distance = sqrt(dot(away, away));
    var viewer = vec3<f32>(0.0, 0.0, 1.0);
    if distance >= SMALLEST {
        viewer = away / distance;
    }
    return clamp(1.0 + dot(normal, viewer), 0.0, 1.0);
}

fn untinted(i: u32, normal: vec3<f32>) -> vec3<f32> {
    var around = vec3<f32>(0.0);
    for (var k = 0u; k < NEIGHBOURS; k++) {
        let at = 3u * attachment[2u * NEIGHBOURS * i + k];
        let weight = bitcast<f32>(attachment[2u * NEIGHBOURS * i + NEIGHBOURS + k]);
        around += weight * vec3<f32>(leaving[at], leaving[at + 1u], leaving[at + 2u]);
    }
    let light = toward_light(view, means[i].xyz);
    var ratio = 1.0;
    if view.falloff_reference > 0.0 && light.w > 0.0 {
        ratio = min(view.falloff_reference / light.w, MAX_RATIO);
    }
    let falls = ratio * ratio;
    let over_falloff = select(0.0, 1.0 / falls, falls > SMALLEST);
    let cos_theta_i = max(dot(normal, light.xyz), 0.0);
    return (around * (over_falloff / view.whole) + view.local * (visibility[i] * cos_theta_i)) * front(i, normal);
}
