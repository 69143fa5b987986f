//! How good relit pictures are where the true ones are known, beside what needs no network.
use super::base::{Base, shading};
use super::examples::{RelightExample, RelightExamples, Told};
use super::relighter::{RelightOptions, Relighter};
use crate::error::{DiffusionError, Result};
use diamond_image::{Image, Transfer};
use glam::Vec3;

/// Error of pictures where the object is, means over examples.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PictureError {
    /// PSNR of encoded sRGB, dB.
    pub psnr: f64,
    /// Root mean square of ln((made + 0.02)/(true + 0.02)) of linear radiance.
    pub log_rmse: f64,
}

impl PictureError {
    /// The PSNR as a root mean square, of white.
    pub fn display_rmse(&self) -> f32 {
        libm::pow(10.0, -self.psnr / 20.0) as f32
    }
}

/// The averaged network on views that were not trained on, and others.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct HeldOut {
    /// Examples.
    pub examples: usize,
    /// Source pictures as they are.
    pub copied: PictureError,
    /// The best shading of the source picture, applied to the target light ([`shading`]).
    pub shaded: PictureError,
    /// The mean of the pictures under the two captured lights that are nearest to the target's, each weighted by the angle to the other.
    pub interpolated: Option<PictureError>,
    /// Captured lights of a view that interpolation chose from.
    pub captured: usize,
    /// Relit, from the source picture and the shape.
    pub relit: PictureError,
    /// What the fitted medium predicts, where the shards say so.
    pub medium: Option<PictureError>,
    /// Relit with that prediction.
    pub relit_with_medium: Option<PictureError>,
}

/// Lights of a view that interpolation knows beside the source's, at most.
const CAPTURED: usize = 4;

/// A perfect picture is capped at 100 dB.
const LEAST_SQUARE: f64 = 1e-10;

/// Error where `coverage` is at least a half; none where nothing is.
pub(super) fn error_inside(made: &Image, truth: &Image, coverage: &Image) -> Option<PictureError> {
    let (mut squares, mut logarithms, mut count) = (0.0, 0.0, 0usize);
    let pixels = made.data().chunks_exact(3).zip(truth.data().chunks_exact(3)).zip(coverage.data());
    for ((a, b), _) in pixels.filter(|(_, coverage)| **coverage >= 0.5) {
        for (a, b) in a.iter().zip(b) {
            let difference = Transfer::Srgb.encode(a.clamp(0.0, 1.0)) - Transfer::Srgb.encode(b.clamp(0.0, 1.0));
            let logarithm = super::ratio::log_ratio(*b, *a);
            squares += f64::from(difference * difference);
            logarithms += f64::from(logarithm * logarithm);
            count += 1;
        }
    }
    let n = count as f64;
    let psnr = || -10.0 * libm::log10((squares / n).max(LEAST_SQUARE));
    (count > 0).then(|| PictureError { psnr: psnr(), log_rmse: (logarithms / n).sqrt() })
}

/// The mean of two pictures under the lights nearest to another, seen from `centre`.
fn interpolated(pictures: &[(&Image, Vec3)], light: Vec3, centre: Vec3) -> Option<Image> {
    let direction = (light - centre).normalize_or_zero();
    let angle = |place: Vec3| libm::acosf((place - centre).normalize_or_zero().dot(direction).clamp(-1.0, 1.0));
    let mut near: Vec<(f32, &Image)> = pictures.iter().map(|(image, place)| (angle(*place), *image)).collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    let [(a, first), (b, second), ..] = near[..] else { return None };
    let share = if a + b > 0.0 { b / (a + b) } else { 0.5 };
    let mut out = first.clone();
    out.data_mut().iter_mut().zip(second.data()).for_each(|(to, other)| *to = share * *to + (1.0 - share) * other);
    Some(out)
}

/// A sum of errors over examples.
#[derive(Default)]
struct Sum(PictureError, usize);

impl Sum {
    fn add(&mut self, error: Option<PictureError>) {
        if let Some(error) = error {
            self.0.psnr += error.psnr;
            self.0.log_rmse += error.log_rmse;
            self.1 += 1;
        }
    }

    fn mean(&self) -> Option<PictureError> {
        let n = self.1 as f64;
        (self.1 > 0).then(|| PictureError { psnr: self.0.psnr / n, log_rmse: self.0.log_rmse / n })
    }
}

/// Measures a relighter on the first `count` examples. `look` is given each, with the picture relit from the shape and the one relit with the medium's.
pub fn held_out(
    relighter: &Relighter,
    examples: &RelightExamples,
    count: usize,
    options: &RelightOptions,
    look: &mut dyn FnMut(&RelightExample, &Image, Option<&Image>),
) -> Result<HeldOut> {
    let [mut copied, mut shaded, mut between, mut relit, mut medium, mut both] = [(); 6].map(|()| Sum::default());
    let mut captured = 0;
    for i in 0..count as u64 {
        let example = examples.example(0, i, Told::Shape)?;
        let RelightExample { view, target, picture } = &example;
        let of = |image: &Image| error_inside(image, picture, &view.coverage);
        let made = relighter.relight(view, std::slice::from_ref(target), options)?;
        relit.add(of(&made[0].image));
        copied.add(of(&view.source));
        shaded.add(of(&shading(view, target.light).target));
        let mut others = examples.others(0, i);
        others.truncate(CAPTURED - 1);
        if let Some(light) = view.source_light {
            others.push((&view.source, light));
        }
        captured = captured.max(others.len());
        let centre = view.centre_and_radius().map_or(Vec3::ZERO, |(centre, _)| centre);
        between.add(interpolated(&others, target.light, centre).as_ref().and_then(of));
        let told = examples.example(0, i, Told::Medium).ok();
        let with = match &told {
            Some(told) => Some(relighter.relight(&told.view, std::slice::from_ref(&told.target), options)?.remove(0)),
            None => None,
        };
        if let (Some(told), Some(with)) = (&told, &with) {
            medium.add(of(&Base::of(&told.view, &told.target)?.prediction.target));
            both.add(of(&with.image));
        }
        look(told.as_ref().unwrap_or(&example), &made[0].image, with.as_ref().map(|with| &with.image));
    }
    let (Some(relit_error), Some(copied), Some(shaded)) = (relit.mean(), copied.mean(), shaded.mean()) else {
        return Err(DiffusionError::setting("held-out examples", "at least one with an object in it", count));
    };
    Ok(HeldOut {
        examples: relit.1,
        copied,
        shaded,
        interpolated: between.mean(),
        captured,
        relit: relit_error,
        medium: medium.mean(),
        relit_with_medium: both.mean(),
    })
}

impl std::fmt::Display for HeldOut {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(
            f,
            "{} examples, where the object is: PSNR of sRGB, dB; RMS of the logarithm of radiance",
            self.examples
        )?;
        let between = format!("between the two nearest of {} lights", self.captured);
        let rows = [
            ("source as it is", Some(self.copied)),
            ("best shading of the source", Some(self.shaded)),
            (between.as_str(), self.interpolated),
            ("relit", Some(self.relit)),
            ("fitted medium", self.medium),
            ("relit with the fitted medium", self.relit_with_medium),
        ];
        for (name, error) in rows {
            if let Some(PictureError { psnr, log_rmse }) = error {
                writeln!(f, "  {name:<38} {psnr:6.2} dB  {log_rmse:.3}")?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand.
    #[test]
    fn errors_are_those_of_what_is_covered() {
        let (black, grey) = (Image::new(2, 1, 3), Image::filled(2, 1, 3, 0.5));
        let half = Image::from_vec(2, 1, 1, vec![1.0, 0.2]).unwrap();
        let mut made = black.clone();
        made.pixel_mut(0, 0).copy_from_slice(&[0.5; 3]);
        assert_eq!(error_inside(&made, &grey, &half).unwrap().psnr, 100.0);
        let error = error_inside(&black, &grey, &half).unwrap();
        let encoded = f64::from(Transfer::Srgb.encode(0.5));
        assert!((error.psnr + 20.0 * encoded.log10()).abs() < 1e-5);
        assert!((error.log_rmse - (0.52f64 / 0.02).ln()).abs() < 1e-5);
        assert_eq!(error_inside(&black, &grey, &Image::new(2, 1, 1)), None);
    }

    #[test]
    fn the_nearer_light_counts_more() {
        let (one, two, far) = (Image::filled(1, 1, 3, 1.0), Image::filled(1, 1, 3, 2.0), Image::filled(1, 1, 3, 9.0));
        let at = |degrees: f32| Vec3::new(degrees.to_radians().sin(), degrees.to_radians().cos(), 0.0);
        let mean =
            interpolated(&[(&far, at(170.0)), (&two, at(30.0)), (&one, at(-10.0))], at(0.0), Vec3::ZERO).unwrap();
        assert!((mean.data()[0] - 1.25).abs() < 1e-4, "{}", mean.data()[0]);
        assert!(interpolated(&[(&one, at(1.0))], at(0.0), Vec3::ZERO).is_none());
    }
}
