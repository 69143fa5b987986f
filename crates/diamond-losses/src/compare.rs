//! One pass over two encoded images and the gradient of their SSIM: differences, their gradient, the way back through the
//! encoding, and the squared difference that PSNR is made of.
//!
//! Sixteen values at a time; their sums by a fixed tree, then in f64 in the order of blocks. A block with values beyond
//! 1e15, whose squares or differences would not fit, is taken in f64 one by one.
use crate::average::{finite, subgradient};
use crate::encode::{encode, encode_pull};
use diamond_image::Transfer;
use diamond_simd::{BLOCK, Lanes, Level, Simd, WithSimd, tree_sum, with_lanes};

/// Larger values are compared one by one in f64.
const LARGEST_IN_BLOCKS: f32 = 1e15;

/// What to compare; all slices have equal lengths.
pub(crate) struct Compare<'a> {
    /// The space of `a` and `b`.
    pub space: Transfer,
    /// The rendered image, linear.
    pub linear: &'a [f32],
    /// The rendered image, encoded.
    pub a: &'a [f32],
    /// The photograph, encoded.
    pub b: &'a [f32],
    /// In: gradient of SSIM with respect to `a`. Out: gradient of the whole with respect to `linear`.
    pub grad: &'a mut [f32],
    /// Factor of what `grad` holds.
    pub step_ssim: f32,
    /// Gradient of |a − b|.
    pub step_l1: f32,
    /// Gradient of (a − b)² per unit of the difference.
    pub step_l2: f64,
}

/// Sums over all values.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Sums {
    pub absolute: f64,
    pub squared: f64,
    /// Of the squared difference in sRGB, both sides cut to [0, 1].
    pub display: f64,
}

impl Compare<'_> {
    /// Fills `grad` and returns the sums.
    pub fn run(self, level: Level) -> Sums {
        level.dispatch(self)
    }
}

impl WithSimd for Compare<'_> {
    type Output = Sums;

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> Sums {
        with_lanes!(s: S, compare(self))
    }
}

#[inline(always)]
fn compare<S: Simd, const N: usize>(s: S, c: Compare<'_>) -> Sums {
    let mut sums = Sums::default();
    let (linear, linear_rest) = c.linear.as_chunks::<BLOCK>();
    let (a, a_rest) = c.a.as_chunks::<BLOCK>();
    let (b, b_rest) = c.b.as_chunks::<BLOCK>();
    let (grad, grad_rest) = c.grad.as_chunks_mut::<BLOCK>();
    let step = Step { space: c.space, ssim: c.step_ssim, l1: c.step_l1, l2: c.step_l2 };
    for (((linear, a), b), grad) in linear.iter().zip(a).zip(b).zip(grad) {
        block::<S, N>(s, &step, linear, a, b, grad, &mut sums);
    }
    if !grad_rest.is_empty() {
        // Zeros compare equal and add nothing.
        let n = grad_rest.len();
        let mut full = [[0.0; BLOCK]; 4];
        for (full, rest) in full.iter_mut().zip([linear_rest, a_rest, b_rest, &*grad_rest]) {
            full[..n].copy_from_slice(rest);
        }
        let [linear, a, b, mut grad] = full;
        block::<S, N>(s, &step, &linear, &a, &b, &mut grad, &mut sums);
        grad_rest.copy_from_slice(&grad[..n]);
    }
    sums
}

struct Step {
    space: Transfer,
    ssim: f32,
    l1: f32,
    l2: f64,
}

#[inline(always)]
fn block<S: Simd, const N: usize>(
    s: S,
    step: &Step,
    linear: &[f32; BLOCK],
    a: &[f32; BLOCK],
    b: &[f32; BLOCK],
    grad: &mut [f32; BLOCK],
    sums: &mut Sums,
) {
    let at = |i: usize| i * S::F32_LANES;
    let mut parts = [[0.0f32; BLOCK]; 3];
    let mut largest = Lanes::splat(s, 0.0);
    for i in 0..N {
        let (x, y) = (Lanes::load(s, &a[at(i)..]), Lanes::load(s, &b[at(i)..]));
        largest = largest.max(x.abs()).max(y.abs());
        let d = x - y;
        d.abs().store(&mut parts[0][at(i)..]);
        (d * d).store(&mut parts[1][at(i)..]);
        let (p, q) = match step.space {
            Transfer::Srgb => (x, y),
            Transfer::Linear => (encode(Transfer::Srgb, x), encode(Transfer::Srgb, y)),
            // x^2.2 is not at hand; the caller does without.
            Transfer::Gamma22 => (x, x),
        };
        let shown = p.clamp(0.0, 1.0) - q.clamp(0.0, 1.0);
        (shown * shown).store(&mut parts[2][at(i)..]);
    }
    sums.display += f64::from(tree_sum(parts[2]));
    if largest.largest() > LARGEST_IN_BLOCKS {
        for i in 0..BLOCK {
            let d = f64::from(a[i]) - f64::from(b[i]);
            sums.absolute += d.abs();
            sums.squared += d * d;
            grad[i] = step.ssim * grad[i] + step.l1 * subgradient(d as f32) + finite(step.l2 * d);
        }
    } else {
        sums.absolute += f64::from(tree_sum(parts[0]));
        sums.squared += f64::from(tree_sum(parts[1]));
        let (l1, l2) = (Lanes::splat(s, step.l1), Lanes::splat(s, step.l2 as f32));
        for i in 0..N {
            let d = Lanes::load(s, &a[at(i)..]) - Lanes::load(s, &b[at(i)..]);
            let sign = l1.copysign(d).keep(d.abs().gt(d.same(0.0)));
            let g = Lanes::load(s, &grad[at(i)..]).mul_add(l1.same(step.ssim), sign);
            (g + (d * l2).clamp(f32::MIN, f32::MAX)).store(&mut grad[at(i)..]);
        }
    }
    for i in 0..N {
        let (linear, stored) = (Lanes::load(s, &linear[at(i)..]), Lanes::load(s, &a[at(i)..]));
        encode_pull(step.space, linear, stored, Lanes::load(s, &grad[at(i)..])).store(&mut grad[at(i)..]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(level: Level, space: Transfer, linear: &[f32], a: &[f32], b: &[f32]) -> (Sums, Vec<f32>) {
        let mut grad: Vec<f32> = (0..a.len()).map(|i| (i as f32 * 0.37).sin()).collect();
        let steps = (-0.2, 0.8 / a.len() as f32, 0.3);
        let c =
            Compare { space, linear, a, b, grad: &mut grad, step_ssim: steps.0, step_l1: steps.1, step_l2: steps.2 };
        (c.run(level), grad)
    }

    /// Sums and gradient against plain f64, and the same bits at every width; also with values that need f64.
    #[test]
    fn the_pass_is_what_it_fuses_at_every_width() {
        for huge in [false, true] {
            let n = 16 * 7 + 5;
            let linear: Vec<f32> = (0..n).map(|i| (i as f32 * 0.7).sin().abs() * 1.3).collect();
            let mut target: Vec<f32> = (0..n).map(|i| (i as f32 * 0.7 + 0.1).sin().abs()).collect();
            target[3] = linear[3];
            for space in [Transfer::Linear, Transfer::Srgb, Transfer::Gamma22] {
                let stored = |v: &[f32]| v.iter().map(|&v| space.encode(v)).collect::<Vec<f32>>();
                let (mut a, b) = (stored(&linear), stored(&target));
                if huge {
                    a[20] = 3e37;
                }
                let (mut absolute, mut squared, mut display) = (0.0f64, 0.0f64, 0.0f64);
                let mut expected = Vec::new();
                for i in 0..n {
                    let d = f64::from(a[i]) - f64::from(b[i]);
                    absolute += d.abs();
                    squared += d * d;
                    let shown = |stored: f32| f64::from(Transfer::Srgb.encode(space.decode(stored)).clamp(0.0, 1.0));
                    display += (shown(a[i]) - shown(b[i])).powi(2);
                    let ssim = f64::from((i as f32 * 0.37).sin());
                    let sign = if d == 0.0 { 0.0 } else { d.signum() };
                    let g = -0.2 * ssim + 0.8 / n as f64 * sign + 0.3 * d;
                    expected.push(f64::from(space.encode_pull(linear[i], 1.0)) * g);
                }
                let mut fused: Option<(Sums, Vec<f32>)> = None;
                for level in Level::testable() {
                    let (sums, grad) = run(level, space, &linear, &a, &b);
                    let close = |x: f64, y: f64| (x - y).abs() <= 2e-6 * y.abs();
                    assert!(close(sums.absolute, absolute) && close(sums.squared, squared), "{space:?} {sums:?}");
                    assert!(space == Transfer::Gamma22 || close(sums.display, display), "{space:?} {sums:?} {display}");
                    for (i, (&g, &e)) in grad.iter().zip(&expected).enumerate() {
                        assert!(
                            (huge && i == 20) || (f64::from(g) - e).abs() <= 2e-6 * (e.abs() + 0.1),
                            "{i}: {g} {e}"
                        );
                    }
                    if level.is_fused() {
                        let first = fused.get_or_insert_with(|| (sums, grad.clone()));
                        assert_eq!(*first, (sums, grad), "{space:?} {level:?}");
                    }
                }
            }
        }
    }
}
