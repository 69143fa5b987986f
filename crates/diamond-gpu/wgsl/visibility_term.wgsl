// visibility_term: visibility by harmonics against the traced one for some Gaussians, and its gradient [eq:visibility]
// [eq:sh-visibility]. After frame.wgsl, model_view.wgsl.

@group(0) @binding(1) var<storage, read> view: ModelView;
@group(0) @binding(2) var<storage, read> means: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> coefficients: array<f32>;
@group(0) @binding(4) var<storage, read> traced: array<f32>;
// A Gaussian, each once, and how often it was drawn.
@group(0) @binding(5) var<storage, read> samples: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read_write> d_coefficients: array<f32>;
@group(0) @binding(7) var<storage, read_write> values: array<vec4<f32>>;

@compute @workgroup_size(256)
fn visibility_term(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let n = linear_workgroup(id, grid) * 256u + lane;
    if n >= view.rows {
        return;
    }
    let i = samples[n].x;
    let times = f32(samples[n].y);
    var y = harmonics_of(toward_light(view, means[i].xyz).xyz);
    var sum = 0.5;
    for (var k = 0u; k < 16u; k++) {
        sum = fma(coefficients[16u * i + k], y[k], sum);
    }
    let difference = clamp(sum, 0.0, 1.0) - traced[i];
    values[n] = vec4<f32>(times * abs(difference), 0.0, 0.0, 0.0);
    // Nothing passes where the sum is cut.
    let d = select(0.0, view.weight * times * sign(difference), sum >= 0.0 && sum <= 1.0);
    for (var k = 0u; k < 16u; k++) {
        d_coefficients[16u * i + k] = fma(d, y[k], d_coefficients[16u * i + k]);
    }
}
