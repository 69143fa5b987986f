//! What a view says about shape: where it was seen from, how far each pixel's surface is, and where there is one.
//!
//! There is no radiance here, so nothing in this crate can depend on how the scene was lit.
use crate::ConsistencyError;
use crate::error::{expect_finite, expect_map};
use diamond_camera::{Camera, Depth};
use diamond_image::{Image, Mask};
use glam::Vec2;

/// Which length a depth is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DepthKind {
    /// View-space z.
    #[default]
    Z,
    /// Euclidean distance from the camera's centre.
    Distance,
}

/// A depth for each pixel, and its kind.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthMap {
    /// Which length `values` are.
    pub kind: DepthKind,
    /// One channel, the camera's size, scene units. Zero, negative, infinite and NaN mean that nothing is known.
    pub values: Image,
}

/// Where a view's depth comes from, which decides what its gradient is.
#[derive(Debug, Clone, Copy)]
pub enum DepthSource<'a> {
    /// Σ w·z of a rasteriser (view-space z, not divided by opacity): depth is this over the silhouette, and the gradient
    /// reaches both.
    Rendered(&'a Image),
    /// Depth known from elsewhere: a scanner, another renderer. The gradient is with respect to its values, for those who
    /// can use it.
    Given(&'a DepthMap),
    /// Guessed from a single picture and aligned (see [`crate::align_depth`]): a constant, its gradient is 0.
    Estimated(&'a DepthMap),
}

/// A view's camera, silhouette and depth.
#[derive(Debug, Clone, Copy)]
pub struct ViewGeometry<'a> {
    /// Where it was seen from; its intrinsics say how large the maps are.
    pub camera: &'a Camera,
    /// Soft silhouette S = 1 − Π(1 − α) in [0, 1], one channel.
    pub silhouette: &'a Image,
    /// Depth.
    pub depth: DepthSource<'a>,
    /// The photograph's mask. Where it is given, it takes the place of this view's silhouette as what another view's
    /// silhouette is compared with, and is a constant.
    pub mask: Option<&'a Mask>,
}

/// Gradient with respect to a [`ViewGeometry`].
#[derive(Debug, Clone, PartialEq)]
pub struct ViewGeometryGrad {
    /// With respect to the silhouette.
    pub silhouette: Image,
    /// With respect to the numbers in [`ViewGeometry::depth`]: Σ w·z where it is rendered.
    pub depth: Image,
}

impl ViewGeometryGrad {
    pub(crate) fn zeros(width: usize, height: usize) -> Self {
        Self { silhouette: Image::new(width, height, 1), depth: Image::new(width, height, 1) }
    }
}

/// Opacities below this are not divided by. Pixels that are used have far more, so that the guard never acts there.
const MIN_OPACITY: f32 = 1e-5;

impl ViewGeometry<'_> {
    pub(crate) fn size(&self) -> (usize, usize) {
        (self.camera.intrinsics.width as usize, self.camera.intrinsics.height as usize)
    }

    pub(crate) fn validate(&self) -> Result<(), ConsistencyError> {
        self.camera.validate()?;
        let size = self.size();
        expect_map(self.silhouette, size, "silhouette")?;
        expect_finite(self.silhouette, "silhouette")?;
        match self.depth {
            DepthSource::Rendered(depth) => {
                expect_map(depth, size, "rendered depth")?;
                expect_finite(depth, "rendered depth")?;
            }
            DepthSource::Given(map) => expect_map(&map.values, size, "given depth")?,
            DepthSource::Estimated(map) => expect_map(&map.values, size, "estimated depth")?,
        }
        if let Some(mask) = self.mask
            && (mask.width(), mask.height()) != size
        {
            return Err(ConsistencyError::Shape {
                what: "mask",
                expected: format!("{}×{}", size.0, size.1),
                found: format!("{}×{}", mask.width(), mask.height()),
            });
        }
        Ok(())
    }

    /// Centre of the pixel with this index (row · width + column).
    pub(crate) fn centre(&self, pixel: usize) -> Vec2 {
        let width = self.size().0;
        Vec2::new((pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5)
    }

    /// `[eq:rendered-depth]` View-space z at a pixel: Σ w·z over Σ w, or what a map says, in its kind; `None` where it is
    /// not known.
    pub(crate) fn z(&self, pixel: usize) -> Option<f32> {
        let z = match self.depth {
            DepthSource::Rendered(depth) => depth.data()[pixel] / self.silhouette.data()[pixel].max(MIN_OPACITY),
            DepthSource::Given(map) | DepthSource::Estimated(map) => {
                let value = map.values.data()[pixel];
                match map.kind {
                    DepthKind::Z => value,
                    DepthKind::Distance => self.camera.to_z(self.centre(pixel), Depth::Distance(value)),
                }
            }
        };
        (z.is_finite() && z > 0.0).then_some(z)
    }

    /// `[eq:rendered-depth]` Pullback of [`ViewGeometry::z`] where it is known: adds to `grad`.
    pub(crate) fn z_pull(&self, pixel: usize, d_z: f32, grad: &mut ViewGeometryGrad) {
        match self.depth {
            DepthSource::Rendered(depth) => {
                let opacity = self.silhouette.data()[pixel].max(MIN_OPACITY);
                grad.depth.data_mut()[pixel] += d_z / opacity;
                if self.silhouette.data()[pixel] > MIN_OPACITY {
                    grad.silhouette.data_mut()[pixel] -= d_z * (depth.data()[pixel] / opacity) / opacity;
                }
            }
            DepthSource::Given(map) => {
                grad.depth.data_mut()[pixel] += match map.kind {
                    DepthKind::Z => d_z,
                    DepthKind::Distance => d_z / self.camera.pixel_direction(self.centre(pixel)).length(),
                };
            }
            DepthSource::Estimated(_) => {}
        }
    }

    /// What another view's silhouette is compared with at a pixel.
    pub(crate) fn label(&self, pixel: usize) -> f32 {
        self.mask.map_or(self.silhouette.data()[pixel], |mask| mask.data()[pixel])
    }

    pub(crate) fn is_estimated(&self) -> bool {
        matches!(self.depth, DepthSource::Estimated(_))
    }
}
