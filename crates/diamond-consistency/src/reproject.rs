//! From a pixel of one view over the point that it shows to a place in another view, and what becomes of it there.
use crate::{ConsistencyOptions, DepthSampling, ViewGeometry, ViewGeometryGrad};
use diamond_camera::Depth;
use diamond_image::Tap;
use glam::{Vec2, Vec3};

/// What became of a pixel of the first view in the second.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Fate {
    /// The first view shows no object there, by its silhouette or its mask.
    Empty,
    /// The first view does not know how far it is.
    NoDepth,
    /// The point is behind the second camera, or nearer to it than the scene begins.
    Behind,
    /// The point lands outside the second picture, or in the half pixel beyond the outermost pixel centres, where nothing can
    /// be interpolated.
    Outside,
    /// The point lands where the second view shows no object, or does not know how far it is: the silhouette term counts
    /// it, the depth term does not.
    Hollow,
    /// The second view shows something nearer there, or something much farther. The silhouette term counts it: a hidden
    /// point lands inside the silhouette as well.
    Hidden,
    /// The depths agree, but the first view's surface faces away from the second camera, which therefore shows another one; or the first
    /// view does not say how the surface lies. As if it were hidden.
    Averted,
    /// Both views show the point.
    Seen,
}

impl Fate {
    /// Whether the silhouette term counts it.
    pub fn has_silhouette(self) -> bool {
        matches!(self, Self::Hollow | Self::Hidden | Self::Averted | Self::Seen)
    }

    /// Whether the depth term counts it.
    pub fn has_depth(self) -> bool {
        self == Self::Seen
    }
}

/// A pixel of the first view and what the second view says about the point that it shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correspondence {
    /// Index of the pixel in the first view (row · width + column).
    pub pixel: u32,
    /// What became of it; what follows is 0 where it did not get so far.
    pub fate: Fate,
    /// Where the point lands in the second view, pixels.
    pub at: Vec2,
    /// The point, world.
    pub world: Vec3,
    /// Its view-space z in the second view.
    pub z: f32,
    /// The second view's silhouette there.
    pub silhouette: f32,
    /// The second view's depth there, as view-space z.
    pub surface_z: f32,
    /// Cost of the silhouettes' difference, before averaging.
    pub silhouette_cost: f32,
    /// Cost of the depths' difference, before averaging, in units of far − near.
    pub depth_cost: f32,
}

/// A point is inside a picture between the outermost pixel centres, where four pixels surround it, and this much beyond
/// them, pixels: rounding must not lose the border where two cameras are the same.
const BORDER: f32 = 1e-3;

/// The second view's silhouette at four pixels around a place.
pub(crate) fn silhouette_at(view: &ViewGeometry<'_>, taps: &[Tap; 4]) -> f32 {
    taps.iter().map(|t| t.weight * view.silhouette.data()[t.index]).sum()
}

/// `[eq:depth-sampling]` The second view's view-space z between four pixels: 1/Σ(w/z), or Σ w·z. `None` where a pixel with
/// a weight shows no object or is of unknown depth.
pub(crate) fn z_at(view: &ViewGeometry<'_>, taps: &[Tap; 4], options: &ConsistencyOptions) -> Option<f32> {
    let mut sum = 0.0;
    for tap in taps.iter().filter(|t| t.weight > 0.0) {
        if view.silhouette.data()[tap.index] <= options.min_silhouette {
            return None;
        }
        let z = view.z(tap.index)?;
        sum += match options.sampling {
            DepthSampling::Inverse => tap.weight / z,
            DepthSampling::Linear => tap.weight * z,
        };
    }
    let z = match options.sampling {
        DepthSampling::Inverse => 1.0 / sum,
        DepthSampling::Linear => sum,
    };
    (z.is_finite() && z > 0.0).then_some(z)
}

/// `[eq:depth-sampling]` Pullback of [`z_at`] where it is known, whose value was `z`: adds to `grad` where there is one, and
/// returns the cotangent of the place.
pub(crate) fn z_at_pull(
    view: &ViewGeometry<'_>,
    taps: &[Tap; 4],
    options: &ConsistencyOptions,
    z: f32,
    d_z: f32,
    grad: Option<&mut ViewGeometryGrad>,
) -> Vec2 {
    let known = |tap: &Tap| view.silhouette.data()[tap.index] > options.min_silhouette;
    let mut d_at = Vec2::ZERO;
    // Pixels without a weight still say in which direction depth grows, where they know it.
    for tap in taps.iter().filter(|t| known(t)) {
        let Some(tap_z) = view.z(tap.index) else { continue };
        let factor = match options.sampling {
            // A difference to the value itself: the weights' derivatives add up to 0, so that a pixel which is left out
            // counts as if it continued the others.
            DepthSampling::Inverse => -z * z * (1.0 / tap_z - 1.0 / z),
            DepthSampling::Linear => tap_z - z,
        };
        d_at += d_z * factor * Vec2::new(tap.d_x, tap.d_y);
    }
    if let Some(grad) = grad {
        for tap in taps.iter().filter(|t| t.weight > 0.0) {
            let Some(tap_z) = view.z(tap.index) else { continue };
            let slope = match options.sampling {
                DepthSampling::Inverse => (z / tap_z) * (z / tap_z),
                DepthSampling::Linear => 1.0,
            };
            view.z_pull(tap.index, d_z * tap.weight * slope, grad);
        }
    }
    d_at
}

/// `[eq:reprojection]` x → X = π_i⁻¹(x, D_i(x)) → x' = π_j(X), and `[eq:visibility-filter]` what becomes of it.
pub(crate) fn correspond(
    from: &ViewGeometry<'_>,
    to: &ViewGeometry<'_>,
    pixel: u32,
    options: &ConsistencyOptions,
) -> Correspondence {
    let index = pixel as usize;
    let mut c = Correspondence {
        pixel,
        fate: Fate::Empty,
        at: Vec2::ZERO,
        world: Vec3::ZERO,
        z: 0.0,
        silhouette: 0.0,
        surface_z: 0.0,
        silhouette_cost: 0.0,
        depth_cost: 0.0,
    };
    let shows = |silhouette: f32| silhouette > options.min_silhouette;
    if !(shows(from.silhouette.data()[index]) && shows(from.label(index))) {
        return c;
    }
    c.fate = Fate::NoDepth;
    let Some(z) = from.z(index) else { return c };
    c.world = from.camera.unproject(from.centre(index), Depth::Z(z));
    c.fate = Fate::Behind;
    let Some((at, z)) = to.camera.project(c.world).filter(|(_, z)| *z > options.range.near) else { return c };
    (c.at, c.z) = (at, z);
    c.fate = Fate::Outside;
    let (width, height) = to.size();
    let within = |v: f32, n: usize| v >= 0.5 - BORDER && v <= n as f32 - 0.5 + BORDER;
    let inside = within(at.x, width) && within(at.y, height);
    let Some(taps) = to.silhouette.bilinear_taps(at.x, at.y).filter(|_| inside) else { return c };
    c.silhouette = silhouette_at(to, &taps);
    c.fate = Fate::Hollow;
    let Some(surface_z) = z_at(to, &taps, options).filter(|_| shows(c.silhouette)) else { return c };
    c.surface_z = surface_z;
    let gap = (z - surface_z).abs() / z;
    c.fate = if gap >= options.max_gap {
        Fate::Hidden
    } else if options.min_facing > -1.0
        && !facing(from, index, to.camera.pose.centre(), options).is_some_and(|cosine| cosine > options.min_facing)
    {
        Fate::Averted
    } else {
        Fate::Seen
    };
    c
}

/// Cosine between the normal of the surface at a pixel, by the depths of the pixels beside it, and the direction to a place in the world. `None` where
/// there is no pixel that shows the object on either side of it in a row or a column.
fn facing(view: &ViewGeometry<'_>, pixel: usize, place: Vec3, options: &ConsistencyOptions) -> Option<f32> {
    let (width, height) = view.size();
    let (x, y) = (pixel % width, pixel / width);
    let point = |pixel: usize| {
        let shown = view.silhouette.data()[pixel] > options.min_silhouette;
        view.z(pixel).filter(|_| shown).map(|z| view.camera.unproject(view.centre(pixel), Depth::Z(z)))
    };
    let here = point(pixel)?;
    // From the pixel before to the pixel behind, or to or from this one at an edge.
    let along = |at: usize, last: usize, step: usize| {
        let before = (at > 0).then(|| point(pixel - step)).flatten();
        let behind = (at < last).then(|| point(pixel + step)).flatten();
        (before.is_some() || behind.is_some()).then(|| behind.unwrap_or(here) - before.unwrap_or(here))
    };
    let normal = along(x, width - 1, 1)?.cross(along(y, height - 1, width)?).try_normalize()?;
    // Toward the camera that sees it.
    let normal = if normal.dot(view.camera.pose.centre() - here) < 0.0 { -normal } else { normal };
    Some(normal.dot((place - here).try_normalize()?))
}
