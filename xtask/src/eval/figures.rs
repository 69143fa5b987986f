//! What is read of a run that is done, and how it is written.
use super::Cell;
use sha2::{Digest, Sha256};
use std::path::Path;

/// Which way a measure is good.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Better {
    /// Large values are.
    More,
    /// Small values are.
    Less,
}

/// One of the figures of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measure {
    /// Its column in `eval.csv`.
    pub key: &'static str,
    /// Its column in tables.
    pub title: &'static str,
    /// Where it is in `metrics.json`.
    pub pointer: &'static str,
    /// Factor of tables (not of the CSV).
    pub scale: f64,
    /// Digits after the point in tables.
    pub digits: usize,
    /// Which way it is good.
    pub better: Better,
}

const fn measure(
    key: &'static str,
    title: &'static str,
    pointer: &'static str,
    scale: f64,
    digits: usize,
    better: Better,
) -> Measure {
    Measure { key, title, pointer, scale, digits, better }
}

/// Everything that is read; the first is what rows are compared by.
pub const MEASURES: [Measure; 15] = [
    measure("psnr", "PSNR dB", "/psnr", 1.0, 2, Better::More),
    measure("ssim", "SSIM", "/ssim", 1.0, 4, Better::More),
    measure("flip", "FLIP", "/flip", 1.0, 4, Better::Less),
    measure("lpips_vgg", "LPIPS VGG", "/lpips_vgg", 1.0, 4, Better::Less),
    measure("lpips_alex", "LPIPS Alex", "/lpips_alex", 1.0, 4, Better::Less),
    measure("psnr_masked", "PSNR in mask", "/masked/psnr", 1.0, 2, Better::More),
    measure("ssim_masked", "SSIM in mask", "/masked/ssim", 1.0, 4, Better::More),
    measure("psnr_seen", "PSNR seen lights", "/seen_lights/psnr", 1.0, 2, Better::More),
    measure("psnr_unseen", "PSNR unseen lights", "/unseen_lights/psnr", 1.0, 2, Better::More),
    measure("silhouette_iou", "IoU", "/geometry/silhouette_iou", 1.0, 4, Better::More),
    measure("depth_error", "depth error %", "/geometry/depth_error", 100.0, 2, Better::Less),
    measure("cross_view_gap", "gap %", "/geometry/cross_view_gap", 100.0, 2, Better::Less),
    measure("cross_view_outside", "outside %", "/geometry/cross_view_outside", 100.0, 2, Better::Less),
    measure("seconds", "seconds", "/seconds", 1.0, 1, Better::Less),
    measure("gaussians", "Gaussians", "/gaussians", 1.0, 0, Better::Less),
];

/// Place of a measure in [`MEASURES`] and in [`Figures::values`].
pub fn index(key: &str) -> Option<usize> {
    MEASURES.iter().position(|m| m.key == key)
}

/// The figures of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Figures {
    /// As [`MEASURES`]; absent where the run has none.
    pub values: [Option<f64>; MEASURES.len()],
    /// Revision of the program, where the run was started by `cargo xtask eval`.
    pub revision: String,
    /// Hash of the capture.
    pub capture: String,
    /// Hash of `selection.json`: which images were learned from and held out.
    pub selection: String,
}

fn json(path: &Path) -> Option<serde_json::Value> {
    serde_json::from_str(&std::fs::read_to_string(path).ok()?).ok()
}

/// The figures in a folder, if its run is done.
pub fn figures_in(folder: &Path) -> Option<Figures> {
    let metrics = json(&folder.join("metrics.json"))?;
    let text = |value: &serde_json::Value| value.as_str().unwrap_or_default().to_owned();
    let selection = std::fs::read(folder.join("selection.json"))
        .map(|bytes| Sha256::digest(&bytes).iter().map(|b| format!("{b:02x}")).collect())
        .unwrap_or_default();
    Some(Figures {
        values: MEASURES.map(|m| metrics.pointer(m.pointer).and_then(serde_json::Value::as_f64)),
        revision: json(&folder.join(CELL_FILE)).map(|cell| text(&cell["revision"])).unwrap_or_default(),
        capture: text(&metrics["capture_hash"]),
        selection,
    })
}

/// What is written into a run's folder before it starts.
pub const CELL_FILE: &str = "cell.json";

/// Every run that is done, as CSV: numbers as `metrics.json` has them, empty where absent.
pub fn csv(done: &[(Cell, Figures)]) -> String {
    let keys: Vec<&str> = MEASURES.iter().map(|m| m.key).collect();
    let mut out = format!("object,regime,method,seed,{},revision,capture_hash,selection_hash\n", keys.join(","));
    for (cell, f) in done {
        let values: Vec<String> = f.values.iter().map(|v| v.map_or(String::new(), |v| v.to_string())).collect();
        let names = cell.names.join(",");
        out += &format!("{names},{},{},{},{},{}\n", cell.seed, values.join(","), f.revision, f.capture, f.selection);
    }
    out
}
