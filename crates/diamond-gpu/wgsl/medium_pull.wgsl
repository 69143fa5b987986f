// medium_pull: cotangents of what a medium sends out to base colours, and through what leaves where it enters to normals and positions
// [eq:medium-residual] [eq:surfel-irradiance]. After frame.wgsl, model_view.wgsl, medium.wgsl.

// `GaussianGrad` in frame.rs.
struct GaussianGrad {
    mean: vec4<f32>,
    form_a: vec4<f32>,
    form_b: vec4<f32>,
    screen: vec4<f32>,
}

@group(0) @binding(6) var<storage, read> features: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> d_features: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> gradient: array<GaussianGrad>;

@compute @workgroup_size(256)
fn medium_pull(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, grid) * 256u + lane;
    if i >= frame.gaussians {
        return;
    }
    let normal = vec3<f32>(features[4u * i + 1u].zw, features[4u * i + 2u].x);
    let d = d_features[4u * i + 2u].yzw;
    d_features[4u * i] += vec4<f32>(d * untinted(i, normal) * view.tint, 0.0);
    let light = toward_light(view, means[i].xyz);
    let seen = visibility[i];
    if dot(normal, light.xyz) > 0.0 && seen > 0.0 {
        let d_cosine = seen * front(i, normal) * dot(d * features[4u * i].xyz * view.tint, view.local);
        let d_normal = light.xyz * d_cosine;
        d_features[4u * i + 1u] += vec4<f32>(0.0, 0.0, d_normal.xy);
        d_features[4u * i + 2u] += vec4<f32>(d_normal.z, 0.0, 0.0, 0.0);
        if light.w > 0.0 {
            let d_direction = normal * d_cosine;
            let across = d_direction - light.xyz * dot(d_direction, light.xyz);
            gradient[i].mean -= vec4<f32>(across / light.w, 0.0);
        }
    }
}
