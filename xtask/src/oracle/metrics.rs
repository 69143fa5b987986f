//! The metrics of `diamond-metrics` against values computed by other programs.
//!
//! A folder holds pairs of pictures `NAME.ref.npy`, `NAME.test.npy` (f32 or f64, height × width × 3), a table
//! `metrics.csv` for displayed pictures and a table `flip_hdr.csv` for radiance; either table may be missing, not both.
//! PSNR is compared relatively where it exceeds 1 dB and absolutely below, everything else absolutely. A reference that
//! is not a number asks for an error of ours, and "inf" for infinity.
//!
//! Columns of `metrics.csv` that name another metric than ours are listed in `NOT_OURS`; a column that is in neither
//! list is refused. `ssim_skimage_gauss11` is the same definition as `ssim_valid`, computed by another program.
//! In `flip_hdr.csv` every row is compared at the exposures that it lists; rows whose case does not end in `_fixed`
//! also say what the automatic exposures must be.

use super::{Column, OracleReport, picture};
use diamond_image::Image;
use diamond_metrics::{
    FlipExposures, FlipHdrOptions, FlipInput, FlipOptions, FlipToneMapper, MetricError, SsimWindow, flip_exposures,
    flip_hdr, flip_ldr, l1, psnr, psnr_channels, ssim_mean,
};
use std::path::{Path, PathBuf};

/// Agreement asked of PSNR, SSIM and L1.
const EXACT: f64 = 1e-6;
/// Agreement asked of FLIP, whose reference program works in f32.
const FLIP: f64 = 1e-4;

/// A reference column, its tolerance, and our value for it.
type Term = (&'static str, f64, fn(&Image, &Image) -> Result<f64, MetricError>);

/// Everything that `metrics.csv` may hold and we compute.
const COLUMNS: [Term; 8] = [
    ("psnr_all", EXACT, |a, b| psnr(a, b, 1.0)),
    ("psnr_mean_of_channels", EXACT, |a, b| {
        psnr_channels(a, b, 1.0).map(|each| each.iter().sum::<f64>() / each.len() as f64)
    }),
    ("l1", EXACT, l1),
    ("ssim_3dgs_zero_pad", EXACT, |a, b| ssim_mean(a, b, SsimWindow::ZeroPadded)),
    ("ssim_valid", EXACT, |a, b| ssim_mean(a, b, SsimWindow::Valid)),
    ("ssim_skimage_gauss11", EXACT, |a, b| ssim_mean(a, b, SsimWindow::Valid)),
    ("flip_ldr_srgb", FLIP, |a, b| flip_as(a, b, FlipInput::Srgb)),
    ("flip_ldr_linear", FLIP, |a, b| flip_as(a, b, FlipInput::Linear)),
];

/// Columns of `metrics.csv` that are inputs, or metrics that we do not offer (SSIM with a 7×7 box window).
const NOT_OURS: [&str; 4] = ["case", "h", "w", "ssim_skimage_default7"];

fn flip_as(a: &Image, b: &Image, input: FlipInput) -> Result<f64, MetricError> {
    flip_ldr(a, b, FlipOptions { input, ..FlipOptions::default() }).map(|flip| flip.mean)
}

/// A CSV table without quoting: its header and its rows.
struct Table {
    path: PathBuf,
    header: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Table {
    fn read(path: PathBuf) -> Result<Option<Self>, String> {
        if !path.exists() {
            return Ok(None);
        }
        let text = std::fs::read_to_string(&path).map_err(|e| format!("{}: {e}", path.display()))?;
        let mut lines = text.lines().filter(|line| !line.trim().is_empty());
        let cells = |line: &str| line.split(',').map(|cell| cell.trim().to_owned()).collect::<Vec<_>>();
        let header =
            cells(lines.next().ok_or_else(|| format!("{}: expected a header, found nothing", path.display()))?);
        let rows: Vec<_> = lines.map(cells).collect();
        for (i, row) in rows.iter().enumerate() {
            if row.len() != header.len() {
                let (n, found) = (header.len(), row.len());
                return Err(format!("{}: row {}: expected {n} cells, found {found}", path.display(), i + 1));
            }
        }
        Ok(Some(Self { path, header, rows }))
    }

    fn column(&self, name: &str) -> Result<usize, String> {
        let missing = || format!("{}: expected a column {name}", self.path.display());
        self.header.iter().position(|h| h == name).ok_or_else(missing)
    }

    fn number(&self, row: usize, column: usize) -> Result<f64, String> {
        let cell = &self.rows[row][column];
        let name = &self.header[column];
        let bad = |_| format!("{}: row {}: {name}: expected a number, found {cell:?}", self.path.display(), row + 1);
        cell.parse().map_err(bad)
    }
}

fn read_pair(folder: &Path, case: &str) -> Result<(Image, Image), String> {
    let read = |side| picture::read(&folder.join(format!("{case}.{side}.npy")));
    Ok((read("ref")?, read("test")?))
}

/// Our value against the reference's; not a number where only one of them exists.
fn gap(ours: &Result<f64, MetricError>, reference: f64, relative: bool) -> f64 {
    match ours {
        Err(_) if reference.is_nan() => 0.0,
        Err(_) => f64::NAN,
        Ok(ours) if ours.is_infinite() && *ours == reference => 0.0,
        Ok(ours) => (ours - reference).abs() / if relative { reference.abs().max(1.0) } else { 1.0 },
    }
}

fn displayed(folder: &Path, table: &Table) -> Result<Vec<Column>, String> {
    let known = |name: &str| NOT_OURS.contains(&name) || COLUMNS.iter().any(|(n, ..)| *n == name);
    if let Some(name) = table.header.iter().find(|name| !known(name)) {
        return Err(format!("{}: the column {name} is not a metric that is known here", table.path.display()));
    }
    let case_column = table.column("case")?;
    let terms: Vec<(usize, &Term)> = (0..table.header.len())
        .filter_map(|at| COLUMNS.iter().find(|(name, ..)| *name == table.header[at]).map(|term| (at, term)))
        .collect();
    let mut columns: Vec<Column> =
        terms.iter().map(|(_, (name, tolerance, _))| Column::new(*name, *tolerance)).collect();
    for row in 0..table.rows.len() {
        let case = &table.rows[row][case_column];
        let (a, b) = read_pair(folder, case)?;
        for ((at, (name, _, ours)), column) in terms.iter().zip(&mut columns) {
            let reference = table.number(row, *at)?;
            column.observe(gap(&ours(&a, &b), reference, name.starts_with("psnr")), || case.clone());
        }
    }
    Ok(columns)
}

fn tone_mapper(table: &Table, name: &str) -> Result<FlipToneMapper, String> {
    match name {
        "aces" | "ACES" => Ok(FlipToneMapper::Aces),
        "hable" => Ok(FlipToneMapper::Hable),
        "reinhard" => Ok(FlipToneMapper::Reinhard),
        _ => Err(format!("{}: expected the tone mapper aces, hable or reinhard, found {name}", table.path.display())),
    }
}

fn radiance(folder: &Path, table: &Table) -> Result<Vec<Column>, String> {
    let [case_column, mean, start, stop, count, mapper] =
        ["case", "hdrflip_mean", "start_exposure", "stop_exposure", "num_exposures", "tonemapper"]
            .map(|name| table.column(name));
    let (case_column, mean, start, stop, count) = (case_column?, mean?, start?, stop?, count?);
    let mapper = mapper?;
    let names = ["hdrflip_mean", "hdrflip_mean_automatic", "start_exposure", "stop_exposure", "num_exposures"];
    let mut columns = names.map(|name| Column::new(name, if name == "num_exposures" { 0.0 } else { FLIP }));
    for row in 0..table.rows.len() {
        let case = &table.rows[row][case_column];
        let fixed = case.strip_suffix("_fixed");
        let pictures = match fixed {
            Some(shared) if !folder.join(format!("{case}.ref.npy")).exists() => shared,
            _ => case,
        };
        let (a, b) = read_pair(folder, pictures)?;
        let tone_mapper = tone_mapper(table, &table.rows[row][mapper])?;
        let (reference, stops) = (table.number(row, mean)?, [table.number(row, start)?, table.number(row, stop)?]);
        let number = table.number(row, count)?;
        let given = FlipExposures { start: stops[0], stop: stops[1], count: number as usize };
        let ours = |exposures| {
            flip_hdr(&a, &b, FlipHdrOptions { tone_mapper, exposures, ..Default::default() }).map(|r| r.flip.mean)
        };
        columns[0].observe(gap(&ours(Some(given)), reference, false), || case.clone());
        if fixed.is_none() {
            let automatic = flip_exposures(&a, tone_mapper);
            let part = |f: fn(FlipExposures) -> f64| automatic.clone().map(f);
            columns[1].observe(gap(&ours(None), reference, false), || case.clone());
            columns[2].observe(gap(&part(|e| e.start), stops[0], false), || case.clone());
            columns[3].observe(gap(&part(|e| e.stop), stops[1], false), || case.clone());
            columns[4].observe(gap(&part(|e| e.count as f64), number, false), || case.clone());
        }
    }
    let all_fixed = columns[1].count == 0;
    Ok(columns.into_iter().take(if all_fixed { 1 } else { 5 }).collect())
}

/// Compares PSNR, SSIM, L1, FLIP and HDR-FLIP with the tables and pictures in the folder `path`.
///
/// # Errors
/// A message that names the file when the folder holds neither table, or when a table or a picture cannot be read.
pub fn check(path: &Path) -> Result<OracleReport, String> {
    let table = |name| Table::read(path.join(name));
    let (ldr, hdr) = (table("metrics.csv")?, table("flip_hdr.csv")?);
    if ldr.is_none() && hdr.is_none() {
        return Err(format!("{}: expected metrics.csv or flip_hdr.csv, found neither", path.display()));
    }
    let mut columns = Vec::new();
    if let Some(table) = &ldr {
        columns.extend(displayed(path, table)?);
    }
    if let Some(table) = &hdr {
        columns.extend(radiance(path, table)?);
    }
    Ok(OracleReport { title: format!("image metrics, {}", path.display()), columns })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fixtures() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../assets/fixtures/metrics")
    }

    /// [eq:psnr] [eq:ssim] [eq:flip] [eq:flip-hdr] [eq:flip-exposures]
    #[test]
    fn our_metrics_agree_with_the_goldens() {
        let report = check(&fixtures()).expect("the goldens can be read");
        assert!(report.passed(), "{report}");
        assert_eq!(report.columns.len(), 13, "{report}");
    }

    /// The comparison notices a wrong golden in each column.
    #[test]
    fn a_broken_golden_is_noticed_in_every_column() {
        let source = fixtures();
        let broken = std::env::temp_dir().join(format!("diamond-metrics-broken-{}", std::process::id()));
        std::fs::create_dir_all(&broken).expect("a temporary folder");
        for case in ["more_11x11", "more_hdr_odd"] {
            for side in ["ref", "test"] {
                let name = format!("{case}.{side}.npy");
                std::fs::copy(source.join(&name), broken.join(&name)).expect("a copy");
            }
        }
        for (table, case) in [("metrics.csv", "more_11x11"), ("flip_hdr.csv", "more_hdr_odd")] {
            let text = std::fs::read_to_string(source.join(table)).expect("a table");
            let header = text.lines().next().expect("a header");
            let row: Vec<&str> = text.lines().find(|l| l.starts_with(case)).expect("a row").split(',').collect();
            let off: Vec<String> = row
                .iter()
                .enumerate()
                .map(|(i, cell)| match cell.parse::<f64>() {
                    Ok(v) if i > 0 => {
                        format!("{}", v + if header.split(',').nth(i) == Some("num_exposures") { 1.0 } else { 1e-3 })
                    }
                    _ => (*cell).to_owned(),
                })
                .collect();
            std::fs::write(broken.join(table), format!("{header}\n{}\n", off.join(","))).expect("a table");
        }
        let report = check(&broken).expect("the table can be read");
        std::fs::remove_dir_all(&broken).ok();
        let passed: Vec<&str> = report.columns.iter().filter(|c| c.passed()).map(|c| c.name.as_str()).collect();
        // The picture barely depends on a thousandth of a stop and a third exposure, but its golden is off as well.
        assert!(passed.is_empty(), "{passed:?} went unnoticed in\n{report}");
    }

    #[test]
    fn an_unknown_column_a_missing_picture_and_an_empty_folder_are_errors() {
        let folder = std::env::temp_dir().join(format!("diamond-metrics-unknown-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a temporary folder");
        assert!(check(&folder).expect_err("nothing to compare").contains("neither"));
        std::fs::write(folder.join("metrics.csv"), "case,vif\nx,1\n").expect("a table");
        assert!(check(&folder).expect_err("an unknown metric").contains("vif"));
        std::fs::write(folder.join("metrics.csv"), "case,l1\nx,1\n").expect("a table");
        assert!(check(&folder).expect_err("a missing picture").contains("x.ref.npy"));
        std::fs::remove_dir_all(&folder).ok();
    }
}
