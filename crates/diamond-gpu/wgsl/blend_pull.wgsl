// blend_pull: the reverse of blend [eq:splat-blend-pull]. Per tile and back to front, four Gaussians at a time: first each
// thread finds its pixel's g = dL/dα · (−dα/dσ) and w, then the sums over the tile's pixels are a small matrix product, a column
// per thread. Nothing is added atomically: a row per entry, summed later in the order of entries.
// After frame.wgsl, pair.wgsl, alpha.wgsl.

struct Coverage {
    opacity: f32,
    depth: f32,
    transmittance: f32,
    reach: u32,
}

@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> pairs: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read> features: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> coverage: array<Coverage>;
// By pixel, QUADS groups of four channels.
@group(0) @binding(6) var<storage, read> d_picture: array<vec4<f32>>;
// dL/d opacity and dL/d depth.
@group(0) @binding(7) var<storage, read> d_coverage: array<vec2<f32>>;
// By entry before sorting: Σ g·(1, u, v, u², uv, v²), Σ w·d depth, 0, then Σ w·d features.
@group(0) @binding(8) var<storage, read_write> rows: array<f32>;

override QUADS: u32 = 1u;
// Whether these are the first channels: then opacity and depth take part, and rows are written, not added to.
override FIRST: bool = true;

const BATCH: u32 = 32u;
const GROUP: u32 = 4u;
const GEOMETRY: u32 = 8u;
// Threads that share a column: each sums 32 pixels.
const PARTS: u32 = 8u;
var<workgroup> prepared: array<Prepared, 32>;
var<workgroup> values: array<vec4<f32>, 128>;
var<workgroup> gains: array<vec4<f32>, 256>;
var<workgroup> weights: array<vec4<f32>, 256>;
var<workgroup> partial: array<vec4<f32>, 256>;
var<workgroup> farthest: atomic<u32>;
var<workgroup> tile_reach: u32;

// Factors of a column of Σ g·(1, u, v, u², uv, v²): 1, u or v, as affine functions of the offset.
fn factor(p: Prepared, which: u32) -> vec3<f32> {
    if which == 0u {
        return vec3<f32>(1.0, 0.0, 0.0);
    }
    if which == 1u {
        return vec3<f32>(p.affine.x, p.affine.z, p.affine.w);
    }
    return vec3<f32>(p.affine.y, 0.0, p.rest.x);
}

@compute @workgroup_size(256)
fn blend_pull(@builtin(workgroup_id) tile: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let offset = vec2<u32>(lane % 16u, lane / 16u);
    let pixel = tile.xy * 16u + offset;
    let inside = all(pixel < frame.size);
    let at = vec2<f32>(offset) - 7.5;
    let range = ranges[tile.y * frame.tiles.x + tile.x];
    let i = pixel.y * frame.size.x + pixel.x;
    var t = 1.0;
    var reach = 0u;
    var d_one = 0.0;
    var d_depth = 0.0;
    var d_0 = vec4<f32>(0.0);
    var d_1 = vec4<f32>(0.0);
    var d_2 = vec4<f32>(0.0);
    var d_3 = vec4<f32>(0.0);
    if inside {
        t = coverage[i].transmittance;
        reach = coverage[i].reach;
        if FIRST {
            d_one = d_coverage[i].x;
            d_depth = d_coverage[i].y;
        }
        d_0 = d_picture[i * QUADS];
        if QUADS > 1u {
            d_1 = d_picture[i * QUADS + 1u];
        }
        if QUADS > 2u {
            d_2 = d_picture[i * QUADS + 2u];
        }
        if QUADS > 3u {
            d_3 = d_picture[i * QUADS + 3u];
        }
    }
    if lane == 0u {
        atomicStore(&farthest, 0u);
    }
    workgroupBarrier();
    atomicMax(&farthest, reach);
    workgroupBarrier();
    if lane == 0u {
        tile_reach = atomicLoad(&farthest);
    }
    let members = workgroupUniformLoad(&tile_reach);
    // What lies behind, in units of the loss.
    var behind = 0.0;
    // Which sum this thread has a part of, and of which pixels.
    let column = lane % 32u;
    let part = lane / 32u;
    let stride = GEOMETRY + 4u * QUADS;
    for (var batch = (members + BATCH - 1u) / BATCH; batch > 0u; batch--) {
        let first = (batch - 1u) * BATCH;
        let size = min(BATCH, members - first);
        workgroupBarrier();
        if lane < size {
            prepared[lane] = prepare(splats[pairs[range.x + first + lane].x], tile.xy);
        }
        let member = lane / 4u;
        let quad = lane % 4u;
        if lane < 128u && quad < QUADS && member < size {
            values[member * 4u + quad] = features[pairs[range.x + first + member].x * QUADS + quad];
        }
        workgroupBarrier();
        for (var group = (size + GROUP - 1u) / GROUP; group > 0u; group--) {
            let begin = (group - 1u) * GROUP;
            var g = vec4<f32>(0.0);
            var w = vec4<f32>(0.0);
            for (var m = GROUP; m > 0u; m--) {
                let k = begin + m - 1u;
                if k >= size || first + k >= reach {
                    continue;
                }
                let raw = raw_alpha(prepared[k], at);
                let a = limited_alpha(raw);
                if a <= 0.0 {
                    continue;
                }
                t = t / (1.0 - a);
                var e = dot(d_0, values[k * 4u]);
                if QUADS > 1u {
                    e += dot(d_1, values[k * 4u + 1u]);
                }
                if QUADS > 2u {
                    e += dot(d_2, values[k * 4u + 2u]);
                }
                if QUADS > 3u {
                    e += dot(d_3, values[k * 4u + 3u]);
                }
                e += fma(prepared[k].rest.z, d_depth, d_one);
                let gain = e - behind;
                let chain = select(0.0, a, raw <= frame.max_alpha);
                g[m - 1u] = t * gain * chain;
                w[m - 1u] = t * a;
                behind = fma(a, gain, behind);
            }
            gains[lane] = g;
            weights[lane] = w;
            workgroupBarrier();
            var sum = vec4<f32>(0.0);
            if column < 6u {
                // 1, u, v, u², uv, v² as products of two factors.
                let which_a = select(select(0u, column, column < 3u), select(2u, 1u, column < 5u), column >= 3u);
                let which_b = select(0u, select(2u, 1u, column == 3u), column >= 3u);
                var a: array<vec3<f32>, 4>;
                var b: array<vec3<f32>, 4>;
                for (var m = 0u; m < GROUP; m++) {
                    let k = min(begin + m, size - 1u);
                    a[m] = factor(prepared[k], which_a);
                    b[m] = factor(prepared[k], which_b);
                }
                for (var n = 0u; n < 32u; n++) {
                    let p = part * 32u + n;
                    let place = vec3<f32>(1.0, f32(p % 16u) - 7.5, f32(p / 16u) - 7.5);
                    let basis = vec4<f32>(
                        dot(a[0], place) * dot(b[0], place),
                        dot(a[1], place) * dot(b[1], place),
                        dot(a[2], place) * dot(b[2], place),
                        dot(a[3], place) * dot(b[3], place),
                    );
                    sum = fma(gains[p], basis, sum);
                }
            } else if column == 6u || (column >= GEOMETRY && column < stride) {
                let channel = max(column, GEOMETRY) - GEOMETRY;
                for (var n = 0u; n < 32u; n++) {
                    let p = part * 32u + n;
                    let other = min(tile.xy * 16u + vec2<u32>(p % 16u, p / 16u), frame.size - 1u);
                    let j = other.y * frame.size.x + other.x;
                    var d = 0.0;
                    if column >= GEOMETRY {
                        d = d_picture[j * QUADS + channel / 4u][channel % 4u];
                    } else if FIRST {
                        d = d_coverage[j].y;
                    }
                    sum = fma(weights[p], vec4<f32>(d), sum);
                }
            }
            partial[lane] = sum;
            workgroupBarrier();
            // A thread per Gaussian and column: threads 32 m + column.
            let k = begin + part;
            if part < GROUP && k < size && column < stride {
                var total = 0.0;
                for (var n = 0u; n < PARTS; n++) {
                    total += partial[n * 32u + column][part];
                }
                let to = pairs[range.x + first + k].y * stride + column;
                if !FIRST && column < GEOMETRY {
                    total += rows[to];
                }
                rows[to] = total;
            }
        }
    }
}
