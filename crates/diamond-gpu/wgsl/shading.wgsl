// One pixel under one light, forward and backward: the formulas of diamond-shading. After frame.wgsl, pair.wgsl.

// `Lighting` in lighting.rs.
struct Lighting {
    // Of a point light its position, of a directional one its direction.
    place: vec3<f32>,
    // 1: directional.
    directional: u32,
    // Intensity or irradiance, linear RGB.
    intensity: vec3<f32>,
    // Of the inverse square; 0: no falloff.
    reference: f32,
    // 0 Smith separable, 1 Smith correlated, 2 Schlick by roughness, 3 Schlick by half of α.
    masking: u32,
    // 0 Schlick, 1 spherical Gaussian.
    fresnel: u32,
    // 0 Lambert, 1 weighted by Fresnel, 2 omitted.
    diffuse: u32,
    // 0: (1 − s)·surface + s·residual; 1: surface + s·residual.
    additive: u32,
    // Flags, 0 or 1.
    learned_incident: u32,
    normalise: u32,
    surface_visibility: u32,
    use_residual: u32,
    scale_residual: u32,
    // Instead of the roughness channel, where the flag is 1.
    fixed_roughness: u32,
    roughness: f32,
    horizon_leak: f32,
    incident_offset: f32,
    unused_0: f32,
    unused_1: f32,
    unused_2: f32,
}

const FRAC_1_PI: f32 = 0.31830987;
const DIELECTRIC_F0: f32 = 0.04;
// Each as on the CPU, where its reason is said.
const MIN_ROUGHNESS: f32 = 1e-3;
const MIN_OPACITY: f32 = 1e-5;
const MIN_COS_THETA_O: f32 = 1e-4;
const MIN_NORMAL_LENGTH: f32 = 1e-6;
const MIN_HALF_LENGTH2: f32 = 1e-12;
const MIN_CORRELATED_DENOMINATOR: f32 = 1e-12;
const MIN_LIGHT_DISTANCE: f32 = 1e-4;
const MIN_COSINE: f32 = 1.1754944e-38;
const TURNED_AWAY: f32 = 1e-5;
const MAX_OFFSET: f32 = 1e15;
const MAX_RATIO: f32 = 1e15;
const LARGEST_NUMBER: f32 = 3.4028234e38;

struct Material {
    base_color: vec3<f32>,
    roughness: f32,
    metalness: f32,
}

struct Angles {
    cos_i: f32,
    cos_o: f32,
    cos_d: f32,
    sin2_h: f32,
}

struct Directions {
    normal: vec3<f32>,
    view: vec3<f32>,
    light: vec3<f32>,
}

// a × b where it nearly vanishes: each difference of products in more than f32.
fn exact_cross(a: vec3<f32>, b_x: vec2<f32>, b_y: vec2<f32>, b_z: vec2<f32>) -> vec3<f32> {
    return vec3<f32>(
        pair_sub(pair_scale(b_z, a.y), pair_scale(b_y, a.z)).x,
        pair_sub(pair_scale(b_x, a.z), pair_scale(b_z, a.x)).x,
        pair_sub(pair_scale(b_y, a.x), pair_scale(b_x, a.y)).x,
    );
}

// n × (v + l).
fn across_half(f: Directions) -> vec3<f32> {
    let x = two_sum(f.view.x, f.light.x);
    let y = two_sum(f.view.y, f.light.y);
    let z = two_sum(f.view.z, f.light.z);
    return exact_cross(f.normal, x, y, z);
}

fn angles_of(f: Directions) -> Angles {
    let sum = f.view + f.light;
    let square = dot(sum, sum);
    let across = across_half(f);
    var a = Angles(dot(f.normal, f.light), dot(f.normal, f.view), 0.0, 1.0);
    if square >= MIN_HALF_LENGTH2 {
        a.cos_d = dot(f.view, sum) / sqrt(square);
        a.sin2_h = min(dot(across, across) / square, 1.0);
    }
    return a;
}

fn angles_pull(f: Directions, d: Angles) -> Directions {
    let sum = f.view + f.light;
    let square = dot(sum, sum);
    var inverse = 0.0;
    if square >= MIN_HALF_LENGTH2 {
        inverse = 1.0 / sqrt(square);
    }
    let h = sum * inverse;
    let d_cross = across_half(f) * (2.0 * inverse * d.sin2_h);
    let d_h = cross(d_cross, f.normal) + f.view * d.cos_d;
    let d_sum = (d_h - h * dot(h, d_h)) * inverse;
    return Directions(
        f.light * d.cos_i + f.view * d.cos_o + cross(h, d_cross),
        f.normal * d.cos_o + h * d.cos_d + d_sum,
        f.normal * d.cos_i + d_sum,
    );
}

fn ellipsoid(alpha: f32, sin2_h: f32) -> f32 {
    return alpha * alpha * (1.0 - sin2_h) + sin2_h;
}

// [eq:ggx-d]
fn distribution(alpha: f32, sin2_h: f32) -> f32 {
    let ratio = alpha / ellipsoid(alpha, sin2_h);
    return ratio * ratio * FRAC_1_PI;
}

// By α and by sin² θ_h.
fn distribution_pull(alpha: f32, sin2_h: f32, d_out: f32) -> vec2<f32> {
    let t = ellipsoid(alpha, sin2_h);
    let ratio = alpha / t;
    let d = d_out * 2.0 * ratio * ratio * FRAC_1_PI;
    let d_alpha = d * (sin2_h - alpha * alpha * (1.0 - sin2_h)) / (alpha * t);
    return vec2<f32>(d_alpha, -d * (1.0 - alpha) * (1.0 + alpha) / t);
}

// √(cos² + α²·sin²), and its derivatives by the cosine and by α.
fn smith_root(alpha: f32, cosine: f32) -> vec3<f32> {
    let sin2 = (1.0 - cosine) * (1.0 + cosine);
    let value = sqrt(cosine * cosine + alpha * alpha * sin2);
    return vec3<f32>(value, cosine * (1.0 - alpha) * (1.0 + alpha) / value, alpha * sin2 / value);
}

// cos·(1 − k) + k, and its derivatives by the cosine and by k.
fn schlick_denominator(k: f32, cosine: f32) -> vec3<f32> {
    return vec3<f32>(cosine * (1.0 - k) + k, 1.0 - k, 1.0 - cosine);
}

// k of Schlick's form, and its derivative by the roughness.
fn schlick_k(masking: u32, roughness: f32) -> vec2<f32> {
    if masking == 2u {
        return vec2<f32>((roughness + 1.0) * (roughness + 1.0) * 0.125, (roughness + 1.0) * 0.25);
    }
    return vec2<f32>(roughness * roughness * 0.5, roughness);
}

// G/(4·n·v·n·l) [eq:smith-separable] [eq:smith-correlated] [eq:schlick-ggx]
fn over_cosines(masking: u32, roughness: f32, cos_o: f32, cos_i: f32) -> f32 {
    let alpha = roughness * roughness;
    if masking == 0u {
        return 1.0 / ((cos_o + smith_root(alpha, cos_o).x) * (cos_i + smith_root(alpha, cos_i).x));
    }
    if masking == 1u {
        let sum = cos_i * smith_root(alpha, cos_o).x + cos_o * smith_root(alpha, cos_i).x;
        return 0.5 / max(sum, MIN_CORRELATED_DENOMINATOR);
    }
    let k = schlick_k(masking, roughness).x;
    return k_quarter(k, cos_o, cos_i);
}

fn k_quarter(k: f32, cos_o: f32, cos_i: f32) -> f32 {
    return 0.25 / (schlick_denominator(k, cos_o).x * schlick_denominator(k, cos_i).x);
}

// By roughness, n·v, n·l.
fn over_cosines_pull(masking: u32, roughness: f32, cos_o: f32, cos_i: f32, d_out: f32) -> vec3<f32> {
    let alpha = roughness * roughness;
    if masking == 0u {
        let root_o = smith_root(alpha, cos_o);
        let root_i = smith_root(alpha, cos_i);
        let o = cos_o + root_o.x;
        let i = cos_i + root_i.x;
        let d = -d_out / (o * i);
        return d * vec3<f32>(
            (root_o.z / o + root_i.z / i) * 2.0 * roughness,
            (root_o.y + 1.0) / o,
            (root_i.y + 1.0) / i,
        );
    }
    if masking == 1u {
        let o = smith_root(alpha, cos_o);
        let i = smith_root(alpha, cos_i);
        let sum = cos_i * o.x + cos_o * i.x;
        if sum < MIN_CORRELATED_DENOMINATOR {
            return vec3<f32>(0.0);
        }
        let d = -d_out * (0.5 / sum) / sum;
        return d * vec3<f32>(
            (cos_i * o.z + cos_o * i.z) * 2.0 * roughness,
            cos_i * o.y + i.x,
            o.x + cos_o * i.y,
        );
    }
    let k = schlick_k(masking, roughness);
    let o = schlick_denominator(k.x, cos_o);
    let i = schlick_denominator(k.x, cos_i);
    let d = -d_out * 0.25 / (o.x * i.x);
    return d * vec3<f32>((o.z / o.x + i.z / i.x) * k.y, o.y / o.x, i.y / i.x);
}

// Weight between F0 and 1, and its derivative by v·h [eq:fresnel-schlick] [eq:fresnel-spherical-gaussian].
fn fresnel_weight(fresnel: u32, cos_d: f32) -> vec2<f32> {
    if fresnel == 0u {
        let m = clamp(1.0 - cos_d, 0.0, 1.0);
        let m2 = m * m;
        return vec2<f32>(m2 * m2 * m, m2 * m2 * -5.0);
    }
    let weight = exp2((cos_d * -5.55473 - 6.98316) * cos_d);
    return vec2<f32>(weight, weight * 0.6931472 * (cos_d * (2.0 * -5.55473) - 6.98316));
}

fn shaded_roughness(m: Material) -> f32 {
    return clamp(m.roughness, MIN_ROUGHNESS, 1.0);
}

// f at the angles, linear RGB per steradian [eq:brdf] [eq:diffuse].
fn brdf(lighting: Lighting, m: Material, a: Angles) -> vec3<f32> {
    let roughness = shaded_roughness(m);
    let f0 = (m.base_color - DIELECTRIC_F0) * m.metalness + DIELECTRIC_F0;
    let f = f0 + (1.0 - f0) * fresnel_weight(lighting.fresnel, a.cos_d).x;
    let specular = distribution(roughness * roughness, a.sin2_h)
        * over_cosines(lighting.masking, roughness, a.cos_o, a.cos_i);
    let lambert = m.base_color * ((1.0 - m.metalness) * FRAC_1_PI);
    var diffuse = vec3<f32>(0.0);
    if lighting.diffuse == 0u {
        diffuse = lambert;
    } else if lighting.diffuse == 1u {
        diffuse = (1.0 - f) * (1.0 - DIELECTRIC_F0) * lambert;
    }
    return f * specular + diffuse;
}

struct BrdfGrad {
    material: Material,
    angles: Angles,
}

fn brdf_pull(lighting: Lighting, m: Material, a: Angles, d_out: vec3<f32>) -> BrdfGrad {
    let roughness = shaded_roughness(m);
    let alpha = roughness * roughness;
    let f0 = (m.base_color - DIELECTRIC_F0) * m.metalness + DIELECTRIC_F0;
    let weight = fresnel_weight(lighting.fresnel, a.cos_d);
    let f = f0 + (1.0 - f0) * weight.x;
    let d = distribution(alpha, a.sin2_h);
    let g = over_cosines(lighting.masking, roughness, a.cos_o, a.cos_i);
    let d_product = dot(d_out, f);
    var d_f = d_out * (d * g);
    let by_d = distribution_pull(alpha, a.sin2_h, d_product * g);
    let masked = over_cosines_pull(lighting.masking, roughness, a.cos_o, a.cos_i, d_product * d);
    let dielectric = (1.0 - m.metalness) * FRAC_1_PI;
    var d_lambert = vec3<f32>(0.0);
    if lighting.diffuse == 0u {
        d_lambert = d_out;
    } else if lighting.diffuse == 1u {
        let weighted = d_out * (1.0 - DIELECTRIC_F0);
        d_f -= weighted * m.base_color * dielectric;
        d_lambert = weighted * (1.0 - f);
    }
    let d_f0 = d_f * (1.0 - weight.x);
    var out: BrdfGrad;
    out.material.base_color = d_lambert * dielectric + d_f0 * m.metalness;
    out.material.roughness = select(
        0.0,
        masked.x + roughness * 2.0 * by_d.x,
        m.roughness >= MIN_ROUGHNESS && m.roughness <= 1.0,
    );
    out.material.metalness = dot(d_f0, m.base_color - DIELECTRIC_F0) - dot(d_lambert, m.base_color) * FRAC_1_PI;
    out.angles = Angles(masked.z, masked.y, dot(d_f, 1.0 - f0) * weight.y, by_d.y);
    return out;
}

// Raises both cosines to their floors; whether the surface is lit.
fn raised(lighting: Lighting, free: Angles) -> Angles {
    return Angles(max(free.cos_i, lighting.horizon_leak), max(free.cos_o, MIN_COS_THETA_O), free.cos_d, free.sin2_h);
}

fn is_lit(lighting: Lighting, free: Angles, a: Angles) -> bool {
    let turned_away = lighting.horizon_leak < MIN_COSINE && free.cos_i < -TURNED_AWAY;
    return !turned_away && a.cos_i >= MIN_COSINE && a.cos_o >= MIN_COSINE;
}

// [eq:reflect]
fn reflected(lighting: Lighting, m: Material, f: Directions, irradiance: vec3<f32>) -> vec3<f32> {
    let free = angles_of(f);
    let a = raised(lighting, free);
    if !is_lit(lighting, free, a) {
        return vec3<f32>(0.0);
    }
    return irradiance * brdf(lighting, m, a) * a.cos_i;
}

struct ReflectGrad {
    material: Material,
    directions: Directions,
    irradiance: vec3<f32>,
}

fn reflected_pull(
    lighting: Lighting,
    m: Material,
    f: Directions,
    irradiance: vec3<f32>,
    d_out: vec3<f32>,
) -> ReflectGrad {
    var out: ReflectGrad;
    let free = angles_of(f);
    let a = raised(lighting, free);
    if !is_lit(lighting, free, a) {
        return out;
    }
    let value = brdf(lighting, m, a);
    let d_lit = d_out * irradiance;
    let g = brdf_pull(lighting, m, a, d_lit * a.cos_i);
    var d = g.angles;
    d.cos_i = select(d.cos_i + dot(d_lit, value), 0.0, free.cos_i < lighting.horizon_leak);
    d.cos_o = select(d.cos_o, 0.0, free.cos_o < MIN_COS_THETA_O);
    out.material = g.material;
    out.directions = angles_pull(f, d);
    out.irradiance = d_out * value * a.cos_i;
    return out;
}

// What arrives at a point [eq:light-incidence].
struct Arriving {
    direction: vec3<f32>,
    irradiance: vec3<f32>,
    distance: f32,
    ratio: f32,
}

fn arriving_at(lighting: Lighting, at: vec3<f32>) -> Arriving {
    if lighting.directional != 0u {
        return Arriving(lighting.place, lighting.intensity, 1.0, 1.0);
    }
    let offset = clamp(lighting.place - at, vec3<f32>(-MAX_OFFSET), vec3<f32>(MAX_OFFSET));
    let length = sqrt(dot(offset, offset));
    var direction = vec3<f32>(0.0, 0.0, 1.0);
    if length >= MIN_COSINE {
        direction = offset / length;
    }
    let distance = max(length, MIN_LIGHT_DISTANCE);
    var ratio = 1.0;
    if lighting.reference > 0.0 && lighting.learned_incident == 0u {
        ratio = min(lighting.reference / distance, MAX_RATIO);
    }
    let irradiance = min(lighting.intensity * (ratio * ratio), vec3<f32>(LARGEST_NUMBER));
    return Arriving(direction, irradiance, distance, ratio);
}

// Cotangent of the point.
fn arriving_pull(lighting: Lighting, a: Arriving, d_direction: vec3<f32>, d_irradiance: vec3<f32>) -> vec3<f32> {
    if lighting.directional != 0u {
        return vec3<f32>(0.0);
    }
    var d_at = (a.direction * dot(d_direction, a.direction) - d_direction) / a.distance;
    if lighting.reference > 0.0 && lighting.learned_incident == 0u && a.distance > MIN_LIGHT_DISTANCE {
        d_at += a.direction * (dot(d_irradiance, lighting.intensity) * 2.0 * a.ratio * a.ratio / a.distance);
    }
    return d_at;
}

// A pixel's channels divided by its opacity, and what it looks at [eq:gbuffer-normalise] [eq:surface-point].
struct Point {
    material: Material,
    subsurfaceness: f32,
    residual: vec3<f32>,
    incident: f32,
    visibility: f32,
    normal: vec3<f32>,
    view: vec3<f32>,
    position: vec3<f32>,
    depth: f32,
    opacity: f32,
    weight: f32,
    // Length of the blended normal; 0: it has no direction.
    normal_length: f32,
    // Direction through the pixel, camera axes, z = 1.
    through: vec3<f32>,
    covered: bool,
}

fn to_world(d: vec3<f32>) -> vec3<f32> {
    return d.x * frame.row_x.xyz + d.y * frame.row_y.xyz + d.z * frame.row_z.xyz;
}

fn point_of(
    lighting: Lighting,
    f0: vec4<f32>,
    f1: vec4<f32>,
    f2: vec4<f32>,
    f3: vec4<f32>,
    opacity: f32,
    depth: f32,
    pixel: vec2<u32>,
) -> Point {
    var p: Point;
    p.covered = opacity >= MIN_OPACITY;
    p.opacity = select(1.0, opacity, p.covered);
    p.weight = select(1.0, 1.0 / p.opacity, lighting.normalise != 0u);
    let w = select(0.0, p.weight, p.covered);
    p.depth = select(0.0, depth / p.opacity, p.covered);
    let roughness = select(f0.w * w, lighting.roughness, lighting.fixed_roughness != 0u);
    p.material = Material(f0.xyz * w, roughness, f1.x * w);
    p.subsurfaceness = f1.y * w;
    p.residual = vec3<f32>(f2.y, f2.z, f2.w) * w;
    p.incident = f3.x * w;
    p.visibility = f3.y * w;
    p.through = vec3<f32>((vec2<f32>(pixel) + 0.5 - frame.principal) / frame.focal, 1.0);
    let ray = to_world(p.through);
    p.view = -ray / sqrt(dot(ray, ray));
    let translation = vec3<f32>(frame.row_x.w, frame.row_y.w, frame.row_z.w);
    p.position = to_world(p.through * p.depth - translation);
    let raw = vec3<f32>(f1.z, f1.w, f2.x) * w;
    // The largest component is divided out first, so that no square leaves the range of f32.
    let largest = max(max(max(abs(raw.x), abs(raw.y)), abs(raw.z)), 0.5 * MIN_NORMAL_LENGTH);
    let blended = raw / largest;
    let part = sqrt(dot(blended, blended));
    let length = part * largest;
    p.normal = p.view;
    if length >= MIN_NORMAL_LENGTH && within(length, LARGEST_NUMBER) {
        p.normal = blended / part;
        p.normal_length = length;
    }
    return p;
}

// Weights of surface and residual, and their derivatives by subsurfaceness.
fn combine_weights(lighting: Lighting, s: f32) -> vec4<f32> {
    if lighting.use_residual == 0u {
        return vec4<f32>(1.0, 0.0, 0.0, 0.0);
    }
    if lighting.additive != 0u {
        return vec4<f32>(1.0, s, 0.0, 1.0);
    }
    return vec4<f32>(1.0 - s, s, -1.0, 1.0);
}
