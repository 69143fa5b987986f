// blend: one workgroup per tile, one thread per pixel, nearest first [eq:splat-blend]. Up to sixteen channels at a time.
// After frame.wgsl, pair.wgsl, alpha.wgsl.

struct Coverage {
    // Σ w, Σ w z, and the transmittance behind the last that was blended.
    opacity: f32,
    depth: f32,
    transmittance: f32,
    // One past the place of the last that was blended in the tile's range.
    reach: u32,
}

@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> pairs: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read> features: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> picture: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> coverage: array<Coverage>;

// Groups of four channels, at most four.
override QUADS: u32 = 1u;

const BATCH: u32 = 64u;
var<workgroup> prepared: array<Prepared, 64>;
var<workgroup> rows: array<vec4<f32>, 256>;
var<workgroup> alive: atomic<u32>;
var<workgroup> go_on: u32;

@compute @workgroup_size(256)
fn blend(@builtin(workgroup_id) tile: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let offset = vec2<u32>(lane % 16u, lane / 16u);
    let pixel = tile.xy * 16u + offset;
    let inside = all(pixel < frame.size);
    let at = vec2<f32>(offset) - 7.5;
    let range = ranges[tile.y * frame.tiles.x + tile.x];
    var t = 1.0;
    var running = inside;
    var opacity = 0.0;
    var depth = 0.0;
    var reach = 0u;
    var sum_0 = vec4<f32>(0.0);
    var sum_1 = vec4<f32>(0.0);
    var sum_2 = vec4<f32>(0.0);
    var sum_3 = vec4<f32>(0.0);
    for (var first = range.x; first < range.y; first += BATCH) {
        if lane < BATCH && first + lane < range.y {
            prepared[lane] = prepare(splats[pairs[first + lane].x], tile.xy);
        }
        let member = lane / 4u;
        let quad = lane % 4u;
        if quad < QUADS && first + member < range.y {
            rows[member * QUADS + quad] = features[pairs[first + member].x * QUADS + quad];
        }
        if lane == 0u {
            atomicStore(&alive, 0u);
        }
        workgroupBarrier();
        if running {
            let members = min(BATCH, range.y - first);
            for (var k = 0u; k < members; k++) {
                let a = limited_alpha(raw_alpha(prepared[k], at));
                if a <= 0.0 {
                    continue;
                }
                let next = fma(-t, a, t);
                if next <= frame.min_transmittance {
                    running = false;
                    break;
                }
                let w = t * a;
                t = next;
                reach = first + k + 1u - range.x;
                opacity += w;
                depth = fma(w, prepared[k].rest.z, depth);
                sum_0 = fma(vec4<f32>(w), rows[k * QUADS], sum_0);
                if QUADS > 1u {
                    sum_1 = fma(vec4<f32>(w), rows[k * QUADS + 1u], sum_1);
                }
                if QUADS > 2u {
                    sum_2 = fma(vec4<f32>(w), rows[k * QUADS + 2u], sum_2);
                }
                if QUADS > 3u {
                    sum_3 = fma(vec4<f32>(w), rows[k * QUADS + 3u], sum_3);
                }
            }
        }
        if running {
            atomicOr(&alive, 1u);
        }
        workgroupBarrier();
        if lane == 0u {
            go_on = atomicLoad(&alive);
        }
        if workgroupUniformLoad(&go_on) == 0u {
            break;
        }
    }
    if inside {
        let i = pixel.y * frame.size.x + pixel.x;
        coverage[i] = Coverage(opacity, depth, t, reach);
        picture[i * QUADS] = sum_0;
        if QUADS > 1u {
            picture[i * QUADS + 1u] = sum_1;
        }
        if QUADS > 2u {
            picture[i * QUADS + 2u] = sum_2;
        }
        if QUADS > 3u {
            picture[i * QUADS + 3u] = sum_3;
        }
    }
}
