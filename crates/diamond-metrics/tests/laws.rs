//! What must hold for every image: bounds, symmetry, identity, and errors that name the culprit.
use diamond_image::{Image, Mask};
use diamond_metrics::{
    FlipExposures, FlipHdrOptions, FlipInput, FlipOptions, FlipToneMapper, MetricError, SsimWindow, flip_hdr,
    flip_hdr_masked, flip_ldr, flip_ldr_masked, masked_mean, psnr, psnr_channels, psnr_masked, ssim, ssim_mean,
};
use diamond_testkit::metrics as oracle;
use proptest::prelude::*;

fn image(w: usize, h: usize, low: f32, high: f32) -> impl Strategy<Value = Image> {
    let value = prop_oneof![8 => low..high, 1 => Just(low), 1 => Just(high)];
    prop::collection::vec(value, w * h * 3).prop_map(move |v| Image::from_vec(w, h, 3, v).unwrap())
}

fn images(high: f32) -> impl Strategy<Value = (Image, Image)> {
    (1usize..15, 1usize..15).prop_flat_map(move |(w, h)| (image(w, h, 0.0, high), image(w, h, 0.0, high)))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..Default::default() })]

    /// [eq:psnr] agrees with the formula, is symmetric, and no channel mean lies below it.
    #[test]
    fn psnr_is_symmetric_and_agrees((a, b) in images(1.0)) {
        let found = psnr(&a, &b, 1.0).unwrap();
        prop_assert_eq!(found, psnr(&b, &a, 1.0).unwrap());
        prop_assert_eq!(psnr(&a, &a, 1.0).unwrap(), f64::INFINITY);
        let f64s = |i: &Image| i.data().iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
        let expected = oracle::psnr(&f64s(&a), &f64s(&b));
        prop_assert!(found == expected || (found - expected).abs() < 1e-9 * expected.abs().max(1.0));
        let channels = psnr_channels(&a, &b, 1.0).unwrap();
        prop_assert!(channels.iter().sum::<f64>() / 3.0 >= found - 1e-9);
        let full = Mask::full(a.width(), a.height());
        prop_assert!((psnr_masked(&a, &b, &full, 1.0).unwrap() - found).abs() < 1e-9 || found.is_infinite());
    }

    /// [eq:ssim] is symmetric, at most 1, at least −1, and 1 for identical images, bit for bit.
    #[test]
    fn ssim_is_symmetric_and_bounded((a, b) in images(1.0)) {
        let (ab, _) = ssim(&a, &b, SsimWindow::ZeroPadded).unwrap();
        let (ba, _) = ssim(&b, &a, SsimWindow::ZeroPadded).unwrap();
        prop_assert_eq!(&ab, &ba);
        prop_assert!(ab.map.data().iter().all(|v| (-1.0..=1.0).contains(v)));
        prop_assert_eq!(ssim_mean(&a, &a, SsimWindow::ZeroPadded).unwrap(), 1.0);
        let (_, same) = ssim(&a, &a, SsimWindow::ZeroPadded).unwrap();
        prop_assert!(same.pull_mean(1.0).a.data().iter().all(|v| v.abs() < 1e-12), "1 is the maximum");
    }

    /// [eq:flip] lies in [0, 1], is symmetric, and 0 for identical images.
    #[test]
    fn flip_is_symmetric_and_bounded((a, b) in images(1.0), linear in any::<bool>()) {
        let input = if linear { FlipInput::Linear } else { FlipInput::Srgb };
        let options = FlipOptions { input, ..Default::default() };
        let ab = flip_ldr(&a, &b, options).unwrap();
        prop_assert!(ab.map.data().iter().all(|v| (0.0..=1.0).contains(v)));
        prop_assert!((ab.mean - flip_ldr(&b, &a, options).unwrap().mean).abs() < 1e-12);
        prop_assert_eq!(flip_ldr(&a, &a, options).unwrap().mean, 0.0);
        let full = Mask::full(a.width(), a.height());
        prop_assert!((flip_ldr_masked(&a, &b, &full, options).unwrap() - ab.mean).abs() < 1e-6);
        prop_assert!((masked_mean(&ab.map, &full).unwrap() - ab.mean).abs() < 1e-6);
    }

    /// [eq:flip-hdr] is the largest over its exposures, lies in [0, 1], and is 0 for identical images.
    #[test]
    fn hdr_flip_is_the_worst_exposure((a, b) in images(20.0)) {
        for tone_mapper in [FlipToneMapper::Aces, FlipToneMapper::Hable, FlipToneMapper::Reinhard] {
            let at = |start: f64, stop: f64, count| {
                let exposures = Some(FlipExposures { start, stop, count });
                flip_hdr(&a, &b, FlipHdrOptions { tone_mapper, exposures, ..Default::default() }).unwrap().flip
            };
            let (low, high, both) = (at(-2.0, -2.0, 1), at(1.0, 1.0, 1), at(-2.0, 1.0, 2));
            for ((l, h), m) in low.map.data().iter().zip(high.map.data()).zip(both.map.data()) {
                prop_assert_eq!(l.max(*h), *m);
                prop_assert!((0.0..=1.0).contains(m));
            }
        }
        match flip_hdr(&a, &a, FlipHdrOptions::default()) {
            Ok(same) => {
                prop_assert_eq!(same.flip.mean, 0.0);
                let full = Mask::full(a.width(), a.height());
                prop_assert_eq!(flip_hdr_masked(&a, &a, &full, FlipHdrOptions::default()), Ok(0.0));
            }
            Err(e) => prop_assert_eq!(e, MetricError::BlackReference),
        }
    }

    /// Any finite input gives finite output.
    #[test]
    fn extreme_values_stay_finite(w in 1usize..13, h in 1usize..13, seed in any::<u64>()) {
        let extremes = [0.0f32, -0.0, 1.0, -1.0, f32::MAX, f32::MIN, f32::MIN_POSITIVE, 1e-30, 1e20];
        let pick = |salt: u64| {
            let value = |i: usize| {
                let mixed = (seed ^ salt).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left((i * 7 % 64) as u32);
                extremes[((mixed ^ (i as u64 * 0xd6e8_feb8)) % 9) as usize]
            };
            Image::from_vec(w, h, 3, (0..w * h * 3).map(value).collect()).unwrap()
        };
        let (a, b) = (pick(1), pick(2));
        let (s, pullback) = ssim(&a, &b, SsimWindow::ZeroPadded).unwrap();
        prop_assert!((-1.0..=1.0).contains(&s.mean));
        let grad = pullback.pull_mean(1.0);
        prop_assert!(grad.a.first_non_finite().is_none() && grad.b.first_non_finite().is_none());
        prop_assert!(!psnr(&a, &b, 1.0).unwrap().is_nan());
        prop_assert!((0.0..=1.0).contains(&flip_ldr(&a, &b, FlipOptions::default()).unwrap().mean));
        if let Ok(f) = flip_hdr(&a, &b, FlipHdrOptions::default()) {
            prop_assert!((0.0..=1.0).contains(&f.flip.mean));
        }
    }
}

/// [eq:flip] [eq:flip-hdr] Flat images, for which flip-evaluator 1.7 gives these numbers.
#[test]
fn flip_of_flat_images() {
    let flat = |v| Image::filled(20, 13, 3, v);
    let ldr = |a, b, input| flip_ldr(&flat(a), &flat(b), FlipOptions { input, ..Default::default() }).unwrap().mean;
    assert!((ldr(0.0, 1.0, FlipInput::Srgb) - 0.967_391).abs() < 1e-4);
    assert!((ldr(0.5, 0.25, FlipInput::Srgb) - 0.569_090).abs() < 1e-4);
    assert!((ldr(0.5, 0.25, FlipInput::Linear) - 0.451_897).abs() < 1e-4);
    let hdr = flip_hdr(&flat(1.0), &flat(2.0), FlipHdrOptions::default()).unwrap();
    assert!((hdr.flip.mean - 0.144_833).abs() < 1e-4 && hdr.exposures.count == 2);
}

#[test]
fn wrong_inputs_are_errors_that_name_the_culprit() {
    let good = Image::filled(4, 3, 3, 0.5);
    let other = Image::filled(3, 4, 3, 0.5);
    let mut bad = good.clone();
    bad.pixel_mut(2, 1)[0] = f32::NAN;
    let text = |e: MetricError| e.to_string();
    assert!(text(psnr(&good, &other, 1.0).unwrap_err()).contains("4×3×3"));
    assert!(text(ssim_mean(&good, &bad, SsimWindow::ZeroPadded).unwrap_err()).contains("SSIM: second image"));
    assert!(text(flip_ldr(&bad, &good, FlipOptions::default()).unwrap_err()).contains("FLIP: reference"));
    assert!(text(flip_hdr(&good, &bad, FlipHdrOptions::default()).unwrap_err()).contains("column 2, row 1"));
    assert!(text(ssim_mean(&good, &good, SsimWindow::Valid).unwrap_err()).contains("11×11"));
    let nothing = Mask::from_vec(4, 3, vec![0.0; 12]).unwrap();
    let options = FlipOptions::default();
    assert!(matches!(flip_ldr_masked(&good, &good, &nothing, options), Err(MetricError::EmptyMask { .. })));
    let narrow = Mask::full(3, 3);
    assert!(matches!(flip_ldr_masked(&good, &good, &narrow, options), Err(MetricError::Shape { .. })));
    let (_, pullback) = ssim(&good, &good, SsimWindow::ZeroPadded).unwrap();
    assert!(pullback.pull_map(&other).is_err() && pullback.pull_map(&bad).is_err());
}
