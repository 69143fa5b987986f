//! Laws of images, masks and colour transfer.
use diamond_image::{Image, Mask, Transfer, luminance};
use diamond_testkit::strategies::{colour, extreme, finite, values};
use proptest::prelude::*;

fn image() -> impl Strategy<Value = Image> {
    (1usize..9, 1usize..9, 1usize..4).prop_flat_map(|(w, h, c)| {
        values(w * h * c, 0.0..1.0).prop_map(move |data| Image::from_vec(w, h, c, data).expect("matching length"))
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    /// [eq:transfer]: encode∘decode = id and decode∘encode = id, below 0 and above 1 too.
    #[test]
    fn transfers_round_trip(v in finite(-4.0..4.0)) {
        for t in [Transfer::Linear, Transfer::Srgb, Transfer::Gamma22] {
            prop_assert!((t.encode(t.decode(v)) - v).abs() <= 2e-6 * (1.0 + v.abs()), "{t:?}");
            prop_assert!((t.decode(t.encode(v)) - v).abs() <= 4e-6 * (1.0 + v.abs()), "{t:?}");
        }
    }

    /// [eq:transfer]: monotone and odd.
    #[test]
    fn transfers_are_monotone_and_odd(a in finite(-2.0..2.0), b in finite(-2.0..2.0)) {
        let (a, b) = (a.min(b), a.max(b));
        for t in [Transfer::Linear, Transfer::Srgb, Transfer::Gamma22] {
            // The two pieces of sRGB's encoding differ by 3·10⁻⁸ where they meet.
            prop_assert!(t.decode(a) <= t.decode(b) + 1e-7 && t.encode(a) <= t.encode(b) + 1e-7);
            prop_assert_eq!(t.decode(-a), -t.decode(a));
            prop_assert_eq!(t.encode(-a), -t.encode(a));
        }
    }

    /// [eq:bilinear]: at pixel centres the sample is the pixel, to the bit.
    #[test]
    fn samples_at_centres_are_pixels(image in image()) {
        let mut out = vec![0.0; image.channels()];
        for y in 0..image.height() {
            for x in 0..image.width() {
                image.sample(x as f32 + 0.5, y as f32 + 0.5, &mut out);
                for (got, expected) in out.iter().zip(image.pixel(x, y)) {
                    prop_assert!((got - expected).abs() <= 1e-7);
                }
            }
        }
    }

    /// [eq:bilinear]: a linear ramp is reproduced between the outermost centres; a constant everywhere, to the bit.
    #[test]
    fn samples_reproduce_ramps(a in finite(-1.0..1.0), b in finite(-1.0..1.0), c in finite(-1.0..1.0),
                               x in finite(0.5..6.5), y in finite(0.5..4.5)) {
        let mut ramp = Image::new(7, 5, 1);
        for v in 0..5 {
            for u in 0..7 {
                ramp.pixel_mut(u, v)[0] = a * (u as f32 + 0.5) + b * (v as f32 + 0.5) + c;
            }
        }
        let mut out = [0.0];
        ramp.sample(x, y, &mut out);
        prop_assert!((out[0] - (a * x + b * y + c)).abs() < 1e-5);
        let mut unused = Image::new(7, 5, 1);
        let (d_x, d_y) = ramp.sample_pull(x, y, &[1.0], &mut unused);
        prop_assert!((d_x - a).abs() < 1e-5 && (d_y - b).abs() < 1e-5);
        Image::filled(7, 5, 1, c).sample(x, y, &mut out);
        prop_assert_eq!(out[0], c);
    }

    /// [eq:area-resize]: means and constants are kept, values stay within range, the same size changes nothing.
    #[test]
    fn resizing_keeps_light(image in image(), w in 1usize..12, h in 1usize..12) {
        let resized = image.resize_area(w, h).expect("pixels");
        prop_assert_eq!(resized.shape(), (w, h, image.channels()));
        prop_assert!((resized.mean() - image.mean()).abs() < 1e-6);
        let (low, high) = image.data().iter().fold((f32::MAX, f32::MIN), |(a, b), &v| (a.min(v), b.max(v)));
        prop_assert!(resized.data().iter().all(|v| *v >= low - 1e-6 && *v <= high + 1e-6));
        let same = image.resize_area(image.width(), image.height()).expect("pixels");
        prop_assert_eq!(&same, &image);
        // Twice as large and back is the identity.
        let there = image.resize_area(2 * image.width(), 2 * image.height()).expect("pixels");
        prop_assert_eq!(&there.resize_area(image.width(), image.height()).expect("pixels"), &image);
    }

    /// A crop reads the same pixels.
    #[test]
    fn crops_are_views(image in image(), x in 0usize..9, y in 0usize..9, w in 0usize..9, h in 0usize..9) {
        match image.crop(x, y, w, h) {
            Ok(part) => {
                for v in 0..h {
                    for u in 0..w {
                        prop_assert_eq!(part.pixel(u, v), image.pixel(x + u, y + v));
                    }
                }
            }
            Err(_) => prop_assert!(x + w > image.width() || y + h > image.height()),
        }
    }

    /// Coverage lies in [0, 1] whatever was given; complement is an involution up to rounding; areas add up.
    #[test]
    fn masks_are_coverage(data in prop::collection::vec(prop_oneof![extreme(), Just(f32::NAN), Just(f32::INFINITY)], 12)) {
        let mask = Mask::from_vec(4, 3, data).expect("12 values");
        prop_assert!(mask.data().iter().all(|v| (0.0..=1.0).contains(v)));
        prop_assert!((mask.area() + mask.complement().area() - 12.0).abs() < 1e-4);
        for (a, b) in mask.complement().complement().data().iter().zip(mask.data()) {
            prop_assert!((a - b).abs() < 1e-6);
        }
        // Wrapping again changes nothing; resizing keeps the mean coverage.
        prop_assert_eq!(&Mask::from_vec(4, 3, mask.data().to_vec()).expect("12 values"), &mask);
        let half = mask.resize_area(2, 1).expect("pixels");
        prop_assert!((half.area() * 6.0 - mask.area()).abs() < 1e-4);
    }

    /// The bounding box holds every covered pixel, and each of its borders touches one.
    #[test]
    fn bounding_boxes_are_tight(data in values(20, 0.0..1.0), threshold in finite(0.0..1.0)) {
        let mask = Mask::from_vec(5, 4, data).expect("20 values");
        let covered: Vec<(usize, usize)> =
            (0..20).map(|i| (i % 5, i / 5)).filter(|&(x, y)| mask.coverage(x, y) > threshold).collect();
        match mask.bounding_box(threshold) {
            None => prop_assert!(covered.is_empty()),
            Some((x0, y0, x1, y1)) => {
                prop_assert_eq!(x0, covered.iter().map(|p| p.0).min().expect("covered"));
                prop_assert_eq!(x1 - 1, covered.iter().map(|p| p.0).max().expect("covered"));
                prop_assert_eq!(y0, covered.iter().map(|p| p.1).min().expect("covered"));
                prop_assert_eq!(y1 - 1, covered.iter().map(|p| p.1).max().expect("covered"));
                let part = mask.crop(x0, y0, x1 - x0, y1 - y0).expect("inside");
                prop_assert_eq!(part.data().iter().filter(|v| **v > threshold).count(), covered.len());
            }
        }
    }

    /// [eq:luminance]: linear, between the smallest and the largest channel, exact on greys to rounding.
    #[test]
    fn luminance_is_a_mean(a in colour(), b in colour(), t in finite(0.0..1.0)) {
        let y = luminance(a);
        let (low, high) = a.iter().fold((f32::MAX, f32::MIN), |(l, h), &v| (l.min(v), h.max(v)));
        prop_assert!(y >= low - 1e-6 && y <= high + 1e-6);
        let mix = [0, 1, 2].map(|i| a[i] + t * (b[i] - a[i]));
        prop_assert!((luminance(mix) - (y + t * (luminance(b) - y))).abs() < 1e-6);
    }
}

#[test]
fn masks_come_from_alpha_channels_or_say_why_not() {
    let rgba = Image::from_vec(2, 1, 4, vec![0.1, 0.2, 0.3, 0.5, 0.4, 0.5, 0.6, 1.5]).expect("8 values");
    assert_eq!(Mask::from_channel(&rgba, 3).expect("alpha").data(), [0.5, 1.0]);
    let error = Mask::from_channel(&rgba.channels_range(0..3), 3).expect_err("no alpha").to_string();
    assert!(error.contains("at least 4 channels") && error.contains("3 channels"), "{error}");
    assert_eq!(Mask::full(3, 2).area(), 6.0);
    assert_eq!(Mask::full(0, 0).bounding_box(0.0), None);
    assert!(Mask::from_vec(2, 2, vec![1.0; 3]).is_err());
}
