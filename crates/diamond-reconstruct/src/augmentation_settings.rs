//! `[augmentation]`: pictures that nobody took, to learn from beside the photographs.
use crate::{ReconstructError, SubsurfaceModel};
use diamond_augment::{GenerateOptions, Wanted};
use diamond_medium::PriorOptions;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Who makes pictures that nobody took.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AugmentationSource {
    /// The medium of the model, where it has one; else nobody.
    #[default]
    Auto,
    /// Nobody.
    None,
    /// The physical prior: a medium fitted to the photographs, in the surface of the model as it stands. With a medium in the model it is that one.
    Prior,
    /// The relighter of the file [`AugmentationSettings::relighter`]: it diffuses what is wrong with a prediction, from each view's own photographs. The
    /// prediction is the physical prior's where the network was trained with such, and shading's otherwise.
    Diffusion,
    /// The physical prior and the relighter, each.
    Both,
}

/// Pictures that nobody took: how many, what they count, and when.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AugmentationSettings {
    /// Who makes them.
    pub source: AugmentationSource,
    /// File of the relighter's weights, which `diamond train` has written.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub relighter: Option<PathBuf>,
    /// Fraction of the run at which they are made, and from which on they are learned from…
    pub from: f32,
    /// …and until which.
    pub until: f32,
    /// Share of the images of a run that are such pictures, while they are learned from, in [0, 1); the others are photographs. It is less where there are few
    /// pictures: none comes more often than a photograph.
    pub share: f32,
    /// Lights for each view, at most, among those of the rig that it was not photographed under.
    pub lights: usize,
    /// Whether a capture of which each view has every light of the rig gets lights from all around.
    pub beyond_rig: bool,
    /// Views for each training view from where nobody photographed, at most; each gets as many lights.
    pub views: usize,
    /// What a pixel counts that is wholly believed, over one of a photograph.
    pub weight: f32,
    /// Error of the prior on photographs, in display values, at which a pixel is believed by half.
    pub half_error: f32,
    /// Pictures of a photographed view whose silhouette overlaps the photographs' by less of their union are refused.
    pub min_overlap: f32,
    /// Pictures from elsewhere of which a larger share lies outside of the hull of the masks are refused.
    pub max_outside: f32,
}

impl Default for AugmentationSettings {
    fn default() -> Self {
        let (prior, judge) = (PriorOptions::default(), GenerateOptions::default());
        Self {
            source: AugmentationSource::Auto,
            relighter: None,
            from: 0.0,
            until: 1.0,
            share: 0.5,
            lights: 6,
            beyond_rig: false,
            views: 0,
            weight: 0.5,
            half_error: prior.half_error,
            min_overlap: judge.min_overlap,
            max_outside: judge.max_outside,
        }
    }
}

impl AugmentationSettings {
    /// Whether the prior is asked in a run with such a model.
    pub(crate) fn asks_prior(&self, model: SubsurfaceModel) -> bool {
        match self.source {
            AugmentationSource::Auto => model.has_medium(),
            AugmentationSource::Prior | AugmentationSource::Both => true,
            AugmentationSource::None | AugmentationSource::Diffusion => false,
        }
    }

    /// Whether a relighter is asked: one that [`crate::Reconstruction::with_relighter`] brings.
    pub fn asks_relighter(&self) -> bool {
        matches!(self.source, AugmentationSource::Diffusion | AugmentationSource::Both)
    }

    /// What else keeps pictures from being of use.
    pub(crate) fn off_because(&self) -> Option<&'static str> {
        match self {
            s if s.share <= 0.0 => Some("augmentation.share = 0: no step would learn from them"),
            s if s.weight <= 0.0 => Some("augmentation.weight = 0: they would count nothing"),
            s if s.until <= s.from => Some("augmentation.until is not after augmentation.from"),
            s if s.lights == 0 => Some("augmentation.lights = 0"),
            _ => None,
        }
    }

    /// How much of what a capture lacks is wanted.
    pub fn wanted(&self) -> Wanted {
        Wanted { lights: self.lights, views: self.views, beyond_rig: self.beyond_rig }
    }

    /// Checks ranges; `origin` names the file in errors.
    pub(crate) fn validate(&self, origin: &str) -> Result<(), ReconstructError> {
        let fail = |detail: String| Err(ReconstructError::Config { origin: origin.to_owned(), detail });
        let unit = [
            ("from", self.from),
            ("until", self.until),
            ("min_overlap", self.min_overlap),
            ("max_outside", self.max_outside),
        ];
        for (key, value) in unit {
            if !(0.0..=1.0).contains(&value) {
                return fail(format!("`augmentation.{key}` must lie in [0, 1], found {value}"));
            }
        }
        if !(0.0..1.0).contains(&self.share) {
            return fail(format!("`augmentation.share` must lie in [0, 1), found {}", self.share));
        }
        if !(0.0..f32::INFINITY).contains(&self.weight) {
            return fail(format!("`augmentation.weight` must be finite and not negative, found {}", self.weight));
        }
        if !(self.half_error > 0.0 && self.half_error.is_finite()) {
            return fail(format!("`augmentation.half_error` must be greater than 0, found {}", self.half_error));
        }
        Ok(())
    }
}
