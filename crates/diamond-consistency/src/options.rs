//! How views are compared.
use crate::{ConsistencyError, DepthKind};

/// What a difference of silhouettes costs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SilhouettePenalty {
    /// Binary cross-entropy, with the first view's silhouette as the label.
    #[default]
    Bce,
    /// Absolute difference.
    L1,
}

/// How a depth map is read between its pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DepthSampling {
    /// Bilinear in 1/z, which is exact on planes: on a plane 1/z is affine in pixel coordinates, z is not.
    #[default]
    Inverse,
    /// Bilinear in z: exact on planes that face the camera.
    Linear,
}

/// Whose maps are constants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Detach {
    /// Neither's: the gradient reaches both views.
    #[default]
    None,
    /// The first view's, from which points are taken.
    Source,
    /// The second view's, in which they are looked up. The first still feels where its points land there.
    Target,
}

/// Depths that count as 0 and as 1, scene units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthRange {
    /// Nearest depth of the scene, at least 0. Points that come nearer to the second camera count as behind it.
    pub near: f32,
    /// Farthest depth of the scene.
    pub far: f32,
}

/// How views are compared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConsistencyOptions {
    /// What a difference of silhouettes costs.
    pub penalty: SilhouettePenalty,
    /// In which kind of depth both sides are compared. Whatever the maps' own kinds are, they are converted.
    pub depth_kind: DepthKind,
    /// How the second view's depth is read between pixels.
    pub sampling: DepthSampling,
    /// What depth differences are divided by: far − near.
    pub range: DepthRange,
    /// A pixel shows the object where the silhouette is above this, in [0, 1).
    pub min_silhouette: f32,
    /// A point is hidden in the second view where the depths differ by this share of its own or more; infinity to look at
    /// hidden points as well.
    pub max_gap: f32,
    /// A point is averted where the surface of the first view, by its own depth, faces the second camera with a smaller cosine than
    /// this; −1 to look at all points. On the far side of an object the second view often shows another surface at nearly the same
    /// depth, which no gap tells from the same one.
    pub min_facing: f32,
    /// Whose maps are constants.
    pub detach: Detach,
    /// Whether the silhouette term pulls on the first view's silhouette as the label as well. With cross-entropy that pull is
    /// ln((1 − o)/o) even where both agree: it presses every silhouette above the threshold toward 1.
    pub label_gradient: bool,
}

impl ConsistencyOptions {
    /// The defaults for a scene in this range: cross-entropy, view-space z read in 1/z, silhouettes above ½, gaps below
    /// 5 %, surfaces of any direction, the gradient to everything.
    pub fn new(range: DepthRange) -> Self {
        Self {
            penalty: SilhouettePenalty::default(),
            depth_kind: DepthKind::default(),
            sampling: DepthSampling::default(),
            range,
            min_silhouette: 0.5,
            max_gap: 0.05,
            min_facing: -1.0,
            detach: Detach::default(),
            label_gradient: true,
        }
    }

    pub(crate) fn validate(&self) -> Result<(), ConsistencyError> {
        let fail = |what, expected, found| Err(ConsistencyError::Setting { what, expected, found });
        let DepthRange { near, far } = self.range;
        if !(near.is_finite() && near >= 0.0) {
            return fail("DepthRange::near", "a finite depth of at least 0", near);
        }
        if !(far.is_finite() && far > near && (far - near).is_normal()) {
            return fail("DepthRange::far", "a finite depth above near", far);
        }
        if !(0.0..1.0).contains(&self.min_silhouette) {
            return fail("min_silhouette", "a number in [0, 1)", self.min_silhouette);
        }
        if !(-1.0..1.0).contains(&self.min_facing) {
            return fail("min_facing", "a cosine in [-1, 1)", self.min_facing);
        }
        if self.max_gap.is_nan() || self.max_gap <= 0.0 {
            return fail("max_gap", "a share above 0, or infinity", self.max_gap);
        }
        Ok(())
    }
}
