//! Tables of quality: methods × regimes × objects × seeds from one TOML file.
//!
//! Each cell of the grid is one `diamond reconstruct` into a folder of its own, and done when its `metrics.json` is there. So a
//! grid can be interrupted and goes on where it was, cells run on any machine that has the captures (`--print`, `--shard`), and
//! the tables are made of whatever is done, saying what is not: `eval.md`, `eval.html` with a plot of all runs and pictures side by side, and `eval.csv` with a
//! row per run, its revision, and hashes of its capture and of the images that it learned from and was measured on.
//!
//! ```toml
//! output = "out/eval"          # cells go to OUTPUT/OBJECT/REGIME/METHOD/SEED
//! steps = 4000
//! seeds = [0, 1, 2]
//! regimes = ["v3-l3", "3x3", "v5-full"]
//! reference = "neither"        # the method that differences are taken from, which comes first; the first by name where absent
//! [settings]                   # what differs from the preset in all methods, unless the method says otherwise
//! subsurface = { model = "mlp" }
//! [objects]
//! spot = "assets/captures/spot-small"
//! [methods.neither]
//! [methods.both]               # what differs from the preset `base` (resolved unless it says otherwise)
//! loss = { silhouette_consistency = 0.5, depth_consistency = 0.3 }
//! ```
mod figures;
pub(crate) mod page;
mod pictures;
mod tables;

pub use figures::{Better, Figures, MEASURES, Measure, csv, figures_in};
use std::path::{Path, PathBuf};
use std::process::Command;
pub use tables::{Entry, Table};

/// What a file of an evaluation says.
#[derive(Debug, Clone, PartialEq)]
pub struct Grid {
    /// Folder of the cells and tables.
    pub output: PathBuf,
    /// Length of each run; the method's where absent.
    pub steps: Option<u64>,
    /// Seeds.
    pub seeds: Vec<u64>,
    /// Names of regimes, see docs/formats.md.
    pub regimes: Vec<String>,
    /// Names and folders of captures, by name.
    pub objects: Vec<(String, PathBuf)>,
    /// Names and configurations as TOML text: what differences are taken from, then the others by name.
    pub methods: Vec<(String, String)>,
}

/// One run.
#[derive(Debug, Clone, PartialEq)]
pub struct Cell {
    /// Object, regime, method.
    pub names: [String; 3],
    /// Seed.
    pub seed: u64,
    /// Its folder.
    pub folder: PathBuf,
    /// Arguments of the program.
    pub arguments: Vec<String>,
}

/// Whether a name can be a folder's and a table's.
pub(crate) fn plain(name: &str) -> bool {
    let allowed = |c: char| c.is_ascii_alphanumeric() || "-_+.".contains(c);
    !name.is_empty() && name.chars().all(allowed) && !name.starts_with('.')
}

impl Grid {
    /// Reads the text of a file.
    pub fn parse(text: &str) -> Result<Self, String> {
        let table: toml::Table = text.parse().map_err(|e: toml::de::Error| e.message().to_owned())?;
        let known = ["output", "steps", "seeds", "regimes", "reference", "settings", "objects", "methods"];
        if let Some(key) = table.keys().find(|k| !known.contains(&k.as_str())) {
            return Err(format!("`{key}` is no key of an evaluation; expected {}", known.join(", ")));
        }
        let number = |v: &toml::Value| v.as_integer().and_then(|n| u64::try_from(n).ok());
        let list = |key: &str| table.get(key).and_then(toml::Value::as_array).filter(|l| !l.is_empty());
        let rows = |key: &str| {
            let table = table.get(key).and_then(toml::Value::as_table).filter(|t| !t.is_empty());
            let table = table.ok_or(format!("`[{key}]` must be a table with at least one entry"))?;
            match table.keys().find(|name| !plain(name)) {
                Some(name) => Err(format!("`{key}.{name}`: names are of letters, digits, and any of - _ + .")),
                None => Ok(table),
            }
        };
        let output = table.get("output").and_then(toml::Value::as_str).ok_or("`output` must be a folder")?;
        let seeds = list("seeds").ok_or("`seeds` must be a list of numbers, such as [0, 1, 2]")?;
        let seeds: Option<Vec<u64>> = seeds.iter().map(number).collect();
        let regimes = list("regimes").ok_or("`regimes` must be a list of names, such as [\"v3-l3\"]")?;
        let regimes: Option<Vec<String>> = regimes.iter().map(|r| r.as_str().map(str::to_owned)).collect();
        let mut objects = Vec::new();
        for (name, folder) in rows("objects")? {
            let folder = folder.as_str().ok_or(format!("`objects.{name}` must be the folder of a capture"))?;
            objects.push((name.clone(), PathBuf::from(folder)));
        }
        let shared = match table.get("settings") {
            Some(settings) => settings.as_table().ok_or("`[settings]` must be a table of settings")?.clone(),
            None => toml::Table::new(),
        };
        let mut methods = Vec::new();
        for (name, own) in rows("methods")? {
            let own = own.as_table().ok_or(format!("`methods.{name}` must be a table of settings"))?;
            let mut settings = shared.clone();
            for (key, value) in own {
                match (settings.get_mut(key), value) {
                    (Some(toml::Value::Table(shared)), toml::Value::Table(own)) => shared.extend(own.clone()),
                    _ => drop(settings.insert(key.clone(), value.clone())),
                }
            }
            settings.entry("base").or_insert("resolved".into());
            settings.insert("name".into(), name.as_str().into());
            methods.push((name.clone(), toml::to_string(&settings).map_err(|e| e.to_string())?));
        }
        if let Some(reference) = table.get("reference") {
            let place = methods.iter().position(|(name, _)| Some(name.as_str()) == reference.as_str());
            let place = place.ok_or(format!("`reference` must be the name of a method, found {reference}"))?;
            methods[..=place].rotate_right(1);
        }
        Ok(Self {
            output: output.into(),
            steps: match table.get("steps") {
                Some(value) => Some(number(value).ok_or("`steps` must be a whole number")?),
                None => None,
            },
            seeds: seeds.ok_or("`seeds` must be whole numbers from 0")?,
            regimes: regimes
                .filter(|all| all.iter().all(|r| plain(r)))
                .ok_or("`regimes` must be names such as \"v3-l3\" or \"3x3\"")?,
            objects,
            methods,
        })
    }

    /// The file of a method's configuration.
    fn method_file(&self, name: &str) -> PathBuf {
        self.output.join("methods").join(format!("{name}.toml"))
    }

    /// Writes the configurations of the methods, which the cells read. One that is there already must say the same: done
    /// cells are of it.
    pub fn write_methods(&self) -> Result<(), String> {
        for (name, text) in &self.methods {
            let path = self.method_file(name);
            match std::fs::read_to_string(&path) {
                Ok(before) if before != *text => {
                    return Err(format!(
                        "the method {name} is not what it was when {} was written: give it another name, or remove that \
                         file and the method's runs",
                        path.display()
                    ));
                }
                _ => write(&path, text)?,
            }
        }
        Ok(())
    }

    /// All cells, in an order that finishes one seed of everything before the next.
    pub fn cells(&self) -> Vec<Cell> {
        let mut cells = Vec::new();
        for &seed in &self.seeds {
            for (object, capture) in &self.objects {
                for regime in &self.regimes {
                    for (method, _) in &self.methods {
                        let folder = self.output.join(object).join(regime).join(method).join(seed.to_string());
                        let text = |path: &Path| path.display().to_string();
                        let mut arguments = ["reconstruct", &text(capture), "-o", &text(&folder), "--resume"]
                            .map(str::to_owned)
                            .to_vec();
                        let preset = text(&self.method_file(method));
                        let seed_text = seed.to_string();
                        arguments
                            .extend(["--preset", &preset, "--regime", regime, "--seed", &seed_text].map(str::to_owned));
                        arguments.extend(self.steps.iter().flat_map(|n| ["--steps".into(), n.to_string()]));
                        let names = [object.clone(), regime.clone(), method.clone()];
                        cells.push(Cell { names, seed, folder, arguments });
                    }
                }
            }
        }
        cells
    }
}

pub(crate) fn write(path: &Path, text: &str) -> Result<(), String> {
    let fail = |e: std::io::Error| format!("{}: {e}", path.display());
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(fail)?;
    }
    std::fs::write(path, text).map_err(fail)
}

/// Which part of the grid is run here.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    /// Every `of`th cell, beginning with this one, from 0.
    pub index: usize,
    /// Number of parts.
    pub of: usize,
}

impl std::str::FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match parts {
            Some((index, of)) if index < of => Ok(Self { index, of }),
            _ => Err("expected I/N with I from 0 to N − 1, such as 0/4".into()),
        }
    }
}

/// The revision of the workspace, with a mark where files differ from it; "unknown" outside a repository.
pub fn revision() -> String {
    let git = |arguments: &[&str]| {
        let output = Command::new("git").args(arguments).output().ok().filter(|o| o.status.success())?;
        Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    let Some(revision) = git(&["rev-parse", "--short=12", "HEAD"]) else { return "unknown".into() };
    let clean = git(&["status", "--porcelain", "--untracked-files=no"]).is_some_and(|changes| changes.is_empty());
    if clean { revision } else { revision + "+changes" }
}

/// Starts the program for a run in `folder`, after the revision is written there. Whether it succeeded.
pub(crate) fn start(program: &Path, folder: &Path, arguments: &[String], revision: &str) -> Result<bool, String> {
    let cell = serde_json::json!({ "revision": revision, "command": arguments.join(" ") });
    write(&folder.join(figures::CELL_FILE), &format!("{cell:#}\n"))?;
    let status = Command::new(program).args(arguments).status();
    let status = status
        .map_err(|e| format!("{}: {e}; build it with `cargo build --release --bin diamond`", program.display()))?;
    if !status.success() {
        println!("  failed ({status})");
    }
    Ok(status.success())
}

/// How cells are run.
#[derive(Debug, Clone)]
pub struct How {
    /// The program.
    pub program: PathBuf,
    /// Print the commands of what is missing instead.
    pub print: bool,
    /// Which part of the grid.
    pub shard: Shard,
    /// What the program was built from; the workspace's revision where absent.
    pub revision: Option<String>,
}

/// Runs what is not done (or prints the commands), then writes `eval.md`, `eval.html` and `eval.csv` of what is. Whether nothing failed or is left.
pub fn run(root: &Path, file: &Path, how: &How) -> Result<bool, String> {
    let text = std::fs::read_to_string(file).map_err(|e| format!("{}: {e}", file.display()))?;
    let grid = Grid::parse(&text).map_err(|e| format!("{}: {e}", file.display()))?;
    // Folders in the file, and in the commands that are printed, are below the workspace wherever this is called from.
    std::env::set_current_dir(root).map_err(|e| format!("{}: {e}", root.display()))?;
    let mut missing = 0;
    grid.write_methods()?;
    let revision = how.revision.clone().unwrap_or_else(revision);
    let cells = grid.cells();
    for (k, cell) in cells.iter().enumerate() {
        if figures_in(&cell.folder).is_some() {
            continue;
        }
        if how.print || k % how.shard.of != how.shard.index {
            missing += 1;
            if how.print {
                println!("{} {}", how.program.display(), cell.arguments.join(" "));
            }
            continue;
        }
        println!("{} of {}: {} {}, seed {}", k + 1, cells.len(), cell.names[0], cell.names[1..].join(" "), cell.seed);
        missing += usize::from(!start(&how.program, &cell.folder, &cell.arguments, &revision)?);
    }
    let done: Vec<(Cell, Figures)> = cells.into_iter().filter_map(|c| figures_in(&c.folder).map(|f| (c, f))).collect();
    for (name, text) in [("eval.md", grid.markdown(&done)), ("eval.html", grid.html(&done)), ("eval.csv", csv(&done))] {
        write(&grid.output.join(name), &text)?;
    }
    if !how.print {
        println!("{}: {} of {} runs", grid.output.join("eval.html").display(), done.len(), grid.cells().len());
    }
    Ok(how.print || missing == 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = "output = \"out/eval\"\nsteps = 50\nseeds = [0, 7]\nregimes = [\"v3-l3\", \"3x3\"]\n\
        [objects]\nspot = \"assets/captures/spot-small\"\n[methods.neither]\n\
        [methods.both]\nloss = { silhouette_consistency = 0.5, depth_consistency = 0.3 }\n";

    #[test]
    fn a_grid_has_its_cells_and_each_is_a_command() {
        let grid = Grid::parse(FILE).unwrap();
        let cells = grid.cells();
        assert_eq!(cells.len(), 8);
        let both: &Cell = cells.iter().find(|c| c.names[2] == "both" && c.seed == 7 && c.names[1] == "3x3").unwrap();
        assert_eq!(
            both.arguments.join(" "),
            "reconstruct assets/captures/spot-small -o out/eval/spot/3x3/both/7 --resume --preset \
             out/eval/methods/both.toml --regime 3x3 --seed 7 --steps 50"
        );
        let text = &grid.methods.iter().find(|(name, _)| name == "both").unwrap().1;
        let method: toml::Table = text.parse().unwrap();
        assert_eq!(method["base"].as_str(), Some("resolved"));
        assert_eq!(method["loss"]["depth_consistency"].as_float(), Some(0.3));
    }

    #[test]
    fn methods_share_settings_and_may_differ_from_them() {
        let shared = "[settings.loss]\nmask = 0.2\ndepth_consistency = 0.1\n[objects]";
        let grid = Grid::parse(&FILE.replace("[objects]", shared)).unwrap();
        let of = |k: usize| grid.methods[k].1.parse::<toml::Table>().unwrap();
        let (both, neither) = (of(0), of(1));
        assert_eq!((both["name"].as_str(), neither["name"].as_str()), (Some("both"), Some("neither")));
        assert_eq!(both["loss"]["mask"], neither["loss"]["mask"]);
        assert_eq!(
            (both["loss"]["depth_consistency"].as_float(), both["base"].as_str()),
            (Some(0.3), Some("resolved"))
        );
        assert_eq!(neither["loss"]["depth_consistency"].as_float(), Some(0.1));
    }

    /// The files that are shipped are read, and name captures that are here.
    #[test]
    fn shipped_evaluations_are_read() {
        let root = crate::tidy::workspace_root();
        for (name, methods) in [("consistency", 7), ("consistency-why", 11), ("regimes", 3)] {
            let text = std::fs::read_to_string(root.join(format!("assets/eval/{name}.toml"))).unwrap();
            let grid = Grid::parse(&text).unwrap();
            assert_eq!(grid.methods.len(), methods, "{name}");
            assert!(grid.objects.iter().all(|(_, folder)| root.join(folder).is_dir()), "{name}");
        }
        // Of captures that are made first.
        for (name, methods) in [("consistency-full", 4), ("consistency-hull", 5), ("regimes-full", 1)] {
            let text = std::fs::read_to_string(root.join(format!("assets/eval/{name}.toml"))).unwrap();
            assert_eq!(Grid::parse(&text).unwrap().methods.len(), methods, "{name}");
        }
    }

    #[test]
    fn mistakes_are_named() {
        let error = |from: &str, to: &str| Grid::parse(&FILE.replace(from, to)).unwrap_err();
        assert!(error("seeds", "seed").contains("`seed`"));
        assert!(error("[0, 7]", "[]").contains("seeds"));
        assert!(error("[0, 7]", "[-1]").contains("seeds"));
        assert!(error("\"3x3\"", "\"../x\"").contains("regimes"));
        assert!(error("methods.both", "methods.\"a/b\"").contains("a/b"));
        assert!(error("[objects]", "settings = 3\n[objects]").contains("settings"));
        assert!(error("spot =", "# spot =").contains("objects"));
        assert!(error("steps = 50", "reference = \"none\"").contains("reference"));
        assert!("4/4".parse::<Shard>().is_err() && "0/4".parse::<Shard>() == Ok(Shard { index: 0, of: 4 }));
    }

    fn figures(psnr: f64, depth: Option<f64>) -> Figures {
        let mut values = [None; MEASURES.len()];
        for (key, value) in [
            ("psnr", Some(psnr)),
            ("ssim", Some(0.9)),
            ("flip", Some(0.1)),
            ("psnr_masked", Some(20.0)),
            ("depth_error", depth),
            ("seconds", Some(60.0)),
        ] {
            values[figures::index(key).unwrap()] = value;
        }
        Figures { values, revision: "abc".into(), capture: "c1".into(), selection: "s1".into() }
    }

    /// Half of the grid: method `both` is worse by 1 dB in one seed and better by 2 in the other, with half the depth error.
    fn half(grid: &Grid) -> Vec<(Cell, Figures)> {
        let figures = |c: &Cell| match (c.names[2].as_str(), c.seed) {
            ("neither", 0) => figures(30.0, Some(0.04)),
            ("neither", _) => figures(31.0, Some(0.04)),
            (_, 0) => figures(29.0, Some(0.02)),
            _ => figures(33.0, Some(0.02)),
        };
        grid.cells().into_iter().filter(|c| c.names[1] == "3x3").map(|c| (c.clone(), figures(&c))).collect()
    }

    #[test]
    fn tables_say_what_is_done_and_what_is_best() {
        let grid = Grid::parse(&format!("reference = \"neither\"\n{FILE}")).unwrap();
        assert_eq!(grid.methods[0].0, "neither");
        let done = half(&grid);
        let text = grid.markdown(&done);
        for expected in [
            "4 of 8 runs are done",
            "| regime | neither | both |",
            "| v3-l3 | – | – |",
            "| 3x3 | 30.50 ± 0.50 / 0.900 / 0.100 (20.00) | **31.00 ± 2.00 / 0.900 / 0.100 (20.00)** |",
            "| both | **31.00 ± 2.00** | 0.9000 ± 0.0000 |",
            // Half a decibel with a standard error of one and a half is no gain; half the depth error is.
            "| 3x3, both | 2 | +0.50 ± 1.50 |",
            "| **-2.00 ± 0.00** | × 1.00 |",
        ] {
            assert!(text.contains(expected), "{expected} in {text}");
        }
        assert!(!text.contains("LPIPS VGG") && !text.contains("NaN"), "{text}");
        let table = csv(&done);
        assert_eq!(table.lines().count(), 5);
        assert!(table.lines().next().unwrap().ends_with("revision,capture_hash,selection_hash"));
        assert!(table.lines().all(|l| l.split(',').count() == MEASURES.len() + 7), "{table}");
        assert!(table.contains("abc,c1,s1"));
    }

    #[test]
    fn the_page_needs_nothing_else() {
        let grid = Grid::parse(FILE).unwrap();
        let page = grid.html(&half(&grid));
        assert_eq!(page.matches("<circle").count(), 4);
        assert!(page.contains("class=\"best\"") && !page.contains("NaN") && !page.contains("inf"), "{page}");
        for foreign in ["<script", "href=", "src=", "url("] {
            assert!(!page.contains(foreign), "{foreign}");
        }
        // Nothing done, and a single run: pages all the same.
        for few in [0, 1] {
            let page = grid.html(&half(&grid)[..few]);
            assert!(page.contains("</html>") && !page.contains("NaN") && !page.contains("inf"), "{page}");
        }
    }

    #[test]
    fn pictures_of_all_methods_stand_side_by_side() {
        let root = std::env::temp_dir().join(format!("diamond-xtask-eval-pictures-{}", std::process::id()));
        let mut grid = Grid::parse(FILE).unwrap();
        grid.output = root.clone();
        let done = half(&grid);
        assert!(grid.pictures(&done).is_empty());
        for (k, (cell, _)) in done.iter().enumerate() {
            std::fs::create_dir_all(cell.folder.join("images")).unwrap();
            // The second method has one image more, and the last run one that is no picture.
            for name in ["a", "b", "c"].iter().take(2 + k % 2) {
                for kind in ["truth", "render", "flip"] {
                    let path = cell.folder.join(format!("images/{name}_{kind}.png"));
                    image::RgbImage::from_pixel(400, 200, image::Rgb([k as u8, 9, 9])).save(path).unwrap();
                }
            }
            let metrics = r#"{"psnr": 1, "per_image": [{"name": "a", "psnr": 23.456}]}"#;
            write(&cell.folder.join("metrics.json"), metrics).unwrap();
        }
        let text = grid.pictures(&done);
        assert!(text.contains("spot, 3x3: a<") && text.contains("spot, 3x3: b<") && !text.contains("3x3: c"), "{text}");
        // Two images: the photograph, and two pictures for each of two methods, made smaller.
        assert_eq!(text.matches("<img").count(), 2 * (1 + 2 * 2));
        assert_eq!(text.matches(": 23.46 dB").count(), 2);
        let first = text.split("base64,").nth(1).unwrap().split('"').next().unwrap();
        let png = base64::Engine::decode(&base64::engine::general_purpose::STANDARD, first).unwrap();
        let picture = image::load_from_memory(&png).unwrap();
        assert_eq!((picture.width(), picture.height()), (160, 80));
        write(&done[0].0.folder.join("images/a_truth.png"), "no picture").unwrap();
        assert!(grid.html(&done).contains("not readable"));
        std::fs::remove_dir_all(root).unwrap();
    }

    #[test]
    fn what_a_run_wrote_is_read() {
        let folder = std::env::temp_dir().join(format!("diamond-xtask-eval-{}", std::process::id()));
        assert_eq!(figures_in(&folder), None);
        let metrics = r#"{"psnr": 30.5, "lpips_vgg": null, "masked": {"psnr": 21.0}, "geometry": {"silhouette_iou": 0.9}, "capture_hash": "77"}"#;
        write(&folder.join("metrics.json"), metrics).unwrap();
        let bare = figures_in(&folder).unwrap();
        assert_eq!((bare.revision.as_str(), bare.selection.as_str(), bare.capture.as_str()), ("", "", "77"));
        write(&folder.join("cell.json"), r#"{"revision": "r1"}"#).unwrap();
        write(&folder.join("selection.json"), "{}").unwrap();
        let found = figures_in(&folder).unwrap();
        let value = |key: &str| found.values[figures::index(key).unwrap()];
        assert_eq!((value("psnr"), value("psnr_masked"), value("silhouette_iou")), (Some(30.5), Some(21.0), Some(0.9)));
        assert_eq!((value("lpips_vgg"), value("depth_error")), (None, None));
        assert!(found.revision == "r1" && found.selection.len() == 64);
        std::fs::remove_dir_all(folder).unwrap();
    }
}
