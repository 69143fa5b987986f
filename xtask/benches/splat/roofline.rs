//! The blending roofline: how many (splat, pixel) pairs per second the machine could blend if nothing else had to be
//! done. A tile of 8 × 8 pixels and 64 splats, all in the first cache: offset, conic, 2^x by a polynomial, clamp,
//! threshold, transmittance, three colours.
use diamond_simd::{Lanes, Level, Simd, WithSimd, exp2};
use std::hint::black_box;
use std::time::Instant;

/// Pixels of the tile.
const PIXELS: usize = 64;
/// Splats of the tile.
const SPLATS: usize = 64;
/// Tiles per measurement.
const REPEATS: usize = 400;

struct Tile {
    /// Mean x, y, conic (three, times −½ log2 e), log2 of opacity, colours.
    splats: [[f32; 9]; SPLATS],
}

impl WithSimd for &Tile {
    type Output = f32;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> f32 {
        let mut xs = [0.0; PIXELS];
        let mut ys = [0.0; PIXELS];
        for i in 0..PIXELS {
            (xs[i], ys[i]) = ((i % 8) as f32 + 0.5, (i / 8) as f32 + 0.5);
        }
        let mut check = 0.0;
        for _ in 0..REPEATS {
            let splats = black_box(&self.splats);
            for first in (0..PIXELS).step_by(S::F32_LANES) {
                let set = |v: f32| Lanes::splat(s, v);
                let (x, y) = (Lanes::load(s, &xs[first..]), Lanes::load(s, &ys[first..]));
                let (mut t, mut r, mut g, mut b) = (set(1.0), set(0.0), set(0.0), set(0.0));
                for p in splats {
                    let (dx, dy) = (x - set(p[0]), y - set(p[1]));
                    let across = set(p[2]).mul_add(dx, set(p[3]) * dy);
                    let exponent = across.mul_add(dx, (set(p[4]) * dy).mul_add(dy, set(p[5])));
                    let a = exp2(exponent).min(set(0.99));
                    let a = a.keep(a.ge(set(1.0 / 255.0)));
                    let w = a * t;
                    t = t - w;
                    r = w.mul_add(set(p[6]), r);
                    g = w.mul_add(set(p[7]), g);
                    b = w.mul_add(set(p[8]), b);
                }
                check += (r + g + b + t).largest();
            }
        }
        check
    }
}

/// Of all threads of the present pool together: the best of some measurements.
pub fn pairs_per_second() -> f64 {
    let splats = std::array::from_fn(|i| {
        let u = |k: usize| ((i * 9 + k) as f32 * 0.618_034).fract();
        [8.0 * u(0), 8.0 * u(1), -0.05 - 0.2 * u(2), 0.05 * u(3), -0.05 - 0.2 * u(4), -4.0 * u(5), u(6), u(7), u(8)]
    });
    let tile = Tile { splats };
    let level = Level::current();
    (0..60)
        .map(|_| {
            let rates = rayon::broadcast(|_| {
                let start = Instant::now();
                black_box(level.dispatch(&tile));
                (REPEATS * SPLATS * PIXELS) as f64 / start.elapsed().as_secs_f64()
            });
            rates.iter().sum::<f64>()
        })
        .fold(0.0, f64::max)
}
