//! Held-out images side by side: the photograph, what each method renders there, and where they differ.
use super::page::escape;
use super::{Cell, Figures, Grid};
use base64::Engine as _;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;

/// Images of an object and regime.
const SHOWN: usize = 2;
/// Larger pictures are made smaller for the page: a grid has hundreds.
const WIDTH: u32 = 160;

/// Names of the images whose three pictures a run has left in `images/`; empty where it left none.
fn names_in(folder: &Path) -> BTreeSet<String> {
    let files = std::fs::read_dir(folder.join("images")).into_iter().flatten().flatten();
    let names = files.filter_map(|f| f.file_name().to_str()?.strip_suffix("_truth.png").map(str::to_owned));
    names.filter(|n| ["render", "flip"].iter().all(|kind| path(folder, n, kind).is_file())).collect()
}

fn path(folder: &Path, name: &str, kind: &str) -> std::path::PathBuf {
    folder.join("images").join(format!("{name}_{kind}.png"))
}

/// An `<img>` that holds the picture itself, or a note that it cannot be read.
fn embedded(path: &Path, alt: &str) -> String {
    let small = || -> Option<Vec<u8>> {
        let bytes = std::fs::read(path).ok()?;
        let picture = image::load_from_memory_with_format(&bytes, image::ImageFormat::Png).ok()?;
        if picture.width() <= WIDTH {
            return Some(bytes);
        }
        let height = (u64::from(picture.height()) * u64::from(WIDTH) / u64::from(picture.width())).max(1) as u32;
        let mut out = std::io::Cursor::new(Vec::new());
        image::imageops::resize(&picture.to_rgb8(), WIDTH, height, image::imageops::FilterType::Triangle)
            .write_to(&mut out, image::ImageFormat::Png)
            .ok()?;
        Some(out.into_inner())
    };
    match small() {
        Some(png) => format!(
            "<img alt=\"{}\" width=\"{WIDTH}\" src=\"data:image/png;base64,{}\">",
            escape(alt),
            base64::engine::general_purpose::STANDARD.encode(png)
        ),
        None => "<span class=\"quiet\">not readable</span>".into(),
    }
}

/// PSNR of an image of a run, from its `metrics.json`.
fn psnr(folder: &Path, name: &str) -> Option<f64> {
    let metrics: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(folder.join("metrics.json")).ok()?).ok()?;
    let images = metrics["per_image"].as_array()?;
    images.iter().find(|i| i["name"] == name)?["psnr"].as_f64()
}

impl Grid {
    /// For each object and regime, some held-out images that all methods' runs of the first seed that is done have left: a column
    /// per method, its render above the FLIP map. Empty where there are none.
    pub(super) fn pictures(&self, done: &[(Cell, Figures)]) -> String {
        let mut out = String::new();
        for (object, _) in &self.objects {
            for regime in &self.regimes {
                // The first seed of each method that has run.
                let folders: Vec<(&str, u64, &Path)> = (self.methods.iter())
                    .filter_map(|(method, _)| {
                        let names = [object, regime, method];
                        let of = |c: &Cell| c.names.iter().zip(names).all(|(a, b)| a == b);
                        let (cell, _) = done.iter().find(|(c, _)| of(c))?;
                        Some((method.as_str(), cell.seed, cell.folder.as_path()))
                    })
                    .collect();
                let common = folders.iter().map(|(_, _, f)| names_in(f)).reduce(|a, b| &a & &b).unwrap_or_default();
                let common: Vec<&String> = common.iter().collect();
                let shown = SHOWN.min(common.len());
                for k in 0..shown {
                    // In the middle of equal parts of the list.
                    let name = common[(2 * k + 1) * common.len() / (2 * shown)];
                    let _ = write!(
                        out,
                        "<h3>{}, {}: {}</h3><div class=\"wide pictures\"><figure>{}<figcaption>photograph</figcaption></figure>",
                        escape(object),
                        escape(regime),
                        escape(name),
                        embedded(&path(folders[0].2, name, "truth"), "photograph")
                    );
                    for (method, seed, folder) in &folders {
                        let db = psnr(folder, name).map_or(String::new(), |v| format!(": {v:.2} dB"));
                        let _ = write!(
                            out,
                            "<figure>{}{}<figcaption>{}, seed {seed}{db}</figcaption></figure>",
                            embedded(&path(folder, name, "render"), &format!("render, {method}")),
                            embedded(&path(folder, name, "flip"), &format!("FLIP, {method}")),
                            escape(method)
                        );
                    }
                    out += "</div>";
                }
            }
        }
        match out.is_empty() {
            true => out,
            false => format!(
                "<h2>Side by side</h2><p class=\"quiet\">Held-out images; below each render its FLIP error, black for none and pale yellow \
                 for 1.</p>{out}"
            ),
        }
    }
}
