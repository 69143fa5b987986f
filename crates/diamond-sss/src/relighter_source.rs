//! The relighter as a source of pictures that nobody took, and what a fitted medium says to it.
use crate::SssError;
use diamond_augment::{Picture, Source, SourceError, Target};
use diamond_camera::Camera;
use diamond_dataset::Capture;
use diamond_diffusion::DiffusionError;
use diamond_diffusion::relight::{Prediction, RelightOptions, RelightTarget, RelightView, Relighter, Relit};
use diamond_image::{Image, Mask, Transfer};
use diamond_light::{Falloff, OlatLight};
use diamond_medium::{MediumPictures, Sight, Surface};
use diamond_reconstruct::{Guidance, GuidedSource};
use glam::Vec3;
use std::path::Path;
use std::sync::Arc;

/// Error that is assumed of a relighter whose file does not state it: about that of shading, display values.
const ASSUMED_ERROR: f32 = 0.08;

/// A view of a surface as the relighter wants it: geometry and coverage of a camera.
#[derive(Debug, Clone)]
pub struct SurfaceView {
    sight: Sight,
    camera: Camera,
    mask: Option<Mask>,
}

impl SurfaceView {
    /// What a camera sees of a surface, within the photographs' silhouette where there is one.
    pub fn new(surface: &Surface, camera: &Camera, mask: Option<&Mask>) -> Self {
        Self { sight: Sight::new(surface, camera), camera: *camera, mask: mask.cloned() }
    }

    /// View-space z and normals, 0 where nothing is.
    pub fn shape(&self) -> (Image, Image) {
        (self.sight.depth(&self.camera), self.sight.normals())
    }

    /// Coverage: the photographs', or the surface's.
    pub fn coverage(&self) -> Image {
        let mask = self.mask.as_ref().and_then(|m| Image::from_vec(m.width(), m.height(), 1, m.data().to_vec()).ok());
        mask.unwrap_or_else(|| self.sight.coverage())
    }

    /// What the medium predicts under a light.
    pub fn predicted(&self, pictures: &mut MediumPictures, light: &OlatLight) -> Result<Image, SourceError> {
        Ok(self.sight.over_mask(pictures.radiance(&self.sight, light)?, self.mask.as_ref()))
    }
}

/// Relights photographs of a capture.
pub struct RelighterSource {
    relighter: Arc<Relighter>,
    options: RelightOptions,
    surface: Surface,
    medium: Option<MediumPictures>,
    falloff: Falloff,
    half_error: f32,
    error: f32,
    state: String,
}

/// Makes a [`RelighterSource`] of a network when pictures are due.
#[derive(Debug, Clone)]
pub struct RelighterOnSurface {
    relighter: Arc<Relighter>,
}

impl RelighterOnSurface {
    /// Of a file that `diamond train` has written.
    ///
    /// # Errors
    /// A file that cannot be read, of another model, or damaged.
    pub fn load(path: &Path) -> Result<Self, SssError> {
        let relighter = Relighter::load(path).map_err(|e| match e {
            DiffusionError::File { path, problem } | DiffusionError::Weights { origin: path, problem } => {
                SssError::Input { path: path.into(), detail: problem }
            }
            other => SssError::Input { path: path.to_owned(), detail: other.to_string() },
        })?;
        Ok(Self { relighter: Arc::new(relighter) })
    }
}

impl GuidedSource for RelighterOnSurface {
    fn source(&self, guidance: Guidance<'_>) -> Result<Box<dyn Source>, SourceError> {
        let relighter = Arc::clone(&self.relighter);
        // Who was never told what a medium predicts would not know what to do with it.
        let with_medium = relighter.expected_error(true).is_some();
        let pictures = || MediumPictures::new(guidance.surface.clone(), guidance.medium.clone(), guidance.falloff);
        let medium = with_medium.then(pictures).transpose()?;
        let options = RelightOptions::default();
        let error = relighter.expected_error(with_medium).unwrap_or(ASSUMED_ERROR);
        let state = format!("{:016x} {options:?} {with_medium} {}", relighter.digest(), guidance.state);
        Ok(Box::new(RelighterSource {
            relighter,
            options,
            surface: guidance.surface.clone(),
            medium,
            falloff: guidance.falloff,
            half_error: guidance.half_error,
            error,
            state,
        }))
    }
}

/// Irradiance of a light at a point, for directions too.
fn irradiance(light: &OlatLight, at: Vec3, falloff: Falloff) -> Vec3 {
    light.incidence(at, falloff).irradiance
}

/// Where a light stands; one that is infinitely far stands in its direction, so far that it does not matter.
fn place(light: &OlatLight, centre: Vec3, distance: f32) -> Vec3 {
    match *light {
        OlatLight::Point { position, .. } => position,
        OlatLight::Directional { direction, .. } => centre + 1000.0 * distance * direction,
    }
}

fn times(image: &Image, factor: Vec3) -> Image {
    let mut out = image.clone();
    let factors = factor.to_array();
    out.data_mut().iter_mut().enumerate().for_each(|(i, v)| *v *= factors[i % 3]);
    out
}

/// Reciprocals, 0 where there is no light.
fn over(v: Vec3) -> Vec3 {
    Vec3::from(v.to_array().map(|v| if v > 0.0 { 1.0 / v } else { 0.0 }))
}

impl RelighterSource {
    /// What all lights of the capture's photographs are compared with: their mean irradiance, so that radiances are as bright as in the photographs.
    fn unit(&self, capture: &Capture, centre: Vec3) -> f32 {
        let lights = capture.train.iter().flat_map(|view| &view.shots).map(|shot| &shot.light);
        let (sum, n) = lights.fold((0.0, 0usize), |(sum, n), light| {
            (sum + irradiance(light, centre, self.falloff).element_sum() / 3.0, n + 1)
        });
        if n > 0 && sum > 0.0 { sum / n as f32 } else { 1.0 }
    }

    /// Targets of one photograph.
    fn relit(
        &mut self,
        capture: &Capture,
        (view, shot): (usize, usize),
        lights: &[OlatLight],
    ) -> Result<Vec<Picture>, SourceError> {
        let (taken, camera) = (&capture.train[view].shots[shot], capture.train[view].camera);
        let observation = capture.observation(taken)?;
        let seen = SurfaceView::new(&self.surface, &camera, observation.mask.as_ref());
        let ((depth, normals), coverage) = (seen.shape(), seen.coverage());
        let centre = middle(&self.surface);
        let distance = (camera.pose.centre() - centre).length();
        let unit = self.unit(capture, centre);
        let factor = |light: &OlatLight| irradiance(light, centre, self.falloff) / unit;
        let from = factor(&taken.light);
        let relight_view = RelightView {
            camera,
            source: times(&observation.radiance, over(from)),
            coverage: coverage.clone(),
            depth,
            normals,
            source_light: Some(place(&taken.light, centre, distance)),
        };
        let mut targets = Vec::with_capacity(lights.len());
        for light in lights {
            let prediction = match &mut self.medium {
                Some(pictures) => Some(Prediction {
                    source: times(&seen.predicted(pictures, &taken.light)?, over(from)),
                    target: times(&seen.predicted(pictures, light)?, over(factor(light))),
                }),
                None => None,
            };
            targets.push(RelightTarget { light: place(light, centre, distance), prediction });
        }
        // Each by itself: matrix products of several lights at once have other last bits, and a picture must not depend on what else is asked for.
        let mut made = Vec::with_capacity(targets.len());
        for target in &targets {
            made.extend(self.relighter.relight(&relight_view, std::slice::from_ref(target), &self.options)?);
        }
        let pictures = made.into_iter().zip(lights).map(|(made, light)| {
            Ok(Picture {
                confidence: self.confidence(&made, &coverage),
                radiance: times(&made.image, factor(light)),
                mask: Some(Mask::from_channel(&coverage, 0)?),
            })
        });
        pictures.collect()
    }

    /// [eq:relit-confidence] 1/(1 + (e² + d²)/h²): e the error on objects that were held out of training, d the deviation over runs, h the error that is
    /// believed by half; all display values. Nothing is believed to be where nothing is.
    fn confidence(&self, made: &Relit, coverage: &Image) -> Image {
        let display = |v: f32| Transfer::Srgb.encode(v.clamp(0.0, 1.0));
        let (width, height, _) = made.image.shape();
        let mut out = Image::new(width, height, 1);
        for (i, confidence) in out.data_mut().iter_mut().enumerate() {
            let mean = made.image.data()[3 * i..][..3].iter().sum::<f32>() / 3.0;
            let spread = display(mean + made.deviation.data()[i]) - display(mean);
            let squares = (self.error * self.error + spread * spread) / (self.half_error * self.half_error);
            *confidence = if coverage.data()[i] > 0.0 { 1.0 / (1.0 + squares) } else { 1.0 };
        }
        out
    }
}

/// The mean of a surface's places.
fn middle(surface: &Surface) -> Vec3 {
    let places = surface.positions();
    places.iter().sum::<Vec3>() / places.len().max(1) as f32
}

impl Source for RelighterSource {
    fn method(&self) -> String {
        let with = if self.medium.is_some() { "relighter on a medium" } else { "relighter" };
        format!("diffusion: {with}")
    }

    fn state(&self) -> String {
        self.state.clone()
    }

    fn pictures(&mut self, capture: &Capture, targets: &[Target]) -> Result<Vec<Picture>, SourceError> {
        let mut out = Vec::with_capacity(targets.len());
        // Lights of one photograph share its geometry.
        for same in targets.chunk_by(|a, b| a.photograph == b.photograph && a.view == b.view) {
            let lights: Vec<OlatLight> = same.iter().map(|target| target.light).collect();
            match same[0].view {
                Some(view) if same[0].photograph.0 == view => {
                    out.extend(self.relit(capture, same[0].photograph, &lights)?)
                }
                // It turns lights, not views: nothing is believed, and the pictures are refused.
                _ => out.extend(same.iter().map(|target| {
                    let k = target.camera.intrinsics;
                    let (width, height) = (k.width as usize, k.height as usize);
                    Picture {
                        radiance: Image::new(width, height, 3),
                        mask: None,
                        confidence: Image::new(width, height, 1),
                    }
                })),
            }
        }
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_augment::{Lack, Wanted};
    use diamond_dataset::{OpenOptions, Regime};
    use diamond_diffusion::nn::{Source as Weights, VariablesBuilder};
    use diamond_diffusion::relight::RelighterConfig;
    use diamond_pathtrace::Mesh;

    const FALLOFF: Falloff = Falloff::InverseSquare { reference: 1.0 };

    fn capture() -> Capture {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/candle-small");
        let whole = Capture::open(folder.as_ref(), &OpenOptions::default()).unwrap();
        "full-one".parse::<Regime>().and_then(|r| r.apply(&whole, 0)).unwrap()
    }

    /// An untrained network on a ball.
    fn source() -> RelighterSource {
        let builder = VariablesBuilder::new(Weights::Seed(3));
        let config = RelighterConfig { size: 16, ..RelighterConfig::shipped() };
        RelighterSource {
            relighter: Arc::new(Relighter::new(&builder.root(), &config).unwrap()),
            options: RelightOptions { steps: 2, ..RelightOptions::default() },
            surface: Surface::new(Mesh::icosphere(Vec3::ZERO, 0.7, 3), 200).unwrap(),
            medium: None,
            falloff: FALLOFF,
            half_error: 0.05,
            error: 0.05,
            state: "untrained".into(),
        }
    }

    /// [eq:relit-confidence] Pictures come in the order of the targets and do not depend on what else is asked for; a light of twice the intensity is twice as
    /// bright; where the photographs show nothing there is nothing, for sure, and elsewhere no more than half is believed where the error is the half error.
    #[test]
    fn relit_pictures_are_lights_in_order_and_what_is_not_there_is_sure() {
        let (capture, mut source) = (capture(), source());
        let lack = Lack::of(&capture, &Wanted { lights: 2, ..Wanted::default() });
        let mut targets = lack.targets[..3].to_vec();
        targets.push(Target { light: targets[0].light.scaled(Vec3::splat(2.0)), ..targets[0] });
        let all = source.pictures(&capture, &targets).unwrap();
        assert_eq!(all.len(), 4);
        for (target, picture) in targets.iter().zip(&all) {
            let alone = source.pictures(&capture, std::slice::from_ref(target)).unwrap().remove(0);
            assert!(alone == *picture, "it depends on what else is asked for");
            let mask = picture.mask.as_ref().unwrap();
            for (confidence, covered) in picture.confidence.data().iter().zip(mask.data()) {
                assert!(if *covered > 0.0 { *confidence <= 0.5 && *confidence > 0.0 } else { *confidence == 1.0 });
            }
        }
        assert!(all[0].radiance.data().iter().any(|v| *v > 0.01) && all[0].radiance != all[1].radiance);
        for (one, two) in all[0].radiance.data().iter().zip(all[3].radiance.data()) {
            assert!((2.0 * one - two).abs() <= 1e-5 * two.abs() + 1e-7, "{one} {two}");
        }
        let elsewhere = Target { view: None, ..targets[0] };
        let unknown = source.pictures(&capture, &[elsewhere]).unwrap().remove(0);
        assert!(unknown.confidence.data().iter().all(|c| *c == 0.0));
    }

    #[test]
    fn files_that_hold_no_relighter_are_refused() {
        let path = std::env::temp_dir().join(format!("diamond-no-relighter-{}.safetensors", std::process::id()));
        let refused = || RelighterOnSurface::load(&path).unwrap_err().to_string();
        assert!(refused().contains("cannot be read"), "{}", refused());
        std::fs::write(&path, b"no weights").unwrap();
        assert!(refused().contains("no-relighter"), "{}", refused());
        std::fs::remove_file(&path).unwrap();
    }
}
