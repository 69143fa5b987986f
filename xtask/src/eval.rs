//! Tables of quality: methods × regimes × objects × seeds from one TOML file.
//!
//! Each cell of the grid is one `diamond reconstruct` into a folder of its own, and done when its `metrics.json` is there. So a
//! grid can be interrupted and goes on where it was, cells run on any machine that has the captures (`--print`, `--shard`), and
//! the tables are made of whatever is done, saying what is not.
//!
//! ```toml
//! output = "out/eval"          # cells go to OUTPUT/OBJECT/REGIME/METHOD/SEED
//! steps = 4000
//! seeds = [0, 1, 2]
//! regimes = ["v3-l3", "3x3", "v5-full"]
//! [objects]
//! spot = "assets/captures/spot-small"
//! [methods.neither]
//! [methods.both]               # what differs from the preset `base` (resolved unless it says otherwise)
//! loss = { silhouette_consistency = 0.5, depth_consistency = 0.3 }
//! ```
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

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
    /// Names and configurations as TOML text, by name.
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

/// What is read of a run's figures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Figures {
    /// dB over all pixels.
    pub psnr: f64,
    /// In [−1, 1].
    pub ssim: f64,
    /// In [0, 1].
    pub flip: f64,
    /// dB inside the masks.
    pub masked: f64,
    /// Of the run.
    pub seconds: f64,
}

/// Whether a name can be a folder's and a table's.
fn plain(name: &str) -> bool {
    let allowed = |c: char| c.is_ascii_alphanumeric() || "-_+.".contains(c);
    !name.is_empty() && name.chars().all(allowed) && !name.starts_with('.')
}

impl Grid {
    /// Reads the text of a file.
    pub fn parse(text: &str) -> Result<Self, String> {
        let table: toml::Table = text.parse().map_err(|e: toml::de::Error| e.message().to_owned())?;
        let known = ["output", "steps", "seeds", "regimes", "objects", "methods"];
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
        let mut methods = Vec::new();
        for (name, settings) in rows("methods")? {
            let mut settings =
                settings.as_table().ok_or(format!("`methods.{name}` must be a table of settings"))?.clone();
            settings.entry("base").or_insert("resolved".into());
            settings.insert("name".into(), name.as_str().into());
            methods.push((name.clone(), toml::to_string(&settings).map_err(|e| e.to_string())?));
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

    /// The table as Markdown: for each object a row per regime and a column per method, mean ± standard deviation over seeds.
    pub fn markdown(&self, done: &[(Cell, Figures)]) -> String {
        let mut out = String::from(
            "PSNR dB / SSIM / FLIP over all pixels of the held-out images (PSNR inside the masks), mean ± standard deviation \
             of PSNR over seeds, seconds of a run; – is not done.\n",
        );
        let all = self.cells().len();
        let _ = writeln!(out, "{} of {all} runs are done.", done.len());
        for (object, capture) in &self.objects {
            let _ = writeln!(out, "\n### {object} (`{}`)\n", capture.display());
            let names: Vec<&str> = self.methods.iter().map(|(name, _)| name.as_str()).collect();
            let _ = writeln!(out, "| regime | {} |\n|---|{}", names.join(" | "), "---|".repeat(names.len()));
            for regime in &self.regimes {
                let cell = |method: &str| {
                    let of = |(c, _): &&(Cell, Figures)| c.names == [object.as_str(), regime.as_str(), method];
                    let runs: Vec<Figures> = done.iter().filter(of).map(|(_, f)| *f).collect();
                    summary(&runs)
                };
                let cells: Vec<String> = names.iter().map(|m| cell(m)).collect();
                let _ = writeln!(out, "| {regime} | {} |", cells.join(" | "));
            }
        }
        out
    }

    /// Every run that is done, as CSV.
    pub fn csv(done: &[(Cell, Figures)]) -> String {
        let mut out = String::from("object,regime,method,seed,psnr,ssim,flip,psnr_masked,seconds\n");
        for (cell, f) in done {
            let names = cell.names.join(",");
            let _ = writeln!(out, "{names},{},{},{},{},{},{}", cell.seed, f.psnr, f.ssim, f.flip, f.masked, f.seconds);
        }
        out
    }
}

fn mean(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let n = values.clone().count().max(1) as f64;
    let mean = values.clone().sum::<f64>() / n;
    (mean, (values.map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt())
}

/// A cell of the table.
fn summary(runs: &[Figures]) -> String {
    if runs.is_empty() {
        return "–".into();
    }
    let of = |f: fn(&Figures) -> f64| mean(runs.iter().map(f));
    let (psnr, deviation) = of(|f| f.psnr);
    let [ssim, flip, masked, seconds] = [of(|f| f.ssim).0, of(|f| f.flip).0, of(|f| f.masked).0, of(|f| f.seconds).0];
    format!("{psnr:.2} ± {deviation:.2} / {ssim:.3} / {flip:.3} ({masked:.2}) {seconds:.0} s")
}

/// The figures of a cell, if it is done.
pub fn figures(cell: &Cell) -> Option<Figures> {
    let text = std::fs::read_to_string(cell.folder.join("metrics.json")).ok()?;
    let json: serde_json::Value = serde_json::from_str(&text).ok()?;
    let number = |value: &serde_json::Value| value.as_f64().unwrap_or(f64::NAN);
    Some(Figures {
        psnr: number(&json["psnr"]),
        ssim: number(&json["ssim"]),
        flip: number(&json["flip"]),
        masked: number(&json["masked"]["psnr"]),
        seconds: number(&json["seconds"]),
    })
}

fn write(path: &Path, text: &str) -> Result<(), String> {
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

/// Runs what is not done (or prints the commands), then writes `eval.md` and `eval.csv` of what is. Whether nothing failed or is left.
pub fn run(root: &Path, file: &Path, program: &Path, print: bool, shard: Shard) -> Result<bool, String> {
    let text = std::fs::read_to_string(file).map_err(|e| format!("{}: {e}", file.display()))?;
    let grid = Grid::parse(&text).map_err(|e| format!("{}: {e}", file.display()))?;
    // Folders in the file, and in the commands that are printed, are below the workspace wherever this is called from.
    std::env::set_current_dir(root).map_err(|e| format!("{}: {e}", root.display()))?;
    let mut missing = 0;
    grid.write_methods()?;
    for (k, cell) in grid.cells().iter().enumerate() {
        if figures(cell).is_some() {
            continue;
        }
        if print || k % shard.of != shard.index {
            missing += 1;
            if print {
                println!("{} {}", program.display(), cell.arguments.join(" "));
            }
            continue;
        }
        println!("{} {}, seed {}", cell.names[0], cell.names[1..].join(" "), cell.seed);
        let status = Command::new(program).args(&cell.arguments).status();
        let status = status
            .map_err(|e| format!("{}: {e}; build it with `cargo build --release --bin diamond`", program.display()))?;
        if !status.success() {
            missing += 1;
            println!("  failed ({status})");
        }
    }
    let done: Vec<(Cell, Figures)> = grid.cells().into_iter().filter_map(|c| figures(&c).map(|f| (c, f))).collect();
    write(&grid.output.join("eval.md"), &grid.markdown(&done))?;
    write(&grid.output.join("eval.csv"), &Grid::csv(&done))?;
    if !print {
        println!("{}: {} of {} runs", grid.output.join("eval.md").display(), done.len(), grid.cells().len());
    }
    Ok(print || missing == 0)
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
    fn mistakes_are_named() {
        let error = |from: &str, to: &str| Grid::parse(&FILE.replace(from, to)).unwrap_err();
        assert!(error("seeds", "seed").contains("`seed`"));
        assert!(error("[0, 7]", "[]").contains("seeds"));
        assert!(error("[0, 7]", "[-1]").contains("seeds"));
        assert!(error("\"3x3\"", "\"../x\"").contains("regimes"));
        assert!(error("methods.both", "methods.\"a/b\"").contains("a/b"));
        assert!(error("spot =", "# spot =").contains("objects"));
        assert!("4/4".parse::<Shard>().is_err() && "0/4".parse::<Shard>() == Ok(Shard { index: 0, of: 4 }));
    }

    #[test]
    fn tables_say_what_is_done() {
        let grid = Grid::parse(FILE).unwrap();
        let f = |psnr| Figures { psnr, ssim: 0.9, flip: 0.1, masked: 20.0, seconds: 60.0 };
        let done: Vec<(Cell, Figures)> =
            grid.cells().into_iter().filter(|c| c.names[1] == "3x3").zip([30.0, 31.0, 32.0, 33.0].map(f)).collect();
        let text = grid.markdown(&done);
        assert!(text.contains("4 of 8 runs are done"), "{text}");
        assert!(text.contains("| v3-l3 | – | – |"), "{text}");
        assert!(text.contains("31.00 ± 1.00 / 0.900 / 0.100 (20.00) 60 s"), "{text}");
        assert_eq!(Grid::csv(&done).lines().count(), 5);
    }
}
