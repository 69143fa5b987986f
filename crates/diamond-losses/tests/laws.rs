//! What must hold for every input: losses are at least 0 and 0 at their optimum, nothing is NaN, errors name the culprit.
use diamond_image::{Image, Mask, Transfer};
use diamond_losses::*;
use diamond_metrics::SsimWindow;
use proptest::collection::vec;
use proptest::prelude::*;

fn extreme() -> impl Strategy<Value = f32> {
    prop_oneof![
        Just(0.0f32),
        Just(-0.0),
        Just(1.0),
        Just(-1.0),
        Just(f32::MAX),
        Just(f32::MIN),
        Just(f32::MIN_POSITIVE),
        Just(1e-20),
        -2.0f32..2.0,
    ]
}

const SPACES: [Transfer; 3] = [Transfer::Linear, Transfer::Srgb, Transfer::Gamma22];

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..Default::default() })]

    /// Any finite input gives finite, non-negative losses and finite gradients, under any mask, none and an empty one.
    #[test]
    fn everything_stays_finite(
        (w, h, a, b, m) in (1usize..5, 1usize..5).prop_flat_map(|(w, h)| {
            let n = w * h * 3;
            (Just(w), Just(h), vec(extreme(), n), vec(extreme(), n), vec(prop_oneof![Just(0.0f32), Just(1.0), Just(1e-38)], w * h))
        }),
        lambda_ssim in 0.0f32..=1.0,
    ) {
        let (a, b) = (Image::from_vec(w, h, 3, a).unwrap(), Image::from_vec(w, h, 3, b).unwrap());
        let (one, other) = (a.channels_range(0..1), b.channels_range(0..1));
        let masks = [
            Mask::from_vec(w, h, m).unwrap(), Mask::full(w, h), Mask::from_vec(w, h, vec![0.0; w * h]).unwrap(),
        ];
        let mut seen: Vec<(f32, Vec<f32>)> = Vec::new();
        for space in SPACES {
            let options = PhotometricOptions { lambda_ssim, lambda_l2: 0.5, space, window: SsimWindow::ZeroPadded };
            let loss = photometric(&a, &b, &options, 1.0).unwrap();
            prop_assert!(loss.l1.is_finite() && loss.l2.is_finite() && (0.0..=2.0).contains(&loss.dssim));
            seen.push((loss.value, loss.grad.into_vec()));
        }
        for (i, mask) in masks.iter().enumerate() {
            let mut masked: Vec<(f32, Vec<f32>)> = Vec::new();
            for average in [Average::Inside, Average::AllPixels] {
                let normal = normal_consistency(&a, &b, Some(mask), average).unwrap();
                masked.push((normal.value, normal.grad.into_vec()));
                let enhancement = enhancement(&a, &b, Some(mask), average).unwrap();
                masked.push((enhancement.value, enhancement.grad.into_vec()));
            }
            for map in [&a, &one] {
                let smooth = smoothness(map, &b, Some(mask)).unwrap();
                masked.push((smooth.value, smooth.grad.into_vec()));
            }
            if i == 2 {
                prop_assert!(masked.iter().all(|(v, g)| *v == 0.0 && g.iter().all(|g| *g == 0.0)), "an empty mask");
            }
            seen.extend(masked);
            let bce = mask_bce(&one, mask).unwrap();
            seen.push((bce.value, bce.grad.into_vec()));
        }
        let entropy = mask_entropy(&one).unwrap();
        seen.push((entropy.value, entropy.grad.into_vec()));
        let incident = incident_light(one.data(), other.data()).unwrap();
        seen.push((incident.value, incident.d_incident));
        seen.push((incident.value, incident.d_visibility));
        let light = visibility(one.data(), other.data()).unwrap();
        seen.push((light.value, light.grad));
        for (value, grad) in &seen {
            prop_assert!(*value >= 0.0 && value.is_finite());
            prop_assert!(grad.iter().all(|g| g.is_finite()));
        }
        // Scales may be negative here, and axes longer than 1: finite is all that can be asked.
        let vectors: Vec<[f32; 3]> = a.data().chunks(3).map(|v| [v[0], v[1], v[2]]).collect();
        let axes: Vec<[f32; 3]> = b.data().chunks(3).map(|v| [v[0], v[1], v[2]]).collect();
        let (value, grad) = flatness(&vectors).unwrap();
        prop_assert!(value.is_finite() && grad.iter().flatten().all(|g| g.is_finite()));
        let alignment = normal_alignment(&vectors, &axes).unwrap();
        prop_assert!(alignment.value.is_finite() && alignment.d_normal.iter().flatten().all(|g| g.is_finite()));
    }

    /// Every loss is 0, with a gradient of 0, at its optimum.
    #[test]
    fn zero_at_the_optimum((w, h, v) in (1usize..6, 1usize..6).prop_flat_map(|(w, h)| {
        (Just(w), Just(h), vec(0.0f32..1.0, w * h * 3))
    })) {
        let a = Image::from_vec(w, h, 3, v).unwrap();
        for space in SPACES {
            let options = PhotometricOptions { lambda_ssim: 0.4, lambda_l2: 1.0, space, ..Default::default() };
            let loss = photometric(&a, &a, &options, 1.0).unwrap();
            prop_assert_eq!(loss.value, 0.0);
            prop_assert!(loss.grad.data().iter().all(|g| g.abs() < 1e-9));
        }
        let nothing = |value: f32, grad: &[f32]| value == 0.0 && grad.iter().all(|g| *g == 0.0);
        let normal = normal_consistency(&a, &a, None, Average::Inside).unwrap();
        prop_assert!(nothing(normal.value, normal.grad.data()));
        let mut target = a.clone();
        target.data_mut().chunks_mut(3).for_each(|g| g.copy_from_slice(&enhanced([g[0], g[1], g[2]])));
        let loss = enhancement(&target, &a, None, Average::Inside).unwrap();
        prop_assert!(nothing(loss.value, loss.grad.data()));
        prop_assert!(target.data().iter().all(|t| (0.0..=1.0).contains(t)), "a base colour");
        let flat = smoothness(&Image::filled(w, h, 3, 0.3), &a, None).unwrap();
        prop_assert!(nothing(flat.value, flat.grad.data()));
        let light = incident_light(a.data(), a.data()).unwrap();
        prop_assert!(nothing(light.value, &light.d_incident));
        let seen = visibility(a.data(), a.data()).unwrap();
        prop_assert!(nothing(seen.value, &seen.grad));
    }

    /// A step against the gradient lowers the photometric loss.
    #[test]
    fn a_small_step_descends(v in vec((0.05f32..0.95, 0.05f32..0.95), 7 * 6 * 3)) {
        let (a, b): (Vec<f32>, Vec<f32>) = v.into_iter().unzip();
        let (a, b) = (Image::from_vec(7, 6, 3, a).unwrap(), Image::from_vec(7, 6, 3, b).unwrap());
        let options = PhotometricOptions::default();
        let before = photometric(&a, &b, &options, 1.0).unwrap();
        let mut next = a.clone();
        for (v, g) in next.data_mut().iter_mut().zip(before.grad.data()) {
            *v -= 0.05 * g;
        }
        prop_assert!(photometric(&next, &b, &options, 1.0).unwrap().value < before.value);
    }
}

/// 1×1, all black and all white.
#[test]
fn the_smallest_and_the_plainest_images() {
    for (w, h) in [(1, 1), (1, 9), (16, 16)] {
        for (p, q) in [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)] {
            let (a, b) = (Image::filled(w, h, 3, p), Image::filled(w, h, 3, q));
            let loss = photometric(&a, &b, &PhotometricOptions::default(), 1.0).unwrap();
            assert_eq!(loss.l1, (p - q).abs());
            assert_eq!(loss.value == 0.0, p == q);
            assert!(loss.grad.data().iter().all(|g| g.is_finite()));
            let o = Image::filled(w, h, 1, p);
            let m = Mask::from_vec(w, h, vec![q; w * h]).unwrap();
            let expected = if p == q { 1e-6 } else { -(1e-6f64.ln()) };
            assert!((f64::from(mask_bce(&o, &m).unwrap().value) - expected).abs() < 1e-6 * expected.max(1e-3));
        }
    }
}

#[test]
fn wrong_inputs_are_errors_that_name_the_culprit() {
    let good = Image::filled(3, 2, 3, 0.5);
    let mut bad = good.clone();
    bad.pixel_mut(2, 1)[1] = f32::NAN;
    let small = Image::filled(2, 2, 3, 0.5);
    let options = PhotometricOptions::default();
    let text = |e: LossError| e.to_string();
    let nan = text(photometric(&bad, &good, &options, 1.0).unwrap_err());
    assert!(nan.contains("rendered image") && nan.contains("column 2, row 1, channel 1"), "{nan}");
    assert!(text(photometric(&good, &bad, &options, 1.0).unwrap_err()).contains("photograph"));
    assert!(text(photometric(&good, &small, &options, 1.0).unwrap_err()).contains("3×2×3"));
    assert!(photometric(&Image::new(0, 0, 3), &Image::new(0, 0, 3), &options, 1.0).is_err());
    let valid = PhotometricOptions { window: SsimWindow::Valid, ..options };
    assert!(matches!(photometric(&good, &good, &valid, 1.0), Err(LossError::Metric(_))));
    assert!(text(normal_consistency(&good, &small, None, Average::Inside).unwrap_err()).contains("pseudo-normal"));
    let mask = Mask::full(2, 2);
    assert!(text(smoothness(&good, &good, Some(&mask)).unwrap_err()).contains("mask"));
    assert!(enhancement(&good, &bad, None, Average::Inside).is_err());
    assert!(mask_bce(&good, &Mask::full(3, 2)).is_err(), "three channels");
    assert!(text(visibility(&[0.0; 3], &[0.0; 2]).unwrap_err()).contains("expected 3 values, found 2"));
    assert!(flatness(&[[f32::INFINITY, 1.0, 1.0]]).is_err());
}
