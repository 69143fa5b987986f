//! SSIM and its pullback against dual numbers, by the adjoint identity, and the self-test of both comparisons.
use diamond_image::Image;
use diamond_metrics::{SsimWindow, ssim, ssim_masked, ssim_mean, ssim_mean_and_grad};
use diamond_testkit::adjoint::{adjoint_gap, relative_l2};
use diamond_testkit::{Dual, Real, gradient, jvp, metrics as oracle};
use proptest::prelude::*;

const WINDOWS: [SsimWindow; 2] = [SsimWindow::ZeroPadded, SsimWindow::Valid];

fn f64s(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

fn constants<T: Real>(values: &[f64]) -> Vec<T> {
    values.iter().map(|&v| T::of(v)).collect()
}

/// A pair of images whose sizes lie in `sizes`: unrelated, or almost equal; flat, dark or full of contrast.
fn pair(sizes: std::ops::Range<usize>) -> impl Strategy<Value = (Image, Image)> {
    let contrast = prop_oneof![Just(0.0f32), Just(0.01), Just(0.5)];
    let level = prop_oneof![Just(0.0f32), Just(0.4), Just(1.0)];
    (sizes.clone(), sizes, 1usize..=3, contrast, level, any::<bool>()).prop_flat_map(
        |(w, h, c, contrast, level, alike)| {
            let n = w * h * c;
            (prop::collection::vec(0.0f32..1.0, n), prop::collection::vec(0.0f32..1.0, n)).prop_map(move |(p, q)| {
                let a: Vec<f32> = p.iter().map(|v| level + contrast * (v - 0.5)).collect();
                let b = q.iter().zip(&a).map(|(v, a)| if alike { a + 0.003 * v } else { 0.3 + 0.4 * v }).collect();
                (Image::from_vec(w, h, c, a).unwrap(), Image::from_vec(w, h, c, b).unwrap())
            })
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..Default::default() })]

    /// [eq:ssim] Value and map, ours against the direct double sum.
    #[test]
    fn value_and_map_agree_with_the_oracle((a, b) in pair(1..16)) {
        for window in WINDOWS {
            if window == SsimWindow::Valid && a.width().min(a.height()) < 11 {
                continue;
            }
            let expected = oracle::ssim_map(&f64s(a.data()), &f64s(b.data()), a.shape(), window.border());
            let (found, _) = ssim(&a, &b, window).unwrap();
            prop_assert_eq!(found.map.data().len(), expected.len());
            for (f, e) in found.map.data().iter().zip(&expected) {
                prop_assert!((f64::from(*f) - e).abs() < 2e-7, "{f} {e}");
            }
            prop_assert!((found.mean - oracle::mean(&expected)).abs() < 1e-11);
            prop_assert_eq!(found.mean, ssim_mean(&a, &b, window).unwrap());
        }
    }

    /// [eq:ssim] The adjoint identity of the map, both images at once.
    #[test]
    fn the_pullback_is_the_adjoint((a, b) in pair(1..20), seed in any::<u32>()) {
        for window in WINDOWS {
            if window == SsimWindow::Valid && a.width().min(a.height()) < 11 {
                continue;
            }
            let noise = |i: usize, k: f64| ((i as f64 + 1.0) * k + f64::from(seed)).sin();
            let n = a.data().len();
            let point: Vec<f64> = f64s(a.data()).into_iter().chain(f64s(b.data())).collect();
            let tangent: Vec<f64> = (0..2 * n).map(|i| noise(i, 1.7)).collect();
            let j = jvp(|x| oracle::ssim_map(&x[..n], &x[n..], a.shape(), window.border()), &point, &tangent);
            let (value, pullback) = ssim(&a, &b, window).unwrap();
            let d_map = Image::from_vec(
                value.map.width(), value.map.height(), value.map.channels(),
                (0..j.len()).map(|i| noise(i, 2.3) as f32).collect(),
            ).unwrap();
            let grad = pullback.pull_map(&d_map).unwrap();
            let pulled: Vec<f64> = f64s(grad.a.data()).into_iter().chain(f64s(grad.b.data())).collect();
            let gap = adjoint_gap(&f64s(d_map.data()), &j, &pulled, &tangent);
            prop_assert!(gap < 1e-6, "gap {gap}");
            // The harness notices a gradient that lost its share in the second image.
            let broken: Vec<f64> = f64s(grad.a.data()).into_iter().chain(vec![0.0; n]).collect();
            if pulled[n..].iter().zip(&tangent[n..]).map(|(p, t)| p * t).sum::<f64>().abs() > 1e-3 * pulled.iter().zip(&tangent).map(|(p, t)| (p * t).abs()).sum::<f64>() {
                prop_assert!(adjoint_gap(&f64s(d_map.data()), &j, &broken, &tangent) > 1e-5);
            }
        }
    }
}

/// [eq:ssim] The fused gradient of the mean, value by value, against dual numbers.
#[test]
fn the_fused_gradient_agrees_with_dual_numbers() {
    for (w, h, c) in [(1, 1, 1), (5, 3, 2), (12, 13, 1)] {
        let n = w * h * c;
        let wave = |k: f32| (0..n).map(|i| 0.5 + 0.45 * ((i + 1) as f32 * k).sin()).collect::<Vec<f32>>();
        let a = Image::from_vec(w, h, c, wave(1.3)).unwrap();
        let b = Image::from_vec(w, h, c, wave(0.9)).unwrap();
        for window in WINDOWS {
            if window == SsimWindow::Valid && w.min(h) < 11 {
                continue;
            }
            let border = window.border();
            let target: Vec<Dual> = constants(&f64s(b.data()));
            let expected = gradient(|x| oracle::ssim(x, &target, (w, h, c), border), &f64s(a.data()));
            let (mean, found) = ssim_mean_and_grad(&a, &b, window).unwrap();
            assert!((mean - oracle::ssim(&f64s(a.data()), &f64s(b.data()), (w, h, c), border)).abs() < 1e-12);
            let error = relative_l2(&f64s(found.data()), &expected, 1e-12);
            assert!(error < 1e-6, "{w}×{h}×{c} {window:?}: {error}");
            let (_, pullback) = ssim(&a, &b, window).unwrap();
            assert_eq!(pullback.pull_mean(1.0).a, found, "fused and two-step gradients share every bit");
            // Self-test: one wrong sign is noticed.
            let mut broken = found.clone();
            let largest = (0..n).max_by(|&i, &j| found.data()[i].abs().total_cmp(&found.data()[j].abs())).unwrap();
            broken.data_mut()[largest] *= -1.0;
            assert!(relative_l2(&f64s(broken.data()), &expected, 1e-12) > 1e-3);
        }
    }
}

/// Flat bright images, where E[x²] − E[x]² has no digits left in f32.
#[test]
fn flat_and_extreme_images_keep_their_digits() {
    let ripple = |level: f32| {
        Image::from_vec(24, 24, 1, (0..576).map(|i| level + 1e-3 * (i as f32 * 0.77).sin()).collect()).unwrap()
    };
    for level in [0.0, 1.0, 100.0] {
        let (a, b) = (ripple(level), Image::filled(24, 24, 1, level));
        let expected = oracle::ssim(&f64s(a.data()), &f64s(b.data()), a.shape(), 0);
        assert!((ssim_mean(&a, &b, SsimWindow::ZeroPadded).unwrap() - expected).abs() < 1e-7, "level {level}");
    }
    for (p, q) in [(f32::MAX, f32::MIN), (f32::MAX, f32::MAX), (f32::MIN_POSITIVE, 0.0), (1e30, 1.0)] {
        let (a, b) = (Image::filled(13, 12, 1, p), Image::filled(13, 12, 1, q));
        for window in WINDOWS {
            let (mean, grad) = ssim_mean_and_grad(&a, &b, window).unwrap();
            assert!((-1.0..=1.0).contains(&mean), "{p} {q}: {mean}");
            assert_eq!(grad.first_non_finite(), None, "{p} {q}");
        }
    }
}

#[test]
fn the_mask_weighs_the_map() {
    let a = Image::from_vec(14, 12, 2, (0..336).map(|i| (i as f32 * 0.37).sin().abs()).collect()).unwrap();
    let b = a.map(|v| v * v);
    let full = diamond_image::Mask::full(14, 12);
    for window in WINDOWS {
        let gap = ssim_masked(&a, &b, &full, window).unwrap() - ssim_mean(&a, &b, window).unwrap();
        assert!(gap.abs() < 1e-7);
    }
    let mut coverage = vec![0.0; 14 * 12];
    coverage[6 * 14 + 7] = 1.0;
    let one = diamond_image::Mask::from_vec(14, 12, coverage).unwrap();
    let (whole, _) = ssim(&a, &b, SsimWindow::Valid).unwrap();
    let pixel = whole.map.pixel(2, 1);
    let expected = f64::from(pixel[0] + pixel[1]) / 2.0;
    assert!((ssim_masked(&a, &b, &one, SsimWindow::Valid).unwrap() - expected).abs() < 1e-7);
    let mut corner = vec![0.0; 14 * 12];
    corner[0] = 1.0;
    let corner = diamond_image::Mask::from_vec(14, 12, corner).unwrap();
    assert!(ssim_masked(&a, &b, &corner, SsimWindow::Valid).is_err(), "the border is not evaluated");
    assert!(ssim_masked(&a, &b, &corner, SsimWindow::ZeroPadded).is_ok());
}
