//! How well a model meets the shape of the object, from held-out views: what its pictures cannot say, since light hides much.
//!
//! - *Silhouette IoU*: rendered coverage above ½ against the photograph's mask above ½.
//! - *Depth error*: mean |rendered z − true z| where both are known, as a share of the object's extent; only where the capture
//!   comes with true geometry (`geometry/test_<view>.exr`). No reconstruction looks at it.
//! - *Cross-view gap*: points that a held-out view shows are looked up in the rendered depth of its two neighbours; mean
//!   difference of depths, as a share of the extent. Points that the neighbour hides do not count, those that it should hide and
//!   does not show do. *Outside*: the share of points that land where the neighbour shows no object. Neighbours are the nearest
//!   cameras of the whole capture, whether or not their photographs were learned from, so that regimes can be compared.
//!
//! The extent is the diagonal of the box round all true points that held-out views see; without true geometry, the diameter of
//! the sphere that all cameras of the capture see whole.
use crate::{AtOnce, SssError};
use diamond_camera::{Camera, Depth};
use diamond_consistency::{
    ConsistencyOptions, DepthRange, DepthSource, Disagreement, ViewGeometry, draw_pixels, nearest_views,
};
use diamond_dataset::{Capture, View};
use diamond_image::{Image, Mask};
use diamond_metrics::{MetricError, depth_error, silhouette_iou};
use diamond_reconstruct::{Model, RenderedShape};
use glam::{Vec2, Vec3};
use serde_json::{Map, Value, json};

/// Neighbours that a held-out view is compared with.
const NEIGHBOURS: usize = 2;
/// At most so many pixels of a held-out view are looked up in a neighbour.
const PIXELS: usize = 16384;
/// Coverage above this shows the object.
const SHOWN: f32 = 0.5;

/// The shape as one held-out view sees it.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewShape {
    /// Name of the view.
    pub name: String,
    /// In [0, 1], 1 is best; `None` without a mask.
    pub silhouette_iou: Option<f64>,
    /// Mean over the pixels where both are known, scene units; `None` without true geometry or where nothing is rendered on it.
    pub depth_error: Option<f64>,
    /// What its neighbours say, lengths in scene units.
    pub cross_view: Disagreement,
}

/// The shape as all held-out views see it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ShapeScores {
    /// By view.
    pub views: Vec<ViewShape>,
    /// What lengths are shares of, scene units.
    pub extent: f64,
    /// Whether `extent` comes from true geometry.
    pub extent_is_true: bool,
}

/// Keys of [`ShapeScores::means`], which are those of `metrics.json`.
pub const SHAPE_METRICS: [&str; 4] = ["silhouette_iou", "depth_error", "cross_view_gap", "cross_view_outside"];

impl ViewShape {
    fn figures(&self, extent: f64) -> [Option<f64>; 4] {
        [
            self.silhouette_iou,
            self.depth_error.map(|e| e / extent),
            self.cross_view.mean_gap().map(|e| e / extent),
            self.cross_view.outside_share(),
        ]
    }
}

impl ShapeScores {
    /// Mean and standard deviation over views of each of [`SHAPE_METRICS`]; `None` where no view has it.
    pub fn means(&self) -> [Option<(f64, f64)>; 4] {
        let mut out = [None; 4];
        for (k, out) in out.iter_mut().enumerate() {
            let all: Vec<f64> = self.views.iter().filter_map(|v| v.figures(self.extent)[k]).collect();
            let n = all.len() as f64;
            let mean = all.iter().sum::<f64>() / n;
            *out = (!all.is_empty()).then(|| (mean, (all.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt()));
        }
        out
    }

    fn reason(&self, k: usize) -> &'static str {
        match k {
            _ if self.views.is_empty() => "the capture has no held-out views",
            0 => "no held-out view has a mask that covers anything",
            1 if !self.extent_is_true => {
                "the capture has no true geometry of held-out views (geometry/test_<view>.exr)"
            }
            1 => "nothing is rendered where the true geometry is",
            _ => "no point of a held-out view lands in a neighbour",
        }
    }

    /// The part `geometry` of `metrics.json`; reasons for what is null go to `absent`.
    pub fn to_json(&self, absent: &mut Map<String, Value>) -> Value {
        let mut out = Map::new();
        for (k, (name, found)) in SHAPE_METRICS.iter().zip(self.means()).enumerate() {
            out.insert((*name).into(), found.map(|f| f.0).into());
            out.insert(format!("{name}_std"), found.map(|f| f.1).into());
            if found.is_none() {
                absent.insert(format!("geometry.{name}"), self.reason(k).into());
            }
        }
        out.insert("extent".into(), self.extent.into());
        out.insert("extent_of".into(), if self.extent_is_true { "true geometry" } else { "cameras" }.into());
        let view = |v: &ViewShape| {
            let mut row = json!({ "name": v.name });
            for (name, figure) in SHAPE_METRICS.iter().zip(v.figures(self.extent)) {
                row[*name] = figure.into();
            }
            row
        };
        out.insert("per_view".into(), self.views.iter().map(view).collect::<Vec<_>>().into());
        out.into()
    }

    /// A line for the terminal and the report.
    pub fn sentence(&self) -> String {
        let show = |k: usize, unit: f64, digits: usize, after: &str| {
            self.means()[k].map_or("–".to_owned(), |(mean, _)| format!("{:.digits$}{after}", mean * unit))
        };
        format!(
            "silhouette IoU {}, depth error {} and cross-view gap {} of the object's extent, {} outside a neighbour's silhouette",
            show(0, 1.0, 4, ""),
            show(1, 100.0, 2, " %"),
            show(2, 100.0, 2, " %"),
            show(3, 100.0, 2, " %")
        )
    }
}

/// Measures the shape of `model` on the held-out views of `capture`; `whole` is the capture that this is a selection of.
pub fn shape_scores(
    model: &Model,
    at_once: &AtOnce,
    capture: &Capture,
    whole: &Capture,
) -> Result<ShapeScores, SssError> {
    let renderer = at_once.renderer(model);
    measure(capture, whole, &mut |camera| Ok(renderer.shape(camera)?))
}

fn measure(
    capture: &Capture,
    whole: &Capture,
    shape: &mut dyn FnMut(&Camera) -> Result<RenderedShape, SssError>,
) -> Result<ShapeScores, SssError> {
    let scene = whole.scene();
    let mut scores = ShapeScores { extent: 2.0 * f64::from(scene.framed_radius), ..ShapeScores::default() };
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for view in &capture.test {
        let seen = shape(&view.camera)?;
        let mut found = ViewShape {
            name: view.name.clone(),
            silhouette_iou: overlap(capture, view, &seen)?,
            depth_error: None,
            cross_view: Disagreement::default(),
        };
        if let Some(truth) = view.ground_truth_geometry()? {
            found.depth_error = defined(depth_error(&z_of(&seen), &truth.depth))?;
            for point in points(&view.camera, &truth.depth) {
                (low, high) = (low.min(point), high.max(point));
            }
        }
        let mut cameras = vec![view.camera];
        let others = whole.train.iter().chain(&whole.test).map(|v| v.camera);
        cameras.extend(others.filter(|c| c.pose != view.camera.pose));
        for &near in nearest_views(&cameras, scene.centre, NEIGHBOURS).first().into_iter().flatten() {
            found.cross_view.add(&compare([&view.camera, &cameras[near]], [&seen, &shape(&cameras[near])?])?);
        }
        scores.views.push(found);
    }
    let extent = f64::from((high - low).length());
    if extent.is_finite() && extent > 0.0 {
        (scores.extent, scores.extent_is_true) = (extent, true);
    }
    Ok(scores)
}

/// A measure that is undefined here is absent; any other error is one.
fn defined(value: Result<f64, MetricError>) -> Result<Option<f64>, SssError> {
    match value {
        Ok(value) => Ok(Some(value)),
        Err(MetricError::EmptyMask { .. }) => Ok(None),
        Err(e) => Err(e.into()),
    }
}

/// Overlap with the mask of the first photograph that has one.
fn overlap(capture: &Capture, view: &View, seen: &RenderedShape) -> Result<Option<f64>, SssError> {
    for shot in &view.shots {
        if let Some(mask) = &capture.observation(shot)?.mask {
            let internal = |e: diamond_image::ImageError| SssError::Internal(e.to_string());
            return defined(silhouette_iou(&Mask::from_channel(&seen.opacity, 0).map_err(internal)?, mask));
        }
    }
    Ok(None)
}

/// Rendered view-space z where the object is shown, 0 elsewhere.
fn z_of(seen: &RenderedShape) -> Image {
    let mut z = seen.depth.clone();
    for (z, opacity) in z.data_mut().iter_mut().zip(seen.opacity.data()) {
        *z = if *opacity > SHOWN { *z / *opacity } else { 0.0 };
    }
    z
}

/// World points of a depth map.
fn points<'a>(camera: &'a Camera, z: &'a Image) -> impl Iterator<Item = Vec3> + 'a {
    z.data().iter().enumerate().filter(|(_, z)| **z > 0.0).map(|(i, z)| {
        let pixel =
            Vec2::new((i % camera.intrinsics.width as usize) as f32, (i / camera.intrinsics.width as usize) as f32);
        camera.unproject(pixel + 0.5, Depth::Z(*z))
    })
}

fn compare(cameras: [&Camera; 2], seen: [&RenderedShape; 2]) -> Result<Disagreement, SssError> {
    let [from, to] = [0, 1].map(|k| ViewGeometry {
        camera: cameras[k],
        silhouette: &seen[k].opacity,
        depth: DepthSource::Rendered(&seen[k].depth),
        mask: None,
    });
    // The range only scales a loss, which is not read; nothing is nearer than 0.
    let options =
        ConsistencyOptions { min_silhouette: SHOWN, ..ConsistencyOptions::new(DepthRange { near: 0.0, far: 1.0 }) };
    let pixels = draw_pixels(&from, &options, PIXELS, 0);
    Disagreement::of(&from, &to, &pixels, &options).map_err(|e| SssError::Internal(e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_dataset::OpenOptions;

    fn candle() -> Capture {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/candle-small");
        Capture::open(folder.as_ref(), &OpenOptions::default()).unwrap()
    }

    /// What a capture's own masks and geometry show of it, moved by `shift` pixels to the right and `away` scene units from the
    /// camera.
    fn truth(capture: &Capture, camera: &Camera, shift: usize, away: f32) -> RenderedShape {
        let view = capture.train.iter().chain(&capture.test).find(|v| v.camera == *camera).unwrap();
        let mask = capture.observation(&view.shots[0]).unwrap().mask.clone().unwrap();
        let z = view.ground_truth_geometry().unwrap().unwrap().depth;
        let (w, h) = (mask.width(), mask.height());
        let (mut opacity, mut depth) = (Image::new(w, h, 1), Image::new(w, h, 1));
        for i in 0..w * h {
            if i % w >= shift && mask.data()[i - shift] > SHOWN && z.data()[i - shift] > 0.0 {
                opacity.data_mut()[i] = 0.9;
                depth.data_mut()[i] = 0.9 * (z.data()[i - shift] + away);
            }
        }
        RenderedShape { opacity, depth }
    }

    fn figures(capture: &Capture, shift: usize, away: f32) -> ShapeScores {
        measure(capture, capture, &mut |camera| Ok(truth(capture, camera, shift, away))).unwrap()
    }

    /// The true shape is met: nothing but what lies between pixels remains. A shift costs, and more the larger it is.
    #[test]
    fn exact_on_exact_geometry_and_worse_with_a_shift() {
        let capture = candle();
        let exact = figures(&capture, 0, 0.0);
        let [iou, depth, gap, outside] = exact.means().map(|f| f.unwrap().0);
        println!("extent {}: {}", exact.extent, exact.sentence());
        assert!(iou == 1.0 && depth < 1e-6, "{exact:?}");
        // What is left at 64 pixels a side: interpolation over edges, and points within a pixel of an outline.
        assert!(gap < 0.004 && outside < 0.07, "{exact:?}");
        assert!(exact.extent_is_true && exact.views.len() == 2);
        let aside: Vec<[f64; 4]> =
            (0..5).map(|k| figures(&capture, 2 * k, 0.0).means().map(|f| f.unwrap().0)).collect();
        assert!(aside.windows(2).all(|w| w[1][0] < w[0][0] && w[1][1] > w[0][1]), "{aside:?}");
        let away: Vec<[f64; 4]> =
            (0..5).map(|k| figures(&capture, 0, 0.03 * k as f32).means().map(|f| f.unwrap().0)).collect();
        assert!(away.windows(2).all(|w| w[1][0] == w[0][0] && w[1][1] > w[0][1] && w[1][2] > w[0][2]), "{away:?}");
        assert!((away[4][1] - 0.12 / exact.extent).abs() < 1e-6, "{away:?}");
    }

    #[test]
    fn nothing_rendered_is_absent_with_a_reason() {
        let capture = candle();
        let empty = |camera: &Camera| {
            let k = &camera.intrinsics;
            let nothing = Image::new(k.width as usize, k.height as usize, 1);
            Ok(RenderedShape { opacity: nothing.clone(), depth: nothing })
        };
        let scores = measure(&capture, &capture, &mut { empty }).unwrap();
        let mut absent = Map::new();
        let json = scores.to_json(&mut absent);
        assert_eq!(json["silhouette_iou"], 0.0);
        for name in &SHAPE_METRICS[1..] {
            assert!(json[*name].is_null() && absent[&format!("geometry.{name}")].is_string(), "{name}: {json}");
        }
        assert!(absent["geometry.depth_error"].as_str().unwrap().contains("nothing is rendered"));
        let mut bare = candle();
        bare.test.clear();
        let none = measure(&bare, &bare, &mut { empty }).unwrap();
        assert!(none.to_json(&mut absent)["silhouette_iou"].is_null() && !none.extent_is_true);
    }
}
