// shade: blended channels to the radiance of every pixel under one light, and its maps [eq:deferred-composite]
// [eq:deferred-incident] [eq:deferred-combine]. After frame.wgsl, pair.wgsl, shading.wgsl.

@group(0) @binding(1) var<storage, read> lighting: Lighting;
// Fourteen channels in four groups: base colour, roughness | metalness, subsurfaceness, normal x, y | normal z, residual |
// incident, visibility.
@group(0) @binding(2) var<storage, read> picture: array<vec4<f32>>;
// Opacity, depth, transmittance, reach.
@group(0) @binding(3) var<storage, read> coverage: array<vec4<f32>>;
// 24 numbers per pixel: radiance, surface, subsurface, base colour, roughness, metalness, subsurfaceness, normal,
// residual, incident, visibility, depth.
@group(0) @binding(4) var<storage, read_write> record: array<vec4<f32>>;

@compute @workgroup_size(256)
fn shade(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) count: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = linear_workgroup(id, count) * 256u + lane;
    if i >= frame.size.x * frame.size.y {
        return;
    }
    let pixel = vec2<u32>(i % frame.size.x, i / frame.size.x);
    let c = coverage[i].xy;
    let light = lighting;
    let p = point_of(
        light,
        picture[4u * i],
        picture[4u * i + 1u],
        picture[4u * i + 2u],
        picture[4u * i + 3u],
        c.x,
        c.y,
        pixel,
    );
    if !p.covered {
        for (var k = 0u; k < 6u; k++) {
            record[6u * i + k] = vec4<f32>(0.0);
        }
        return;
    }
    let arriving = arriving_at(light, p.position);
    let factor = select(1.0, p.incident + light.incident_offset, light.learned_incident != 0u);
    let facing = Directions(p.normal, p.view, arriving.direction);
    let seen = select(1.0, p.visibility, light.surface_visibility != 0u);
    let weights = combine_weights(light, p.subsurfaceness);
    let scale = select(vec3<f32>(1.0), light.intensity, light.scale_residual != 0u);
    let surface = reflected(light, p.material, facing, arriving.irradiance * factor) * seen * weights.x * p.opacity;
    let subsurface = p.residual * scale * weights.y * p.opacity;
    let radiance = surface + subsurface;
    let m = p.material;
    record[6u * i] = vec4<f32>(radiance, surface.x);
    record[6u * i + 1u] = vec4<f32>(surface.yz, subsurface.xy);
    record[6u * i + 2u] = vec4<f32>(subsurface.z, m.base_color);
    record[6u * i + 3u] = vec4<f32>(m.roughness, m.metalness, p.subsurfaceness, p.normal.x);
    record[6u * i + 4u] = vec4<f32>(p.normal.yz, p.residual.xy);
    record[6u * i + 5u] = vec4<f32>(p.residual.z, p.incident, p.visibility, p.depth);
}
