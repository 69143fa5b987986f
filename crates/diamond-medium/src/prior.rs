//! The physical prior as a source of pictures that nobody took.
//!
//! A fitted medium in its surface predicts every view under every light. How far to believe it, the photographs say: where its pictures of them are wrong, its
//! other pictures are believed less. The error is kept per surfel, so that it is known from every side.
use crate::{FitImage, Medium, MediumError, MediumPictures, Sight, Surface};
use diamond_augment::{Picture, Source, SourceError, Target};
use diamond_dataset::Capture;
use diamond_image::{Image, Mask, Transfer};
use diamond_light::Falloff;
use sha2::{Digest, Sha256};

/// What is believed of the prior.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PriorOptions {
    /// Error, in display values, at which a pixel is believed by half.
    pub half_error: f32,
    /// Photographs on which the error is measured, at most.
    pub images: usize,
}

impl Default for PriorOptions {
    fn default() -> Self {
        Self { half_error: 0.05, images: 64 }
    }
}

/// Where no photograph shows a surfel, the error is taken to be so many times the mean: there neither light nor shape were checked.
const UNSEEN: f64 = 2.0;
/// The weight of that assumption, pixels.
const ASSUMED_PIXELS: f64 = 1.0;
/// A medium in its surface as a source of pictures. Made of [`MediumPictures`] and the photographs; see [`Prior::new`].
#[derive(Debug)]
pub struct Prior {
    pictures: MediumPictures,
    options: PriorOptions,
    /// Mean error of each surfel, display values.
    error: Vec<f32>,
    mean_error: f32,
    state: String,
}

fn spread<T>(all: &[T], most: usize) -> impl Iterator<Item = &T> {
    let n = all.len();
    let count = n.min(most);
    (0..count).map(move |k| &all[k * n / count])
}

fn display(v: f32) -> f32 {
    Transfer::Srgb.encode(v.clamp(0.0, 1.0))
}

/// Photograph and prediction of a pixel over black: mean over channels of |difference|, display values.
fn difference(a: &[f32], b: &[f32]) -> f32 {
    (0..3).map(|c| (display(a[c]) - display(b[c])).abs()).sum::<f32>() / 3.0
}

/// [eq:prior-confidence] 1/(1 + (e/h)²): how much of a pixel is believed whose error e is known; h is the error at which it is one half.
fn believed(error: f32, half_error: f32) -> f32 {
    let ratio = error / half_error.max(f32::MIN_POSITIVE);
    1.0 / (1.0 + ratio * ratio)
}

impl Prior {
    /// A prior whose error is measured on `photographs` (those that the medium was fitted to, or others).
    ///
    /// # Errors
    /// Transport's. Without photographs nothing is known, and every surfel has the error of `half_error`.
    pub fn new(
        surface: Surface,
        medium: Medium,
        falloff: Falloff,
        photographs: &[FitImage<'_>],
        options: PriorOptions,
    ) -> Result<Self, MediumError> {
        let state = state_of(&surface, &medium, falloff, photographs, &options);
        let mut pictures = MediumPictures::new(surface, medium, falloff)?;
        let n = pictures.surface().positions().len();
        let (mut sum, mut weight) = (vec![0.0f64; n], vec![0.0f64; n]);
        let chosen: Vec<&FitImage<'_>> = spread(photographs, options.images).collect();
        pictures.prepare(&chosen.iter().map(|p| *p.light).collect::<Vec<_>>())?;
        for photograph in &chosen {
            let sight = Sight::new(pictures.surface(), photograph.camera);
            let predicted = sight.over_mask(pictures.radiance(&sight, photograph.light)?, photograph.mask);
            let value = |pixel: usize| {
                let inside = photograph.mask.is_none_or(|m| m.data()[pixel] >= 0.5);
                let of = |image: &'_ Image| [0, 1, 2].map(|c| image.data()[3 * pixel + c]);
                inside.then(|| difference(&of(&predicted), &of(photograph.radiance)))
            };
            sight.spread_on(value, &mut sum, &mut weight);
        }
        let seen: f64 = weight.iter().sum();
        let mean = if seen > 0.0 { sum.iter().sum::<f64>() / seen } else { f64::from(options.half_error) / UNSEEN };
        let of = |(s, w): (&f64, &f64)| ((s + ASSUMED_PIXELS * UNSEEN * mean) / (w + ASSUMED_PIXELS)) as f32;
        let error = sum.iter().zip(&weight).map(of).collect();
        Ok(Self { pictures, options, error, mean_error: mean as f32, state })
    }

    /// The surface.
    pub fn surface(&self) -> &Surface {
        self.pictures.surface()
    }

    /// The medium.
    pub fn medium(&self) -> &Medium {
        self.pictures.medium()
    }

    /// Mean difference from the photographs where they show the surface, display values.
    pub fn mean_error(&self) -> f32 {
        self.mean_error
    }
}

impl Source for Prior {
    fn method(&self) -> String {
        format!("prior: {}", self.pictures.medium().kind())
    }

    fn state(&self) -> String {
        self.state.clone()
    }

    fn pictures(&mut self, capture: &Capture, targets: &[Target]) -> Result<Vec<Picture>, SourceError> {
        self.pictures.prepare(&targets.iter().map(|t| t.light).collect::<Vec<_>>())?;
        let mut out = Vec::with_capacity(targets.len());
        let mut last: Option<(usize, Sight)> = None;
        for (n, target) in targets.iter().enumerate() {
            if last.as_ref().is_none_or(|(m, _)| targets[*m].camera != target.camera) {
                last = Some((n, Sight::new(self.pictures.surface(), &target.camera)));
            }
            let Some((_, sight)) = &last else { continue };
            let coverage = sight.coverage();
            let photographed = match target.view.and_then(|v| capture.train[v].shots.first()) {
                Some(shot) => capture.observation(shot)?.mask.clone(),
                None => None,
            };
            let radiance = sight.over_mask(self.pictures.radiance(sight, &target.light)?, photographed.as_ref());
            let mut confidence = sight.mean_of(&self.error);
            for (i, c) in confidence.data_mut().iter_mut().enumerate() {
                let mask = photographed.as_ref().map(|m| m.data()[i]);
                let met = coverage.data()[i];
                *c = match mask {
                    // Nothing is there, whatever the surface says.
                    Some(0.0) => 1.0,
                    Some(_) if met == 0.0 => 0.0,
                    None if met == 0.0 => believed(UNSEEN as f32 * self.mean_error, self.options.half_error),
                    _ => believed(*c, self.options.half_error),
                };
            }
            let mask = match photographed {
                Some(mask) => mask,
                None => Mask::from_channel(&coverage, 0)?,
            };
            out.push(Picture { radiance, mask: Some(mask), confidence });
        }
        Ok(out)
    }
}

/// A hash of everything that the pictures depend on.
fn state_of(
    surface: &Surface,
    medium: &Medium,
    falloff: Falloff,
    photographs: &[FitImage<'_>],
    options: &PriorOptions,
) -> String {
    let mut hash = Sha256::new();
    let mesh = surface.mesh();
    let mut floats =
        |values: &mut dyn Iterator<Item = f32>| values.for_each(|v| hash.update(v.to_bits().to_le_bytes()));
    floats(&mut mesh.positions.iter().flat_map(|p| p.to_array()));
    floats(&mut mesh.normals.iter().flatten().flat_map(|p| p.to_array()));
    floats(&mut surface.positions().iter().flat_map(|p| p.to_array()));
    for photograph in photographs {
        floats(&mut photograph.radiance.data().iter().copied());
    }
    mesh.triangles.iter().flatten().for_each(|i| hash.update(i.to_le_bytes()));
    hash.update(format!("{falloff:?} {options:?} {medium:?}").as_bytes());
    hash.finalize().iter().map(|b| format!("{b:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Coat, Transport};
    use diamond_camera::{Camera, Intrinsics, Pose};
    use diamond_light::OlatLight;
    use diamond_pathtrace::Mesh;
    use glam::Vec3;

    fn surface() -> Surface {
        Surface::new(Mesh::icosphere(Vec3::ZERO, 1.0, 4), 900).unwrap()
    }

    fn medium() -> Medium {
        let transport =
            Transport::Profile { widths: vec![0.15, 0.4], weights: vec![[0.4, 0.3, 0.2]; 2], local: [0.1; 3] };
        Medium { unit: 1.0, transport, coat: Coat { roughness: 0.4, scale: 0.5 }, quality: None, described: None }
    }

    fn camera(eye: Vec3) -> Camera {
        Camera { intrinsics: Intrinsics::from_fov_x(0.8, 40, 40), pose: Pose::look_at(eye, Vec3::ZERO, Vec3::Y) }
    }

    const FALLOFF: Falloff = Falloff::InverseSquare { reference: 3.0 };

    /// [eq:prior-confidence] One half at the half error, falling, and nowhere outside 0 … 1.
    #[test]
    fn belief_falls_with_the_error() {
        assert_eq!((believed(0.0, 0.05), believed(0.05, 0.05)), (1.0, 0.5));
        assert!((believed(0.1, 0.05) - 0.2).abs() < 1e-6);
        assert!((0..100).all(|i| believed(i as f32 * 0.02, 0.05) > believed((i + 1) as f32 * 0.02, 0.05)));
    }

    /// Photographs that are wrong on one side take the belief from that side, in views that were not photographed as well.
    #[test]
    fn what_is_wrong_on_photographs_is_not_believed_elsewhere() {
        let light = OlatLight::Point { position: Vec3::new(0.5, 1.0, 3.0), intensity: Vec3::splat(2.0) };
        let there = camera(Vec3::new(0.0, 0.0, 3.5));
        let mut pictures = MediumPictures::new(surface(), medium(), FALLOFF).unwrap();
        let sight = Sight::new(pictures.surface(), &there);
        let true_picture = pictures.radiance(&sight, &light).unwrap();
        // The half with x < 0 is darker than the medium says, as if painted.
        let mut painted = true_picture.clone();
        for (i, pixel) in painted.data_mut().chunks_exact_mut(3).enumerate() {
            if i % 40 < 20 {
                pixel.iter_mut().for_each(|v| *v *= 0.3);
            }
        }
        let of = |radiance| [FitImage { camera: &there, light: &light, radiance, mask: None, tint: None, known: None }];
        let sure = Prior::new(surface(), medium(), FALLOFF, &of(&true_picture), PriorOptions::default()).unwrap();
        let unsure = Prior::new(surface(), medium(), FALLOFF, &of(&painted), PriorOptions::default()).unwrap();
        assert!(
            sure.mean_error() < 1e-4 && unsure.mean_error() > 0.02,
            "{} {}",
            sure.mean_error(),
            unsure.mean_error()
        );
        assert_ne!(sure.state(), unsure.state());
        let elsewhere = Sight::new(unsure.surface(), &camera(Vec3::new(0.0, 1.2, 3.3)));
        let error = elsewhere.mean_of(&unsure.error);
        let side = |left: bool| {
            let inside = (0..1600).filter(|i| elsewhere.coverage().data()[*i] == 1.0 && (i % 40 < 18) == left);
            let errors: Vec<f32> = inside.filter(|i| left || i % 40 > 22).map(|i| error.data()[i]).collect();
            errors.iter().sum::<f32>() / errors.len() as f32
        };
        assert!(side(true) > 2.0 * side(false), "{} {}", side(true), side(false));
        // The far side, which nobody saw, counts as twice the mean.
        let behind = Sight::new(unsure.surface(), &camera(Vec3::new(0.0, 0.0, -3.5))).mean_of(&unsure.error);
        assert!((behind.pixel(20, 20)[0] - 2.0 * unsure.mean_error()).abs() < 1e-3);
    }
}
