//! Search of settings: reconstructions with settings from given ranges, compared on images that are held out of the training images.
//!
//! The capture's own held-out images take no part: neither to learn from nor to choose by. A regime says which training images are learned from.
//! Trials are measured on a share of the training views that it leaves out (`rest`), or of its own images (pairs, views, lights or both), which
//! are then not learned from; which images that are is written to `selection.json`. Each trial
//! is one `diamond reconstruct` in a folder of its own and done when its `metrics.json` is there, so that a search can be interrupted and goes on
//! where it was.
//!
//! ```toml
//! output = "out/tune"          # trials go to OUTPUT/trials/NUMBER
//! capture = "assets/captures/spot-small"
//! regime = "5x5"               # which training images; full-full where absent
//! hold_out = "rest"            # rest, pairs, views, lights or novel
//! share = 0.2                  # of them
//! trials = 24
//! steps = 600
//! seed = 0
//! search = "tpe"               # or random
//! measure = "psnr"             # a column of eval.csv
//! [settings]                   # what differs from the preset `base` (resolved unless it says otherwise) in all trials
//! [range]
//! "loss.depth_consistency" = { from = 0.003, to = 0.3, log = true }
//! "consistency.neighbours" = { from = 1, to = 4 }
//! "consistency.penalty" = { choices = ["bce", "l1"] }
//! ```
//!
//! Results: `tune.svg` (parallel coordinates), `tune.html` (the same with all trials), `tune.csv`, and `best.toml`, a preset with the best settings.
mod plot;
mod search;

use crate::eval::{Better, Figures, MEASURES, figures_in, start, write};
use diamond_dataset::{Capture, HoldOut, OpenOptions, Regime, Selection, SelectionManifest};
pub use plot::{Point, parallel_coordinates};
pub use search::{Span, Strategy, next};
use std::path::{Path, PathBuf};

/// What trials are measured on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Validation {
    /// Training views that the regime leaves out, with all their lights.
    Rest,
    /// Images of the regime, which are not learned from.
    Of(HoldOut),
}

/// What a file of a search says.
#[derive(Debug, Clone, PartialEq)]
pub struct Search {
    /// Folder of trials and results.
    pub output: PathBuf,
    /// The capture.
    pub capture: PathBuf,
    /// Which training images.
    pub regime: Regime,
    /// What trials are measured on.
    pub hold_out: Validation,
    /// How much.
    pub share: f32,
    /// Number of trials.
    pub trials: u64,
    /// Length of each; the configuration's where absent.
    pub steps: Option<u64>,
    /// Seed of the search, the selection and the runs.
    pub seed: u64,
    /// How the next trial is found.
    pub strategy: Strategy,
    /// Place in [`MEASURES`] of what is made best.
    pub measure: usize,
    /// Settings of all trials.
    pub settings: toml::Table,
    /// Names of what is searched, with a point between table and key.
    pub names: Vec<String>,
    /// Ranges, as `names`.
    pub spans: Vec<Span>,
}

const KEYS: [&str; 12] = [
    "output", "capture", "regime", "hold_out", "share", "trials", "steps", "seed", "search", "measure", "settings",
    "range",
];

impl Search {
    /// Reads the text of a file.
    pub fn parse(text: &str) -> Result<Self, String> {
        let table: toml::Table = text.parse().map_err(|e: toml::de::Error| e.message().to_owned())?;
        if let Some(key) = table.keys().find(|k| !KEYS.contains(&k.as_str())) {
            return Err(format!("`{key}` is no key of a search; expected {}", KEYS.join(", ")));
        }
        let text = |key: &str, default: Option<&str>| match table.get(key) {
            None => default.map(str::to_owned).ok_or(format!("`{key}` must be given, as text")),
            Some(value) => value.as_str().map(str::to_owned).ok_or(format!("`{key}` must be text, found {value}")),
        };
        let number = |key: &str| match table.get(key) {
            None => Ok(None),
            Some(value) => match value.as_integer().and_then(|n| u64::try_from(n).ok()) {
                Some(n) => Ok(Some(n)),
                None => Err(format!("`{key}` must be a whole number from 0, found {value}")),
            },
        };
        let hold_out = match text("hold_out", Some("rest"))?.as_str() {
            "rest" => Validation::Rest,
            "pairs" => Validation::Of(HoldOut::Pairs),
            "views" => Validation::Of(HoldOut::Views),
            "lights" => Validation::Of(HoldOut::Lights),
            "novel" => Validation::Of(HoldOut::Novel),
            other => return Err(format!("`hold_out` must be rest, pairs, views, lights or novel, found \"{other}\"")),
        };
        let strategy = match text("search", Some("tpe"))?.as_str() {
            "tpe" => Strategy::Tpe,
            "random" => Strategy::Random,
            other => return Err(format!("`search` must be tpe or random, found \"{other}\"")),
        };
        let measure = text("measure", Some("psnr"))?;
        let measure = MEASURES.iter().position(|m| m.key == measure).ok_or_else(|| {
            let keys: Vec<&str> = MEASURES.iter().map(|m| m.key).collect();
            format!("`measure` must be one of {}, found \"{measure}\"", keys.join(", "))
        })?;
        let share = match table.get("share") {
            None => 0.2,
            Some(value) => {
                value.as_float().ok_or(format!("`share` must be a number between 0 and 1, found {value}"))?
            }
        };
        let regime = text("regime", Some("full-full"))?.parse::<Regime>().map_err(|e| format!("`regime`: {e}"))?;
        let ranges = table.get("range").and_then(toml::Value::as_table).filter(|t| !t.is_empty());
        let ranges = ranges.ok_or("`[range]` must be a table with at least one setting, such as \"loss.mask\"")?;
        let settings = match table.get("settings") {
            None => toml::Table::new(),
            Some(value) => value.as_table().ok_or("`[settings]` must be a table")?.clone(),
        };
        let mut spans = Vec::new();
        for (name, range) in ranges {
            spans.push(Span::parse(name, range)?);
        }
        let search = Self {
            output: text("output", None)?.into(),
            capture: text("capture", None)?.into(),
            regime,
            hold_out,
            share: share as f32,
            trials: number("trials")?.filter(|n| *n > 0).ok_or("`trials` must be a whole number from 1")?,
            steps: number("steps")?,
            seed: number("seed")?.unwrap_or(0),
            strategy,
            measure,
            settings,
            names: ranges.keys().cloned().collect(),
            spans,
        };
        // Whatever cannot be laid over the settings is found before the first trial.
        search.preset("", &search.spans.iter().map(|s| s.value(0.0)).collect::<Vec<_>>())?;
        Ok(search)
    }

    /// The configuration of a trial.
    pub fn preset(&self, name: &str, values: &[toml::Value]) -> Result<String, String> {
        let mut settings = self.settings.clone();
        settings.entry("base").or_insert("resolved".into());
        settings.insert("name".into(), name.into());
        for (path, value) in self.names.iter().zip(values) {
            let (tables, key) = path.rsplit_once('.').unwrap_or(("", path));
            let mut at = &mut settings;
            for part in tables.split('.').filter(|p| !p.is_empty()) {
                let table = at.entry(part).or_insert_with(|| toml::Table::new().into());
                at = table.as_table_mut().ok_or(format!("`range.\"{path}\"`: {part} is no table in `[settings]`"))?;
            }
            at.insert(key.to_owned(), value.clone());
        }
        toml::to_string(&settings).map_err(|e| e.to_string())
    }

    /// The images of the trials: some of the training images to learn from, others of them held out.
    pub fn selection(&self) -> Result<SelectionManifest, String> {
        let capture = Capture::open(&self.capture, &OpenOptions::default()).map_err(|e| e.to_string())?;
        let kept = self.regime.apply(&capture, self.seed).map_err(|e| e.to_string())?;
        let divided = match self.hold_out {
            Validation::Of(what) => kept.hold_out(what, self.share, self.seed).map_err(|e| e.to_string())?,
            Validation::Rest => {
                let mut rest = capture.clone();
                rest.train.retain(|view| !kept.train.iter().any(|k| k.index == view.index));
                if rest.train.is_empty() {
                    return Err(format!(
                        "the regime {} leaves no training view out; hold out pairs, views or lights of it",
                        self.regime
                    ));
                }
                let share = Selection::percent(100.0 * self.share);
                let rest = rest.select_seeded(&share, &Selection::All, self.seed).map_err(|e| e.to_string())?;
                let mut divided = kept;
                divided.test = rest.train;
                divided
            }
        };
        let what = format!("{}, measured on {} of {:?}", self.regime, self.share, self.hold_out);
        divided.manifest(&what, self.seed).map_err(|e| e.to_string())
    }

    fn legend(&self, capture: &Path, selection: &SelectionManifest, done: usize) -> String {
        let images = |views: &[diamond_dataset::ManifestView]| views.iter().map(|v| v.images.len()).sum::<usize>();
        let steps = self.steps.map_or(String::new(), |n| format!(", {n} steps"));
        format!(
            "{}: {done} of {} trials by {}, seed {}{steps}. Learned from {} training images ({}), compared on {} others of the training images \
             by {}; the capture's test images took no part. Red is the best trial.",
            capture.display(),
            self.trials,
            if self.strategy == Strategy::Tpe { "TPE" } else { "random search" },
            self.seed,
            images(&selection.train),
            self.regime,
            images(&selection.test),
            MEASURES[self.measure].title
        )
    }

    fn csv(&self, trials: &[(Point, Option<Figures>)]) -> String {
        let keys: Vec<&str> = MEASURES.iter().map(|m| m.key).collect();
        let mut out =
            format!("trial,{},{},revision,capture_hash,selection_hash\n", self.names.join(","), keys.join(","));
        for (point, figures) in trials {
            let values: Vec<String> = point.values.iter().map(|v| v.to_string().replace('"', "")).collect();
            let measured: Vec<String> = match figures {
                None => vec![String::new(); MEASURES.len() + 3],
                Some(f) => {
                    let values = f.values.iter().map(|v| v.map_or(String::new(), |v| v.to_string()));
                    values.chain([f.revision.clone(), f.capture.clone(), f.selection.clone()]).collect()
                }
            };
            out += &format!("{},{},{}\n", point.number, values.join(","), measured.join(","));
        }
        out
    }
}

/// The values that were written down for a trial, in the order of `names`; `None` where there are none or others.
fn written_values(path: &Path, names: &[String]) -> Option<Vec<toml::Value>> {
    let table: toml::Table = std::fs::read_to_string(path).ok()?.parse().ok()?;
    names.iter().map(|name| table.get(name).cloned()).collect()
}

/// Runs the trials that are not done and writes the results. Whether all succeeded.
pub fn run(root: &Path, file: &Path, program: &Path, revision: Option<String>) -> Result<bool, String> {
    let text = std::fs::read_to_string(file).map_err(|e| format!("{}: {e}", file.display()))?;
    let mut search = Search::parse(&text).map_err(|e| format!("{}: {e}", file.display()))?;
    // Folders in the file are below the workspace wherever this is called from.
    let named = search.capture.clone();
    (search.output, search.capture) = (root.join(&search.output), root.join(&search.capture));
    let revision = revision.unwrap_or_else(crate::eval::revision);
    let selection = search.selection()?;
    let selection_file = search.output.join("selection.json");
    let json = selection.to_json().map_err(|e| e.to_string())?;
    match std::fs::read_to_string(&selection_file) {
        Ok(before) if before != json => {
            return Err(format!(
                "{}: expected the images that this file selects, found others; name another `output`, or remove that folder",
                selection_file.display()
            ));
        }
        _ => write(&selection_file, &json)?,
    }
    let better = MEASURES[search.measure].better;
    let sign = if better == Better::More { -1.0 } else { 1.0 };
    let mut trials: Vec<(Point, Option<Figures>)> = Vec::new();
    let mut failed = 0;
    for number in 0..search.trials {
        let folder = search.output.join("trials").join(format!("{number:04}"));
        let (values_file, preset_file, out) =
            (folder.join("values.toml"), folder.join("preset.toml"), folder.join("run"));
        let values = match written_values(&values_file, &search.names) {
            Some(values) => values,
            None => {
                let before: Vec<(Vec<toml::Value>, f64)> =
                    trials.iter().map(|(p, _)| (p.values.clone(), sign * p.result)).collect();
                next(&search.spans, search.strategy, search.seed, number, &before)?
            }
        };
        let table: toml::Table = search.names.iter().cloned().zip(values.iter().cloned()).collect();
        write(&preset_file, &search.preset(&format!("trial-{number}"), &values)?)?;
        write(&values_file, &table.to_string())?;
        if figures_in(&out).is_none() {
            println!("trial {} of {}: {}", number + 1, search.trials, table.to_string().replace('\n', "  "));
            let path = |p: &Path| p.display().to_string();
            let mut arguments: Vec<String> =
                ["reconstruct", &path(&search.capture), "-o", &path(&out), "--resume", "--preset"]
                    .map(str::to_owned)
                    .to_vec();
            arguments.extend([
                path(&preset_file),
                "--selection".into(),
                path(&selection_file),
                "--seed".into(),
                search.seed.to_string(),
            ]);
            arguments.extend(search.steps.iter().flat_map(|n| ["--steps".into(), n.to_string()]));
            failed += usize::from(!start(program, &out, &arguments, &revision)?);
        }
        let figures = figures_in(&out);
        // A failed trial is no result, and the search looks elsewhere by the others.
        let result = figures.as_ref().and_then(|f| f.values[search.measure]).unwrap_or(f64::NAN);
        trials.push((Point { number, values, result }, figures));
    }
    let points: Vec<Point> = trials.iter().map(|(p, _)| p.clone()).collect();
    let done = points.iter().filter(|p| p.result.is_finite());
    let title = MEASURES[search.measure].title;
    let svg = parallel_coordinates(&search.names, &search.spans, title, better == Better::More, &points);
    let legend = search.legend(&named, &selection, done.clone().count());
    let html = plot::html(&legend, &search.names, title, better == Better::More, &points, &svg);
    for (name, text) in [("tune.svg", svg), ("tune.html", html), ("tune.csv", search.csv(&trials))] {
        write(&search.output.join(name), &text)?;
    }
    if let Some(best) = done.min_by(|a, b| (sign * a.result).total_cmp(&(sign * b.result))) {
        write(&search.output.join("best.toml"), &search.preset("tuned", &best.values)?)?;
        println!(
            "best is trial {} with {title} {:.3}: {}",
            best.number,
            best.result,
            search.output.join("best.toml").display()
        );
    }
    println!("{}", search.output.join("tune.html").display());
    Ok(failed == 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = "output = \"out/tune\"\ncapture = \"assets/captures/spot-small\"\nregime = \"5x5\"\nhold_out = \"views\"\n\
        trials = 4\nsteps = 20\nseed = 3\n[settings]\nbase = \"paper\"\n[settings.loss]\nmask = 0.2\n[range]\n\
        \"loss.depth_consistency\" = { from = 0.003, to = 0.3, log = true }\n\
        \"consistency.penalty\" = { choices = [\"bce\", \"l1\"] }\n";

    fn spot() -> PathBuf {
        crate::tidy::workspace_root().join("assets/captures/spot-small")
    }

    #[test]
    fn settings_are_laid_over_the_fixed_ones() {
        let search = Search::parse(FILE).unwrap();
        assert_eq!(search.names, ["consistency.penalty", "loss.depth_consistency"]);
        let preset: toml::Table = search.preset("trial-7", &["l1".into(), 0.05.into()]).unwrap().parse().unwrap();
        assert_eq!((preset["base"].as_str(), preset["name"].as_str()), (Some("paper"), Some("trial-7")));
        assert_eq!(
            (preset["loss"]["mask"].as_float(), preset["loss"]["depth_consistency"].as_float()),
            (Some(0.2), Some(0.05))
        );
        assert_eq!(preset["consistency"]["penalty"].as_str(), Some("l1"));
    }

    /// No image of the capture's test part is learned from or chosen by, and nothing is on both sides.
    #[test]
    fn test_images_take_no_part() {
        for what in ["rest", "pairs", "views", "lights", "novel"] {
            let mut search = Search::parse(&FILE.replace("\"views\"", &format!("\"{what}\""))).unwrap();
            search.capture = spot();
            let selection = search.selection().unwrap();
            let images = |views: &[diamond_dataset::ManifestView]| -> Vec<String> {
                views.iter().flat_map(|v| v.images.clone()).collect()
            };
            let (train, held) = (images(&selection.train), images(&selection.test));
            let (least, most) = if what == "rest" { (49, 49) } else { (16, 25) };
            assert!(
                (least..=most).contains(&(train.len() + held.len())) && !held.is_empty(),
                "{what}: {train:?} {held:?}"
            );
            assert!(train.iter().chain(&held).all(|name| name.starts_with("train/")), "{what}");
            assert!(held.iter().all(|name| !train.contains(name)), "{what}");
        }
    }

    #[test]
    fn the_shipped_search_is_read() {
        let root = crate::tidy::workspace_root();
        let text = std::fs::read_to_string(root.join("assets/eval/tune-consistency.toml")).unwrap();
        let mut search = Search::parse(&text).unwrap();
        search.capture = root.join(&search.capture);
        let selection = search.selection().unwrap();
        let images = |views: &[diamond_dataset::ManifestView]| views.iter().map(|v| v.images.len()).sum::<usize>();
        assert_eq!((images(&selection.train), images(&selection.test)), (9, 24));
    }

    #[test]
    fn mistakes_are_named() {
        let error = |from: &str, to: &str| Search::parse(&FILE.replace(from, to)).unwrap_err();
        let mut full = Search::parse(&FILE.replace("\"5x5\"", "\"full-full\"").replace("views", "rest")).unwrap();
        full.capture = spot();
        assert!(full.selection().unwrap_err().contains("leaves no training view out"));
        assert!(error("seed", "seeds").contains("`seeds`"));
        assert!(error("\"views\"", "\"images\"").contains("hold_out"));
        assert!(error("trials = 4", "trials = 0").contains("trials"));
        assert!(error("\"5x5\"", "\"5-5\"").contains("regime"));
        assert!(error("from = 0.003", "from = 3.0").contains("loss.depth_consistency"));
        assert!(error("seed = 3", "measure = \"beauty\"").contains("psnr_masked"));
        assert!(error("loss.depth_consistency", "base.x").contains("base is no table"));
        assert!(error("seed = 3", "search = \"grid\"").contains("tpe or random"));
    }

    /// A program that stands in for `diamond` writes figures: the search reads them, ends, and a second call runs nothing.
    #[cfg(unix)]
    #[test]
    fn a_search_goes_on_where_it_was() {
        use std::os::unix::fs::PermissionsExt;
        let folder = std::env::temp_dir().join(format!("diamond-xtask-tune-{}", std::process::id()));
        let (program, calls) = (folder.join("stand-in"), folder.join("calls"));
        // Fails in the second trial; `-o` is the third argument after the command's name.
        let script = format!(
            "#!/bin/sh\necho x >> {calls}\nn=$(wc -l < {calls})\n[ \"$n\" = 2 ] && exit 1\necho '{{\"psnr\": '$((20 + n))'}}' > \"$4/metrics.json\"\n",
            calls = calls.display()
        );
        write(&program, &script).unwrap();
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
        let file = folder.join("tune.toml");
        let output = folder.join("out");
        let text = FILE.replace("out/tune", output.to_str().unwrap());
        write(&file, &text.replace("assets/captures/spot-small", spot().to_str().unwrap())).unwrap();
        let root = crate::tidy::workspace_root();
        let called = || std::fs::read_to_string(&calls).unwrap().lines().count();
        assert!(!run(root, &file, &program, Some("r".into())).unwrap());
        assert_eq!(called(), 4);
        let csv = std::fs::read_to_string(output.join("tune.csv")).unwrap();
        assert_eq!(csv.lines().count(), 5);
        let values = |csv: &str| -> Vec<String> {
            csv.lines().map(|l| l.split(',').take(3).collect::<Vec<_>>().join(",")).collect()
        };
        // The failed one once more, with the values that it had; what is done is not touched.
        assert!(run(root, &file, &program, Some("r".into())).unwrap());
        assert_eq!(called(), 5);
        let again = std::fs::read_to_string(output.join("tune.csv")).unwrap();
        assert_eq!(values(&csv), values(&again));
        let svg = std::fs::read_to_string(output.join("tune.svg")).unwrap();
        assert_eq!(svg.matches("<polyline").count(), 4);
        let best: toml::Table = std::fs::read_to_string(output.join("best.toml")).unwrap().parse().unwrap();
        let value = best["loss"]["depth_consistency"].as_float().unwrap();
        // The fifth call, which was trial 1, had the highest figure.
        assert!(again.lines().nth(2).unwrap().contains(&value.to_string()), "{again}");
        // Other images under the same name are refused.
        write(&file, &text.replace("5x5", "4x4").replace("assets/captures/spot-small", spot().to_str().unwrap()))
            .unwrap();
        assert!(run(root, &file, &program, None).unwrap_err().contains("selection.json"));
        std::fs::remove_dir_all(folder).unwrap();
    }
}
