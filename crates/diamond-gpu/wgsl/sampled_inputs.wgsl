// sampled_inputs: what the residual network is told where it is asked to add nothing [eq:residual-pull] [eq:residual-inputs]. After
// frame.wgsl, elementary.wgsl, model_view.wgsl, residual_row.wgsl, sample.wgsl.

@group(0) @binding(6) var<storage, read> samples: array<Sample>;

fn in_front(s: Sample) -> bool {
    return dot(s.light, normal_of(s.gaussian)) > 0.0;
}

@compute @workgroup_size(256)
fn sampled_inputs(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = linear_workgroup(id, grid) * 256u + lane;
    if row >= view.rows {
        return;
    }
    let s = samples[row];
    let normal = normal_of(s.gaussian);
    // The numbers that were drawn go to those whose light is in front, one after the other.
    var place = 0u;
    for (var before = 0u; before < row; before++) {
        place += u32(in_front(samples[before]));
    }
    let viewer = select(s.viewer, -s.viewer, dot(s.viewer, normal) < 0.0);
    let seen = select(0.0, samples[place].visibility, in_front(s));
    write_row(row, s.gaussian, viewer, s.light, view.sample_distance, seen);
}
