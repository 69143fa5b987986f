//! Our implementation agrees with reference values that others computed, and the comparison notices when it does not.

use std::fs;
use std::path::{Path, PathBuf};
use xtask::oracle::{self, OracleKind};
use xtask::tidy::workspace_root;

fn fixtures(name: &str) -> PathBuf {
    workspace_root().join("assets/fixtures").join(name)
}

fn agrees(kind: OracleKind, name: &str) {
    let report = oracle::run(kind, fixtures(name)).expect("a readable reference");
    println!("{report}");
    assert!(report.passed(), "\n{report}");
}

#[test]
fn microfacet_terms_agree() {
    agrees(OracleKind::Ggx, "ggx");
}

#[test]
fn splat_pictures_and_gradients_agree() {
    agrees(OracleKind::Splat, "splat");
}

#[test]
fn metrics_agree() {
    agrees(OracleKind::Metrics, "metrics");
}

/// A copy of a folder of references that goes away with its owner.
struct Copy {
    folder: PathBuf,
}

impl Copy {
    fn of(name: &str, test: &str) -> Copy {
        let folder = std::env::temp_dir().join(format!("diamond-oracle-{}-{test}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).expect("a temporary folder");
        for entry in fs::read_dir(fixtures(name)).expect("the references") {
            let path = entry.expect("an entry").path();
            fs::copy(&path, folder.join(path.file_name().expect("a name"))).expect("a copy");
        }
        Copy { folder }
    }

    /// Multiplies the number in `column` of the first row of a table.
    fn scale_csv(&self, file: &str, column: &str, factor: f64) {
        let path = self.folder.join(file);
        let text = fs::read_to_string(&path).expect("a table");
        let mut lines: Vec<Vec<String>> =
            text.lines().map(|line| line.split(',').map(str::to_string).collect()).collect();
        let at = lines[0].iter().position(|name| name == column).expect("the column");
        let value: f64 = lines[1][at].parse().expect("a number");
        lines[1][at] = (value * factor).to_string();
        let text: Vec<String> = lines.iter().map(|line| line.join(",")).collect();
        fs::write(&path, text.join("\n")).expect("written");
    }

    fn file(&self, ending: &str) -> PathBuf {
        let mut files: Vec<PathBuf> =
            fs::read_dir(&self.folder).expect("the copy").map(|entry| entry.expect("an entry").path()).collect();
        files.sort();
        files.into_iter().find(|path| path.to_string_lossy().ends_with(ending)).expect("such a file")
    }

    fn fails_in(&self, kind: OracleKind, column: &str) {
        let report = oracle::run(kind, &self.folder).expect("a readable reference");
        assert!(!report.passed(), "the broken value went unnoticed:\n{report}");
        assert!(report.failures().any(|failed| failed.name.contains(column)), "expected {column} to fail:\n{report}");
    }
}

impl Drop for Copy {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.folder);
    }
}

#[test]
fn one_wrong_number_among_the_microfacet_terms_is_noticed() {
    let copy = Copy::of("ggx", "ggx");
    copy.scale_csv("ggx.csv", "D_ggx", 1.0001);
    copy.fails_in(OracleKind::Ggx, "D_ggx");
}

#[test]
fn one_wrong_number_among_the_metrics_is_noticed() {
    let copy = Copy::of("metrics", "metrics");
    copy.scale_csv("metrics.csv", "ssim_valid", 1.0001);
    copy.fails_in(OracleKind::Metrics, "ssim_valid");
}

#[test]
fn one_moved_gaussian_is_noticed() {
    let copy = Copy::of("splat", "splat");
    let path = copy.file(".bin");
    let mut bytes = fs::read(&path).expect("a scene");
    let n = u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) as usize;
    // The scene lists its means first; move all in x by a thousandth, since a single one may be hidden.
    for gaussian in 0..n {
        let at = 4 + 12 * gaussian;
        let x = f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
        bytes[at..at + 4].copy_from_slice(&(x + 1e-3).to_le_bytes());
    }
    fs::write(&path, bytes).expect("written");
    copy.fails_in(OracleKind::Splat, "im");
}

/// Cuts a file in half.
fn truncate(path: &Path) {
    let bytes = fs::read(path).expect("a file");
    fs::write(path, &bytes[..bytes.len() / 2]).expect("written");
}

#[test]
fn a_truncated_reference_is_an_error_that_names_the_file() {
    for (kind, name, ending) in [
        (OracleKind::Splat, "splat", ".npz"),
        (OracleKind::Splat, "splat", ".bin"),
        (OracleKind::Metrics, "metrics", ".ref.npy"),
    ] {
        let copy = Copy::of(name, &format!("truncated{ending}"));
        let path = copy.file(ending);
        truncate(&path);
        let message = oracle::run(kind, &copy.folder).expect_err("half a file is no reference");
        let stem = path.file_stem().expect("a name").to_string_lossy().into_owned();
        assert!(message.contains(&stem), "{message} does not name {stem}");
    }
    let copy = Copy::of("ggx", "truncated-ggx");
    let path = copy.file("ggx.csv");
    let text = fs::read_to_string(&path).expect("the table");
    // Half of a row.
    fs::write(&path, &text[..text.trim_end().len() - 40]).expect("written");
    assert!(oracle::run(OracleKind::Ggx, &copy.folder).expect_err("half a row").contains("ggx.csv"));
}
