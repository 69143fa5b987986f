//! What benchmarks have in common: a table of named columns that is printed as it grows and written as CSV and JSON with
//! the machine, the commit and the seed, medians, and the exponent of growth.
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// A table of results.
pub struct Table {
    name: String,
    columns: Vec<&'static str>,
    rows: Vec<Vec<String>>,
    context: Vec<(&'static str, String)>,
}

impl Table {
    /// An empty table; `context` is written beside it (threads, seed, roofline, …).
    pub fn new(name: &str, columns: &[&'static str], context: &[(&'static str, String)]) -> Self {
        let mut all = vec![("machine", machine()), ("commit", commit())];
        all.extend_from_slice(context);
        println!("{name}: {}", all.iter().map(|(k, v)| format!("{k} {v}")).collect::<Vec<_>>().join(", "));
        println!("| {} |\n|{}|", columns.join(" | "), vec!["---"; columns.len()].join("|"));
        Self { name: name.into(), columns: columns.to_vec(), rows: Vec::new(), context: all }
    }

    /// Appends and prints a row, one cell per column.
    pub fn push(&mut self, row: Vec<String>) {
        println!("| {} |", row.join(" | "));
        self.rows.push(row);
    }

    /// Writes `<name>.csv` and `<name>.json` into `folder`, each first under another name, and returns their paths.
    ///
    /// # Errors
    /// The path and what the system says.
    pub fn write(&self, folder: &Path) -> Result<[PathBuf; 2], String> {
        let fail = |path: &Path, e: std::io::Error| format!("{}: {e}", path.display());
        std::fs::create_dir_all(folder).map_err(|e| fail(folder, e))?;
        let mut csv = String::new();
        for (key, value) in &self.context {
            let _ = writeln!(csv, "# {key}: {value}");
        }
        let quoted = |cell: &str| {
            if cell.contains([',', '"']) { format!("\"{}\"", cell.replace('"', "\"\"")) } else { cell.into() }
        };
        let _ = writeln!(csv, "{}", self.columns.join(","));
        for row in &self.rows {
            let _ = writeln!(csv, "{}", row.iter().map(|c| quoted(c)).collect::<Vec<_>>().join(","));
        }
        let rows: Vec<serde_json::Value> = self
            .rows
            .iter()
            .map(|row| {
                let cells = self.columns.iter().zip(row).map(|(key, cell)| {
                    let value = cell.parse::<f64>().ok().and_then(serde_json::Number::from_f64);
                    (key.to_string(), value.map_or_else(|| cell.clone().into(), Into::into))
                });
                serde_json::Value::Object(cells.collect())
            })
            .collect();
        let context: serde_json::Map<_, _> =
            self.context.iter().map(|(k, v)| (k.to_string(), v.clone().into())).collect();
        let json = serde_json::json!({ "name": self.name, "context": context, "rows": rows });
        let files = [("csv", csv), ("json", format!("{json:#}\n"))].map(|(extension, text)| {
            let path = folder.join(format!("{}.{extension}", self.name));
            let temporary = folder.join(format!("{}.{extension}.tmp", self.name));
            let write = || -> std::io::Result<()> {
                let mut file = std::fs::File::create(&temporary)?;
                file.write_all(text.as_bytes())?;
                file.sync_all()?;
                std::fs::rename(&temporary, &path)
            };
            write().map_err(|e| fail(&path, e)).map(|()| path)
        });
        let [csv, json] = files;
        Ok([csv?, json?])
    }
}

/// Median of `values`; NaN of none.
pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => f64::NAN,
        n if n % 2 == 1 => sorted[n / 2],
        n => 0.5 * (sorted[n / 2 - 1] + sorted[n / 2]),
    }
}

/// Seconds of repeated calls of `f`: at least `least` calls, and until `budget` is used up.
pub fn time(budget: Duration, least: usize, mut f: impl FnMut()) -> Vec<f64> {
    let start = Instant::now();
    let mut seconds = Vec::new();
    while seconds.len() < least || start.elapsed() < budget {
        let one = Instant::now();
        f();
        seconds.push(one.elapsed().as_secs_f64());
    }
    seconds
}

/// Exponent p of y ~ xᵖ by least squares of logarithms.
pub fn exponent(points: &[(f64, f64)]) -> f64 {
    let n = points.len() as f64;
    let logs: Vec<(f64, f64)> = points.iter().map(|(x, y)| (x.ln(), y.ln())).collect();
    let (mx, my) = (logs.iter().map(|p| p.0).sum::<f64>() / n, logs.iter().map(|p| p.1).sum::<f64>() / n);
    let (xy, xx) = logs.iter().fold((0.0, 0.0), |(xy, xx), (x, y)| (xy + (x - mx) * (y - my), xx + (x - mx).powi(2)));
    xy / xx
}

/// Peak and present resident memory in MB, where the system says.
pub fn memory() -> Option<(f64, f64)> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let of = |key: &str| -> Option<f64> {
        let line = status.lines().find(|l| l.starts_with(key))?;
        Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? * 1024.0 * 1e-6)
    };
    Some((of("VmHWM:")?, of("VmRSS:")?))
}

fn machine() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find_map(|l| l.strip_prefix("model name")).map(|l| l.trim_start_matches([' ', '\t', ':']));
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    format!("{} ({cores} cores)", model.unwrap_or(std::env::consts::ARCH).trim())
}

fn commit() -> String {
    let git = |arguments: &[&str]| {
        let out = Command::new("git").args(arguments).output().ok().filter(|o| o.status.success())?;
        Some(String::from_utf8_lossy(&out.stdout).trim().to_owned())
    };
    let dirty = git(&["status", "--porcelain", "--untracked-files=no"]).is_some_and(|s| !s.is_empty());
    git(&["rev-parse", "--short", "HEAD"]).map_or("unknown".into(), |c| c + if dirty { " with changes" } else { "" })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_and_exponents() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&[4.0, 1.0, 2.0, 3.0]), 2.5);
        assert!(median(&[]).is_nan());
        let points: Vec<(f64, f64)> = [1.0, 4.0, 64.0].iter().map(|&x: &f64| (x, 3.0 * x.powf(1.5))).collect();
        assert!((exponent(&points) - 1.5).abs() < 1e-12);
        assert_eq!(time(Duration::ZERO, 3, || ()).len(), 3);
    }

    #[test]
    fn tables_are_written_whole() {
        let folder = std::env::temp_dir().join(format!("diamond-bench-{}", std::process::id()));
        let mut table = Table::new("shapes", &["name", "ms"], &[("seed", "42".into())]);
        table.push(vec!["a, \"b\"".into(), "1.5".into()]);
        let [csv, json] = table.write(&folder).unwrap();
        let text = std::fs::read_to_string(csv).unwrap();
        assert!(text.contains("# seed: 42\n") && text.ends_with("name,ms\n\"a, \"\"b\"\"\",1.5\n"), "{text}");
        let value: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(json).unwrap()).unwrap();
        assert_eq!(value["rows"][0]["ms"], 1.5);
        std::fs::remove_dir_all(folder).unwrap();
    }
}
