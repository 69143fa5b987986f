// residual_inputs: what the residual network is told about each Gaussian under the light [eq:residual-inputs]. After frame.wgsl,
// elementary.wgsl, model_view.wgsl, residual_row.wgsl.

@group(0) @binding(6) var<storage, read> visibility: array<f32>;

@compute @workgroup_size(256)
fn residual_inputs(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = linear_workgroup(id, grid) * 256u + lane;
    if row >= view.rows {
        return;
    }
    let i = view.first + row;
    let position = means[i].xyz;
    let away = view.eye - position;
    let distance = sqrt(dot(away, away));
    var viewer = vec3<f32>(0.0, 0.0, 1.0);
    if distance >= SMALLEST {
        viewer = away / distance;
    }
    let light = toward_light(view, position);
    write_row(row, i, viewer, light.xyz, light.w, visibility[i]);
}
