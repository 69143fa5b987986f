//! Every term against dual numbers: value and gradient, with the self-test of the comparison.
use diamond_image::{Image, Mask, Transfer};
use diamond_losses::*;
use diamond_testkit::adjoint::relative_l2;
use diamond_testkit::{Dual, Real, gradient, losses as oracle};
use proptest::collection::vec;
use proptest::prelude::*;

/// Largest relative error of a gradient, and of a value.
const TOLERANCE: f64 = 1e-5;

fn f64s(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

fn flat(values: &[[f32; 3]]) -> Vec<f32> {
    values.iter().flatten().copied().collect()
}

fn constants(values: &[f64]) -> Vec<Dual> {
    values.iter().map(|&v| Dual::of(v)).collect()
}

/// Why `value` and `grad` are not those of the oracle `f` at `at`.
fn disagreement(value: f32, grad: &[f32], f: impl Fn(&[Dual]) -> Dual, at: &[f32]) -> Option<String> {
    let at = f64s(at);
    let expected = f(&constants(&at)).v;
    let gap = (f64::from(value) - expected).abs();
    if gap.is_nan() || gap > TOLERANCE * expected.abs().max(1e-3) {
        return Some(format!("value {value}, expected {expected}"));
    }
    let expected = gradient(f, &at);
    let error = relative_l2(&f64s(grad), &expected, 1e-6);
    (error > TOLERANCE || error.is_nan()).then(|| format!("gradient off by {error}: {grad:?}, expected {expected:?}"))
}

macro_rules! agree {
    ($value:expr, $grad:expr, $f:expr, $at:expr) => {
        let found = disagreement($value, $grad, $f, $at);
        prop_assert!(found.is_none(), "{}", found.unwrap_or_default());
    };
}

fn size() -> impl Strategy<Value = (usize, usize)> {
    (1usize..7, 1usize..7)
}

fn mask(n: usize) -> impl Strategy<Value = Vec<f32>> {
    vec(prop_oneof![Just(0.0f32), Just(1.0), 0.0f32..1.0], n)
}

/// Values of a picture; some are repeated, so that differences of 0 occur.
fn picture(n: usize) -> impl Strategy<Value = Vec<f32>> {
    vec(prop_oneof![3 => 0.0f32..1.0, 1 => Just(0.25f32), 1 => Just(0.0f32)], n)
}

fn area(mask: &[f32]) -> f64 {
    f64s(mask).iter().sum::<f64>().max(1e-300)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..Default::default() })]

    /// [eq:photometric] in linear and in encoded space.
    #[test]
    fn photometric_agrees(
        (w, h, c, a, b) in (1usize..6, 1usize..6, 1usize..=3).prop_flat_map(|(w, h, c)| {
            (Just(w), Just(h), Just(c), picture(w * h * c), picture(w * h * c))
        }),
        lambda_ssim in 0.0f32..1.0, lambda_l2 in 0.0f32..2.0,
    ) {
        // Where encoded values differ by less than rounding, the sign of their difference is anybody's.
        prop_assume!(a.iter().zip(&b).all(|(p, q)| p == q || (p - q).abs() > 1e-5));
        let image = |v: &[f32]| Image::from_vec(w, h, c, v.to_vec()).unwrap();
        for space in [Transfer::Linear, Transfer::Srgb] {
            let options = PhotometricOptions { lambda_ssim, lambda_l2, space, ..Default::default() };
            let loss = photometric(&image(&a), &image(&b), &options, 0.5).unwrap();
            let seen = |v: &[Dual]| -> Vec<Dual> {
                v.iter().map(|&v| if space == Transfer::Srgb { oracle::srgb(v) } else { v }).collect()
            };
            let target = seen(&constants(&f64s(&b)));
            let (l1, l2) = (f64::from(lambda_ssim), f64::from(lambda_l2));
            agree!(loss.value, loss.grad.data(),
                |x| Dual::of(0.5) * oracle::photometric(&seen(x), &target, (w, h, c), l1, l2), &a);
        }
    }

    /// [eq:believed] in linear and in encoded space; a weight of another pixel is noticed.
    #[test]
    fn believed_photometric_agrees(
        (w, h, c, a, b, m) in (1usize..6, 1usize..6, 1usize..=3).prop_flat_map(|(w, h, c)| {
            (Just(w), Just(h), Just(c), picture(w * h * c), picture(w * h * c), mask(w * h))
        }),
        lambda_ssim in 0.0f32..1.0, lambda_l2 in 0.0f32..2.0,
    ) {
        // Where encoded values differ by less than rounding, the sign of their difference is anybody's.
        prop_assume!(a.iter().zip(&b).all(|(p, q)| p == q || (p - q).abs() > 1e-5));
        let image = |v: &[f32], c: usize| Image::from_vec(w, h, c, v.to_vec()).unwrap();
        for space in [Transfer::Linear, Transfer::Srgb] {
            let options = PhotometricOptions { lambda_ssim, lambda_l2, space, ..Default::default() };
            let loss = believed_photometric(&image(&a, c), &image(&b, c), &image(&m, 1), &options).unwrap();
            let seen = |v: &[Dual]| -> Vec<Dual> {
                v.iter().map(|&v| if space == Transfer::Srgb { oracle::srgb(v) } else { v }).collect()
            };
            let target = seen(&constants(&f64s(&b)));
            let (l1, l2) = (f64::from(lambda_ssim), f64::from(lambda_l2));
            let of = |m: &[f64], x: &[Dual]| oracle::believed_photometric(&seen(x), &target, m, (w, h, c), l1, l2);
            agree!(loss.value, loss.grad.data(), |x| of(&f64s(&m), x), &a);
            let mut moved = f64s(&m);
            moved[0] += 0.5;
            let differs = (0..c).any(|k| a[k] != b[k]) && l1 < 0.99;
            let noticed = disagreement(loss.value, loss.grad.data(), |x| of(&moved, x), &a).is_some();
            prop_assert!(noticed || !differs);
        }
    }

    /// [eq:mask-bce] [eq:mask-entropy] [eq:opacity-entropy]
    #[test]
    fn opacity_terms_agree(
        (w, h, o, m) in size().prop_flat_map(|(w, h)| {
            let o = prop_oneof![6 => 0.0f32..1.0, 1 => Just(0.0f32), 1 => Just(1.0f32), 1 => Just(5e-7f32)];
            (Just(w), Just(h), vec(o, w * h), mask(w * h))
        }),
    ) {
        let opacity = Image::from_vec(w, h, 1, o.clone()).unwrap();
        let loss = mask_bce(&opacity, &Mask::from_vec(w, h, m.clone()).unwrap()).unwrap();
        agree!(loss.value, loss.grad.data(), |x| oracle::mask_bce(x, &f64s(&m)), &o);
        let loss = mask_entropy(&opacity).unwrap();
        agree!(loss.value, loss.grad.data(), oracle::entropy, &o);
        let loss = opacity_entropy(&o).unwrap();
        agree!(loss.value, &loss.grad, oracle::entropy, &o);
    }

    /// [eq:normal]
    #[test]
    fn normal_agrees(
        (w, h, n, p, m) in size().prop_flat_map(|(w, h)| {
            (Just(w), Just(h), vec(-1.0f32..1.0, w * h * 3), vec(-1.0f32..1.0, w * h * 3), mask(w * h))
        }),
    ) {
        let image = |v: &[f32]| Image::from_vec(w, h, 3, v.to_vec()).unwrap();
        let mask = Mask::from_vec(w, h, m.clone()).unwrap();
        for (average, denominator) in [(Average::Inside, area(&m)), (Average::AllPixels, (w * h) as f64)] {
            let loss = normal_consistency(&image(&n), &image(&p), Some(&mask), average).unwrap();
            let pseudo = constants(&f64s(&p));
            agree!(loss.value, loss.grad.data(), |x| oracle::normal(x, &pseudo, &f64s(&m), denominator), &n);
            let normal = constants(&f64s(&n));
            agree!(loss.value, loss.d_pseudo_normal().data(),
                |x| oracle::normal(&normal, x, &f64s(&m), denominator), &p);
        }
    }

    /// [eq:smoothness] for maps and photographs of 1 and 3 channels.
    #[test]
    fn smoothness_agrees(
        (w, h, c, k, q, photo, m) in (size(), prop_oneof![Just(1usize), Just(3)], prop_oneof![Just(1usize), Just(3)])
            .prop_flat_map(|((w, h), c, k)| {
                (Just(w), Just(h), Just(c), Just(k), picture(w * h * c), picture(w * h * k), mask(w * h))
            }),
    ) {
        let map = Image::from_vec(w, h, c, q.clone()).unwrap();
        let photograph = Image::from_vec(w, h, k, photo.clone()).unwrap();
        let mask = Mask::from_vec(w, h, m.clone()).unwrap();
        let loss = smoothness(&map, &photograph, Some(&mask)).unwrap();
        agree!(loss.value, loss.grad.data(), |x| oracle::smoothness(x, (w, h, c), &f64s(&photo), k, &f64s(&m)), &q);
        let everywhere = vec![1.0; w * h];
        let loss = smoothness(&map, &photograph, None).unwrap();
        agree!(loss.value, loss.grad.data(), |x| oracle::smoothness(x, (w, h, c), &f64s(&photo), k, &everywhere), &q);
    }

    /// [eq:enhancement] [eq:enhancement-target]
    #[test]
    fn enhancement_agrees(
        (w, h, base, photo, m) in size().prop_flat_map(|(w, h)| {
            (Just(w), Just(h), vec(0.001f32..0.999, w * h * 3), vec(-0.2f32..1.4, w * h * 3), mask(w * h))
        }),
    ) {
        let image = |v: &[f32]| Image::from_vec(w, h, 3, v.to_vec()).unwrap();
        let mask = Mask::from_vec(w, h, m.clone()).unwrap();
        for (average, denominator) in [(Average::Inside, area(&m)), (Average::AllPixels, (w * h) as f64)] {
            let loss = enhancement(&image(&base), &image(&photo), Some(&mask), average).unwrap();
            agree!(loss.value, loss.grad.data(),
                |x| oracle::enhancement(x, &f64s(&photo), &f64s(&m), denominator), &base);
        }
    }

    /// [eq:incident] [eq:visibility]
    #[test]
    fn light_terms_agree((l, v) in (1usize..20).prop_flat_map(|n| (vec(-0.5f32..1.5, n), picture(n)))) {
        let loss = incident_light(&l, &v).unwrap();
        let (incident, seen) = (constants(&f64s(&l)), constants(&f64s(&v)));
        agree!(loss.value, &loss.d_incident, |x| oracle::incident(x, &seen), &l);
        // Clamped light that meets a visibility of exactly 0 or 1 sits on the kink of |·|; the rest is smooth.
        agree!(loss.value, &loss.d_visibility, |x| oracle::incident(&incident, x), &v);
        let loss = visibility(&l, &v).unwrap();
        agree!(loss.value, &loss.grad, |x| oracle::absolute(x, &seen), &l);
    }

    /// [eq:flatness] [eq:normal-alignment]
    #[test]
    fn shape_terms_agree((s, n, a) in (1usize..9).prop_flat_map(|k| {
        let three = |low: f32, high: f32| vec([low..high, low..high, low..high], k);
        (three(1e-3, 1.0), three(-1.0, 1.0), three(-1.0, 1.0))
    })) {
        let (value, grad) = flatness(&s).unwrap();
        agree!(value, &flat(&grad), oracle::flatness, &flat(&s));
        let loss = normal_alignment(&n, &a).unwrap();
        let (normal, axis) = (constants(&f64s(&flat(&n))), constants(&f64s(&flat(&a))));
        agree!(loss.value, &flat(&loss.d_normal), |x| oracle::alignment(x, &axis), &flat(&n));
        agree!(loss.value, &flat(&loss.d_axis), |x| oracle::alignment(&normal, x), &flat(&a));
    }
}

/// The comparison notices a wrong value, a wrong sign and a gradient that is off by a thousandth.
#[test]
fn a_broken_side_is_noticed() {
    let (l, v) = ([0.2f32, 0.7, 0.4], [0.5f32, 0.1, 0.9]);
    let loss = visibility(&l, &v).unwrap();
    let f = |x: &[Dual]| oracle::absolute(x, &constants(&f64s(&v)));
    assert_eq!(disagreement(loss.value, &loss.grad, f, &l), None);
    assert!(disagreement(loss.value * 1.001, &loss.grad, f, &l).is_some());
    assert!(disagreement(f32::NAN, &loss.grad, f, &l).is_some());
    let flipped: Vec<f32> = loss.grad.iter().map(|g| -g).collect();
    assert!(disagreement(loss.value, &flipped, f, &l).is_some());
    let mut off = loss.grad.clone();
    off[1] *= 1.001;
    assert!(disagreement(loss.value, &off, f, &l).is_some());
    off[1] = f32::NAN;
    assert!(disagreement(loss.value, &off, f, &l).is_some());
}
