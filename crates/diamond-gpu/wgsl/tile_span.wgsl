// Which tiles of a row of tiles an ellipse meets.

const TILE: u32 = 16u;
// Widening of an interval: absolute in px and relative to the ellipse's width. Covers f32 rounding.
const SLACK: f32 = 1e-3;
const RELATIVE_SLACK: f32 = 1e-6;

// Rows of tiles (first, one past last) that may be met. `outline` is extent x, extent y, 2τ, y of the rightmost point.
fn tile_rows(splat: Splat, outline: vec4<f32>) -> vec2<u32> {
    let reach = outline.y + SLACK;
    let low = clamp(floor((splat.mean.z - reach) / 16.0), 0.0, f32(frame.tiles.y));
    let high = clamp(floor((splat.mean.z + reach) / 16.0) + 1.0, 0.0, f32(frame.tiles.y));
    return vec2<u32>(u32(low), u32(high));
}

// Columns of tiles (first, one past last) of a row of tiles that hold a pixel centre the ellipse may cover
// [eq:ellipse-band]; empty where first ≥ last.
fn tile_columns(splat: Splat, outline: vec4<f32>, row: u32) -> vec2<u32> {
    let extent = outline.xy;
    let top = (f32(row * TILE) + 0.5 - splat.mean.z) - splat.mean.w;
    let y0 = max(top, -extent.y);
    let y1 = min(top + f32(TILE - 1u), extent.y);
    if y0 > y1 + SLACK {
        return vec2<u32>(0u, 0u);
    }
    // The rightmost and the leftmost point of an ellipse's part in a band lie at the band's y nearest to theirs.
    let right_y = min(max(outline.w, y0), y1);
    let left_y = min(max(-outline.w, y0), y1);
    let inv_sqrt = splat.rest.x / KAPPA;
    let slope = -splat.chol.z / splat.chol.x;
    let half_width = KAPPA / splat.chol.x;
    let right_w = right_y * inv_sqrt;
    let left_w = left_y * inv_sqrt;
    let right_root = sqrt(max(outline.z - right_w * right_w, 0.0));
    let left_root = sqrt(max(outline.z - left_w * left_w, 0.0));
    let slack = SLACK + RELATIVE_SLACK * extent.x;
    let low = splat.mean.x - slack + slope * left_y - half_width * left_root;
    let high = splat.mean.x + slack + slope * right_y + half_width * right_root;
    // Outer pixel centres of a tile are at 16 t + 0.5 and 16 t + 15.5.
    let columns = f32(frame.tiles.x);
    let first = clamp(floor((low + 0.5) / 16.0), 0.0, columns);
    let past = clamp(floor((high - 0.5) / 16.0) + 1.0, 0.0, columns);
    return vec2<u32>(u32(first), u32(max(first, past)));
}
