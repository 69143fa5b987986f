// shade_pull: cotangents of radiance and maps to those of the blended channels [eq:deferred-composite]. After frame.wgsl,
// pair.wgsl, shading.wgsl.

@group(0) @binding(1) var<storage, read> lighting: Lighting;
@group(0) @binding(2) var<storage, read> picture: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> coverage: array<vec4<f32>>;
// 20 numbers per pixel: radiance, base colour, roughness, metalness, subsurfaceness, normal, residual, incident, visibility, depth, what
// the objective says of the opacity itself, and one of padding.
@group(0) @binding(4) var<storage, read> d_record: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> d_picture: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> d_coverage: array<vec2<f32>>;

@compute @workgroup_size(256)
fn shade_pull(
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
    let f0 = picture[4u * i];
    let f1 = picture[4u * i + 1u];
    let f2 = picture[4u * i + 2u];
    let f3 = picture[4u * i + 3u];
    let p = point_of(light, f0, f1, f2, f3, c.x, c.y, pixel);
    if !p.covered {
        for (var k = 0u; k < 4u; k++) {
            d_picture[4u * i + k] = vec4<f32>(0.0);
        }
        d_coverage[i] = vec2<f32>(d_record[5u * i + 4u].z, 0.0);
        return;
    }
    let e0 = d_record[5u * i];
    let e1 = d_record[5u * i + 1u];
    let e2 = d_record[5u * i + 2u];
    let e3 = d_record[5u * i + 3u];
    let e4 = d_record[5u * i + 4u];
    let d_shown = e0.xyz;
    let d_radiance = d_shown * p.opacity;
    var d_base_color = vec3<f32>(e0.w, e1.xy);
    var d_roughness = e1.z;
    var d_metalness = e1.w;
    var d_subsurfaceness = e2.x;
    var d_normal = e2.yzw;
    var d_residual = e3.xyz;
    var d_incident = e3.w;
    var d_visibility = e4.x;
    var d_depth = e4.y;

    let arriving = arriving_at(light, p.position);
    let learned = light.learned_incident != 0u;
    let factor = select(1.0, p.incident + light.incident_offset, learned);
    let irradiance = arriving.irradiance * factor;
    let facing = Directions(p.normal, p.view, arriving.direction);
    let seen = select(1.0, p.visibility, light.surface_visibility != 0u);
    let weights = combine_weights(light, p.subsurfaceness);
    let scale = select(vec3<f32>(1.0), light.intensity, light.scale_residual != 0u);
    let d_surface = d_radiance * weights.x;

    // Surface.
    let value = reflected(light, p.material, facing, irradiance);
    let g = reflected_pull(light, p.material, facing, irradiance, d_surface * seen);
    d_base_color += g.material.base_color;
    d_roughness += g.material.roughness;
    d_metalness += g.material.metalness;
    d_normal += g.directions.normal;

    // Combination.
    d_residual += d_radiance * weights.y * scale;
    d_subsurfaceness += dot(d_radiance, value * (seen * weights.z) + p.residual * scale * weights.w);
    if light.surface_visibility != 0u {
        d_visibility += dot(d_surface, value);
    }
    if learned {
        d_incident += dot(g.irradiance, arriving.irradiance);
    }
    let d_position = arriving_pull(light, arriving, g.directions.light, g.irradiance * factor);

    // The surface point.
    let d_camera = vec3<f32>(
        dot(frame.row_x.xyz, d_position),
        dot(frame.row_y.xyz, d_position),
        dot(frame.row_z.xyz, d_position),
    );
    d_depth += dot(d_camera, p.through);
    var d_blended = vec3<f32>(0.0);
    if p.normal_length > 0.0 {
        d_blended = (d_normal - p.normal * dot(p.normal, d_normal)) / p.normal_length;
    }
    if light.fixed_roughness != 0u {
        d_roughness = 0.0;
    }

    // The division by opacity.
    let d0 = vec4<f32>(d_base_color, d_roughness);
    let d1 = vec4<f32>(d_metalness, d_subsurfaceness, d_blended.xy);
    let d2 = vec4<f32>(d_blended.z, d_residual);
    let d3 = vec4<f32>(d_incident, d_visibility, 0.0, 0.0);
    var d_inverse = d_depth * p.depth;
    if light.normalise != 0u {
        d_inverse += (dot(d0, f0) + dot(d1, f1) + dot(d2, f2) + dot(d3.xy, f3.xy)) * p.weight;
    }
    let lit = value * seen * weights.x + p.residual * scale * weights.y;
    d_picture[4u * i] = d0 * p.weight;
    d_picture[4u * i + 1u] = d1 * p.weight;
    d_picture[4u * i + 2u] = d2 * p.weight;
    d_picture[4u * i + 3u] = d3 * p.weight;
    d_coverage[i] = vec2<f32>(dot(d_shown, lit) - d_inverse / p.opacity + e4.z, d_depth / p.opacity);
}
