//! The figures of a run: `metrics.json` and `metrics.csv`.
use crate::capture_check::open_capture;
use crate::evaluation::{Compared, evaluate_with};
use crate::output_file::write_json;
use crate::picture::{encode_png_rgb, heat_bytes};
use crate::{HeldOutGain, ImageScore, PSNR_CAP, RunRecord, Scored, ShapeScores, SssError, shape_scores, write_output};
use diamond_dataset::{Capture, DatasetError, Selection};
use diamond_reconstruct::Model;
use serde_json::{Map, Value, json};
use std::path::Path;

/// Why there is no LPIPS.
const NO_LPIPS: &str = "LPIPS needs pretrained network weights, which this version does not contain";
/// The metrics that are computed.
const METRICS: [&str; 3] = ["psnr", "ssim", "flip"];

/// Mean and standard deviation over a set of images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Summary {
    /// Number of images.
    pub images: usize,
    /// Means.
    pub mean: Scored,
    /// Standard deviations of the set.
    pub std: Scored,
}

impl Summary {
    /// Of a set of scores; `None` for none.
    pub fn of(scores: impl Iterator<Item = Scored>) -> Option<Self> {
        let scores: Vec<Scored> = scores.collect();
        let n = scores.len() as f64;
        let both = |f: fn(&Scored) -> f64| {
            let mean = scores.iter().map(f).sum::<f64>() / n;
            (mean, (scores.iter().map(|s| (f(s) - mean).powi(2)).sum::<f64>() / n).sqrt())
        };
        let (psnr, ssim, flip) = (both(|s| s.psnr), both(|s| s.ssim), both(|s| s.flip));
        (!scores.is_empty()).then_some(Self {
            images: scores.len(),
            mean: Scored { psnr: psnr.0, ssim: ssim.0, flip: flip.0 },
            std: Scored { psnr: psnr.1, ssim: ssim.1, flip: flip.1 },
        })
    }
}

/// The figures of a run, before they are written.
#[derive(Debug, Clone, PartialEq)]
pub struct Metrics {
    /// Every held-out image.
    pub scores: Vec<ImageScore>,
    /// The shape in every held-out view.
    pub shape: ShapeScores,
    /// Hash of the capture that was evaluated.
    pub capture_hash: String,
    /// Seconds of the run, all sessions.
    pub seconds: Option<f64>,
    /// Peak memory of the run, bytes.
    pub peak_bytes: Option<u64>,
    /// Seed.
    pub seed: u64,
    /// Preset or file.
    pub preset: String,
    /// Steps.
    pub steps: u64,
    /// Gaussians of the model.
    pub gaussians: usize,
    /// Under which gain held-out images were compared.
    pub gain: HeldOutGain,
    /// Hash of the capture that was learned from, where it is known and another.
    pub trained_on: Option<String>,
}

impl Metrics {
    /// Summary of the images that `keep` keeps, over all pixels or inside the masks.
    pub fn summary(&self, masked: bool, keep: impl Fn(&ImageScore) -> bool) -> Option<Summary> {
        Summary::of(self.scores.iter().filter(|s| keep(s)).filter_map(|s| if masked { s.masked } else { Some(s.all) }))
    }

    /// Mean PSNR, dB, of the images that `keep` keeps, each under the gain that fits it best; `None` where that is not
    /// measured.
    pub fn fitted_psnr(&self, keep: impl Fn(&ImageScore) -> bool) -> Option<f64> {
        let all: Vec<f64> = self.scores.iter().filter(|s| keep(s)).filter_map(|s| s.fitted.map(|f| f.psnr)).collect();
        (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64)
    }

    /// Under which gain held-out images were compared, and what a gain of their own would change, in words.
    pub fn gain_sentence(&self) -> String {
        let fitted = self
            .fitted_psnr(|_| true)
            .map_or(String::new(), |psnr| format!("; {psnr:.2} dB with the gain that fits each image best"));
        format!("{}{fitted}", self.gain.sentence())
    }

    fn group(
        &self,
        path: &str,
        keep: &dyn Fn(&ImageScore) -> bool,
        absent: &mut Map<String, Value>,
    ) -> Map<String, Value> {
        let mut out = self.values(path, self.summary(false, keep), self.reason(keep, false), absent);
        let inner = if path.is_empty() { "masked".to_owned() } else { format!("{path}.masked") };
        let masked = self.values(&inner, self.summary(true, keep), self.reason(keep, true), absent);
        out.insert("masked".into(), Value::Object(masked));
        if let Some(psnr) = self.fitted_psnr(keep) {
            out.insert("psnr_fitted_gain".into(), psnr.into());
        }
        out
    }

    fn reason(&self, keep: &dyn Fn(&ImageScore) -> bool, masked: bool) -> &'static str {
        if self.scores.is_empty() {
            "the capture has no held-out images"
        } else if !self.scores.iter().any(keep) {
            "no held-out image is lit so"
        } else if masked {
            "none of these images has a mask that covers anything"
        } else {
            ""
        }
    }

    fn values(
        &self,
        path: &str,
        summary: Option<Summary>,
        reason: &str,
        absent: &mut Map<String, Value>,
    ) -> Map<String, Value> {
        let key = |name: &str| if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") };
        let mut out = Map::new();
        let parts = |s: &Scored| [s.psnr, s.ssim, s.flip];
        for (k, name) in METRICS.iter().enumerate() {
            out.insert((*name).into(), summary.map(|s| parts(&s.mean)[k]).into());
            out.insert(format!("{name}_std"), summary.map(|s| parts(&s.std)[k]).into());
            if summary.is_none() {
                absent.insert(key(name), reason.into());
            }
        }
        for name in ["lpips_vgg", "lpips_alex"] {
            out.insert(name.into(), Value::Null);
            absent.insert(key(name), NO_LPIPS.into());
        }
        out.insert("images".into(), summary.map_or(0, |s| s.images).into());
        out
    }

    /// Width and height of the held-out images if they all agree.
    pub fn resolution(&self) -> Option<(u32, u32)> {
        let first = self.scores.first()?.size;
        self.scores.iter().all(|s| s.size == first).then_some(first)
    }

    /// The content of `metrics.json`. What is absent is null, with the reason under `absent`.
    pub fn to_json(&self) -> Value {
        let mut absent = Map::new();
        let mut out = self.group("", &|_| true, &mut absent);
        out.insert("seen_lights".into(), self.group("seen_lights", &|s| s.seen_light, &mut absent).into());
        out.insert("unseen_lights".into(), self.group("unseen_lights", &|s| !s.seen_light, &mut absent).into());
        out.insert("geometry".into(), self.shape.to_json(&mut absent));
        out.insert("resolution".into(), self.resolution().map(|(w, h)| vec![w, h]).into());
        if self.resolution().is_none() {
            let why = if self.scores.is_empty() { "no held-out images" } else { "sizes differ; see per_image" };
            absent.insert("resolution".into(), why.into());
        }
        out.insert("seconds".into(), self.seconds.into());
        out.insert("peak_bytes".into(), self.peak_bytes.into());
        for (key, known) in [("seconds", self.seconds.is_some()), ("peak_bytes", self.peak_bytes.is_some())] {
            if !known {
                absent.insert(key.into(), "not known for this run or on this system".into());
            }
        }
        out.insert("seed".into(), self.seed.into());
        out.insert("preset".into(), self.preset.clone().into());
        out.insert("steps".into(), self.steps.into());
        out.insert("gaussians".into(), self.gaussians.into());
        out.insert("capture_hash".into(), self.capture_hash.clone().into());
        if let Some(hash) = &self.trained_on {
            out.insert("trained_on_capture_hash".into(), hash.clone().into());
        }
        out.insert("gain".into(), self.gain.name().into());
        if let HeldOutGain::Global(gain) = self.gain {
            out.insert("global_gain".into(), json!(gain));
        }
        out.insert("absent".into(), absent.into());
        out.insert(
            "protocol".into(),
            json!({
                "images": "rendered, sRGB, clamped, 8 bits, over black",
                "psnr": "peak 1, all pixels and channels, mean over images of dB; identical images count as psnr_cap",
                "psnr_cap": PSNR_CAP,
                "ssim": "11x11 Gaussian window, sigma 1.5, zero-padded",
                "flip": "LDR-FLIP, 67 pixels per degree, mean",
                "masked": "pixels whose coverage exceeds 0.5",
                "seen_lights": "lights within half a degree of a training light",
                "gain": "of renderings before comparison: none, global (the learned one), or mean (1, the geometric mean \
                         of the learned gains of views or images)",
                "psnr_fitted_gain": "each image under the gain that fits it best: the weighted median ratio of photograph and rendering",
                "std": "standard deviation over images, or views",
                "geometry": "held-out views; coverage above 0.5 against the mask above 0.5; depth_error and cross_view_gap as shares \
                             of extent: mean |rendered z - true z|, and mean difference of a point's z and the rendered z of two \
                             neighbouring cameras; cross_view_outside: share of points outside the neighbour's silhouette",
            }),
        );
        let part = |s: &Scored| json!({ "psnr": s.psnr, "ssim": s.ssim, "flip": s.flip });
        let rows: Vec<Value> = self
            .scores
            .iter()
            .map(|s| {
                let mut row = part(&s.all);
                row["name"] = s.name.clone().into();
                row["view"] = s.view.into();
                row["seen_light"] = s.seen_light.into();
                row["resolution"] = json!([s.size.0, s.size.1]);
                row["masked"] = s.masked.as_ref().map(part).into();
                if let Some(fitted) = s.fitted {
                    row["fitted_gain"] = json!(fitted.gain);
                    row["psnr_fitted_gain"] = fitted.psnr.into();
                }
                row
            })
            .collect();
        out.insert("per_image".into(), rows.into());
        Value::Object(out)
    }

    /// The content of `metrics.csv`: a row per image.
    pub fn to_csv(&self) -> String {
        let mut out = "name,view,seen_light,psnr,ssim,flip,masked_psnr,masked_ssim,masked_flip\n".to_owned();
        for s in &self.scores {
            let masked = s.masked.map_or(",,".to_owned(), |m| format!("{},{},{}", m.psnr, m.ssim, m.flip));
            out += &format!(
                "{},{},{},{},{},{},{masked}\n",
                s.name, s.view, s.seen_light, s.all.psnr, s.all.ssim, s.all.flip
            );
        }
        out
    }

    /// A table for the terminal.
    pub fn to_table(&self) -> String {
        let mut out = format!("{:<24}{:>7}{:>18}{:>18}{:>18}\n", "", "images", "PSNR dB", "SSIM", "FLIP");
        type Keep = fn(&ImageScore) -> bool;
        let groups: [(&str, Keep); 3] =
            [("all lights", |_| true), ("seen lights", |s| s.seen_light), ("unseen lights", |s| !s.seen_light)];
        for (name, keep) in groups {
            for masked in [false, true] {
                let label = if masked { format!("{name}, masked") } else { name.to_owned() };
                match self.summary(masked, keep) {
                    Some(s) => {
                        let pair = |mean: f64, std: f64, digits: usize| format!("{mean:.digits$} ± {std:.digits$}");
                        out += &format!(
                            "{label:<24}{:>7}{:>18}{:>18}{:>18}\n",
                            s.images,
                            pair(s.mean.psnr, s.std.psnr, 2),
                            pair(s.mean.ssim, s.std.ssim, 4),
                            pair(s.mean.flip, s.std.flip, 4)
                        );
                    }
                    None => out += &format!("{label:<24}      –   {}\n", self.reason(&keep, masked)),
                }
            }
        }
        out += &format!("Shape: {}\n", self.shape.sentence());
        out += &format!("Gain of held-out images: {}\n", self.gain_sentence());
        out
    }

    /// Writes `metrics.json` and `metrics.csv` in the run's folder.
    pub fn write(&self, folder: &Path) -> Result<(), SssError> {
        write_output(&folder.join("metrics.csv"), self.to_csv().as_bytes())?;
        write_json(&folder.join("metrics.json"), &self.to_json())
    }
}

/// The capture with the training selection of a run.
pub(crate) fn select_as(capture: &Capture, record: &RunRecord) -> Result<Capture, DatasetError> {
    capture.select(&record.views.parse::<Selection>()?, &record.lights.parse::<Selection>()?)
}

/// Evaluates the model of the run in `folder` on the held-out images of `capture`, and rewrites `metrics.json` and
/// `metrics.csv`. With `save_images` also writes `images/{name}_{render,truth,flip}.png`.
pub fn evaluate_folder(
    folder: &Path,
    capture: &Path,
    save_images: bool,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Metrics, SssError> {
    let model = Model::load(folder)?;
    let record = RunRecord::read(folder)?;
    let whole = open_capture(capture, &model.config)?;
    let selected = match &record {
        Some(record) => select_as(&whole, record)?,
        None => whole.clone(),
    };
    let scores = evaluate_with(&model, &crate::AtOnce::default(), &selected, |done, all, compared| {
        progress(done, all);
        if save_images { save(folder, &compared) } else { Ok(()) }
    })?;
    let shape = shape_scores(&model, &crate::AtOnce::default(), &selected, &whole)?;
    let capture_hash = whole.hash()?;
    let trained_on = record.as_ref().map(|r| r.capture_hash.clone()).filter(|h| *h != capture_hash);
    let metrics = Metrics {
        scores,
        shape,
        capture_hash,
        seconds: record.as_ref().and_then(|r| r.seconds),
        peak_bytes: record.as_ref().and_then(|r| r.peak_bytes),
        seed: model.config.seed,
        preset: record.map_or(model.config.name.clone(), |r| r.preset),
        steps: model.config.steps,
        gaussians: model.len(),
        gain: HeldOutGain::of(&model),
        trained_on,
    };
    metrics.write(folder)?;
    Ok(metrics)
}

fn save(folder: &Path, compared: &Compared<'_>) -> Result<(), SssError> {
    save_images(folder, &compared.score.name, [compared.render, compared.truth], compared.flip)
}

/// Writes `images/{name}_{render,truth,flip}.png` below `folder`: render and photograph as display bytes, and the map of their FLIP.
pub(crate) fn save_images(
    folder: &Path,
    name: &str,
    [render, truth]: [&[u8]; 2],
    flip: &diamond_image::Image,
) -> Result<(), SssError> {
    let heat = heat_bytes(flip, 1.0);
    for (kind, bytes) in [("render", render), ("truth", truth), ("flip", &heat)] {
        let path = folder.join("images").join(format!("{name}_{kind}.png"));
        write_output(&path, &encode_png_rgb(bytes, flip.width(), flip.height())?)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn metrics(scores: Vec<ImageScore>) -> Metrics {
        Metrics {
            scores,
            shape: ShapeScores::default(),
            capture_hash: "h".into(),
            seconds: Some(1.0),
            peak_bytes: None,
            seed: 3,
            preset: "resolved".into(),
            steps: 10,
            gaussians: 5,
            gain: HeldOutGain::Mean,
            trained_on: None,
        }
    }

    #[test]
    fn what_is_absent_is_null_and_says_why() {
        let one = Scored { psnr: PSNR_CAP, ssim: 1.0, flip: 0.0 };
        let score = ImageScore {
            name: "a".into(),
            view: 0,
            shot: 0,
            size: (8, 4),
            seen_light: true,
            all: one,
            masked: None,
            fitted: Some(crate::FittedGain { gain: [2.0; 3], psnr: 40.0 }),
        };
        let json = metrics(vec![score]).to_json();
        assert_eq!(json["psnr"], 150.0);
        assert_eq!(json["resolution"], json!([8, 4]));
        assert_eq!((&json["gain"], &json["psnr_fitted_gain"]), (&json!("mean"), &json!(40.0)));
        assert_eq!(json["per_image"][0]["fitted_gain"], json!([2.0, 2.0, 2.0]));
        assert_eq!(json["seen_lights"]["ssim"], 1.0);
        for (value, key) in [
            (&json["unseen_lights"]["psnr"], "unseen_lights.psnr"),
            (&json["masked"]["flip"], "masked.flip"),
            (&json["seen_lights"]["masked"]["psnr"], "seen_lights.masked.psnr"),
            (&json["lpips_vgg"], "lpips_vgg"),
            (&json["masked"]["lpips_alex"], "masked.lpips_alex"),
            (&json["peak_bytes"], "peak_bytes"),
        ] {
            assert!(value.is_null(), "{key}");
            assert!(json["absent"][key].is_string(), "{key}");
        }
        let none = metrics(vec![]);
        assert!(none.to_json()["psnr"].is_null());
        assert!(none.to_table().contains("no held-out images"));
    }
}
