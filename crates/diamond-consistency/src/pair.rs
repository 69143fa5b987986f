//! Two views' agreement about silhouette and depth, and its gradient.
use crate::reproject::{correspond, z_at_pull};
use crate::{ConsistencyError, ConsistencyOptions, Correspondence, DepthKind, Detach, ViewGeometry, ViewGeometryGrad};
use diamond_camera::Depth;
use glam::Vec2;

/// Values of the two terms of a pair of views.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PairValue {
    /// Mean cost of the silhouettes' difference; 0 where nothing could be compared.
    pub silhouette: f32,
    /// Mean difference of depths over far − near; 0 where nothing could be compared.
    pub depth: f32,
    /// Pixels that the first is a mean over.
    pub silhouette_count: usize,
    /// Pixels that the second is a mean over.
    pub depth_count: usize,
}

/// Cotangent of [`PairValue`]: the weights of the two terms.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PairValueGrad {
    /// Of the silhouette term.
    pub silhouette: f32,
    /// Of the depth term.
    pub depth: f32,
}

/// Gradient with respect to both views.
#[derive(Debug, Clone, PartialEq)]
pub struct PairGrad {
    /// The view that points are taken from.
    pub from: ViewGeometryGrad,
    /// The view that they are looked up in.
    pub to: ViewGeometryGrad,
}

/// The reverse of one [`pair_consistency`] call.
#[derive(Debug)]
pub struct PairPullback<'a> {
    from: ViewGeometry<'a>,
    to: ViewGeometry<'a>,
    options: ConsistencyOptions,
    value: PairValue,
    correspondences: Vec<Correspondence>,
}

/// Single derivatives beyond this are cut: a point next to a camera's plane moves faster than any step should follow, and
/// sums of them must stay finite.
const MAX_DERIVATIVE: f32 = 1e20;

fn bounded(v: f32) -> f32 {
    if v.is_nan() { 0.0 } else { v.clamp(-MAX_DERIVATIVE, MAX_DERIVATIVE) }
}

/// Takes the points that `pixels` of the first view show (indices row · width + column; repetitions count twice) to the
/// second and compares what that one says: `[eq:silhouette-consistency]` the mean cost of S_i(x) against S_j(x') over all
/// points that land inside the picture before the camera, and `[eq:depth-consistency]` the mean of |ẑ − D_j(x')| over
/// far − near over those that both views show, ẑ the depth of the point in the second view.
///
/// A term without any valid correspondence is 0 and has no gradient. Which pixels count is decided without gradient.
/// Everything runs in the order of `pixels` on one thread: the bits do not depend on how many there are.
///
/// # Errors
/// Maps of another size than their camera's, unusable cameras or settings, NaN or infinity in silhouettes or rendered
/// depth, pixels beyond the picture, and two estimated depths.
pub fn pair_consistency<'a>(
    from: &ViewGeometry<'a>,
    to: &ViewGeometry<'a>,
    pixels: &[u32],
    options: &ConsistencyOptions,
) -> Result<(PairValue, PairPullback<'a>), ConsistencyError> {
    options.validate()?;
    from.validate()?;
    to.validate()?;
    if from.is_estimated() && to.is_estimated() {
        return Err(ConsistencyError::BothEstimated);
    }
    let (width, height) = from.size();
    if let Some(pixel) = pixels.iter().find(|p| **p as usize >= width * height) {
        let expected = format!("indices below {}", width * height);
        return Err(ConsistencyError::Shape { what: "pixels", expected, found: pixel.to_string() });
    }
    let (mut value, mut sums) = (PairValue::default(), [0.0f64; 2]);
    let scale = 1.0 / f64::from(options.range.far - options.range.near);
    let mut correspondences = Vec::with_capacity(pixels.len());
    for &pixel in pixels {
        let mut c = correspond(from, to, pixel, options);
        if c.fate.has_silhouette() {
            let cost = options.penalty.value(from.label(pixel as usize), c.silhouette);
            c.silhouette_cost = cost as f32;
            sums[0] += cost;
            value.silhouette_count += 1;
        }
        if c.fate.has_depth() {
            let difference = f64::from((c.z - c.surface_z).abs()) * f64::from(per_z(to, c.at, options).0);
            c.depth_cost = (difference * scale) as f32;
            sums[1] += difference * scale;
            value.depth_count += 1;
        }
        correspondences.push(c);
    }
    value.silhouette = (sums[0] / value.silhouette_count.max(1) as f64) as f32;
    value.depth = (sums[1] / value.depth_count.max(1) as f64) as f32;
    Ok((value, PairPullback { from: *from, to: *to, options: *options, value, correspondences }))
}

/// Depth in the kind of the comparison per unit of view-space z at a place of the second view, and its derivative there.
fn per_z(to: &ViewGeometry<'_>, at: Vec2, options: &ConsistencyOptions) -> (f32, Vec2) {
    match options.depth_kind {
        DepthKind::Z => (1.0, Vec2::ZERO),
        DepthKind::Distance => {
            let q = to.camera.pixel_direction(at);
            let (length, k) = (q.length(), &to.camera.intrinsics);
            (length, Vec2::new(q.x / k.fx, q.y / k.fy) / length)
        }
    }
}

impl PairPullback<'_> {
    /// What became of each pixel, in the order in which they were given.
    pub fn correspondences(&self) -> &[Correspondence] {
        &self.correspondences
    }

    /// The gradient of `d.silhouette`·silhouette + `d.depth`·depth with respect to all four maps: through the values that
    /// are compared, through the place where the second view is sampled, and through the point to the first view's depth.
    pub fn pull(&self, d: &PairValueGrad) -> PairGrad {
        let (from, to, options) = (&self.from, &self.to, &self.options);
        let zeros = |view: &ViewGeometry<'_>| ViewGeometryGrad::zeros(view.size().0, view.size().1);
        let mut grad = PairGrad { from: zeros(from), to: zeros(to) };
        let (of_from, of_to) = (options.detach != Detach::Source, options.detach != Detach::Target);
        let share = |weight: f32, count: usize| f64::from(weight) / count.max(1) as f64;
        let d_silhouette = share(d.silhouette, self.value.silhouette_count);
        let d_depth = share(d.depth, self.value.depth_count) / f64::from(options.range.far - options.range.near);
        for c in self.correspondences.iter().filter(|c| c.fate.has_silhouette()) {
            let pixel = c.pixel as usize;
            let Some(taps) = to.silhouette.bilinear_taps(c.at.x, c.at.y) else { continue };
            let (mut d_at, mut d_z) = (Vec2::ZERO, 0.0);
            if d.silhouette != 0.0 {
                let (d_label, d_found) = options.penalty.pull(from.label(pixel), c.silhouette);
                let d_found = bounded((d_found * d_silhouette) as f32);
                for tap in &taps {
                    let silhouette = to.silhouette.data()[tap.index];
                    d_at += d_found * silhouette * Vec2::new(tap.d_x, tap.d_y);
                    if of_to {
                        grad.to.silhouette.data_mut()[tap.index] += d_found * tap.weight;
                    }
                }
                if of_from && options.label_gradient && from.mask.is_none() {
                    grad.from.silhouette.data_mut()[pixel] += bounded((d_label * d_silhouette) as f32);
                }
            }
            if c.fate.has_depth() && d.depth != 0.0 && c.z != c.surface_z {
                let (factor, d_factor) = per_z(to, c.at, options);
                let step = d_depth as f32;
                let sign = if c.z > c.surface_z { step } else { -step };
                d_z = sign * factor;
                d_at += sign * (c.z - c.surface_z) * d_factor;
                let to_grad = of_to.then_some(&mut grad.to);
                d_at += z_at_pull(to, &taps, options, c.surface_z, -d_z, to_grad);
            }
            let Some(z) = from.z(pixel).filter(|_| of_from) else { continue };
            let d_world = to.camera.project_pull(c.world, d_at, d_z);
            let (_, d_from) = from.camera.unproject_pull(from.centre(pixel), Depth::Z(z), d_world);
            from.z_pull(pixel, bounded(d_from), &mut grad.from);
        }
        for map in [&mut grad.from, &mut grad.to].into_iter().flat_map(|g| [&mut g.silhouette, &mut g.depth]) {
            map.data_mut().iter_mut().for_each(|v| *v = bounded(*v));
        }
        grad
    }
}
