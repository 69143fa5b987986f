//! The microfacet terms of `diamond-shading` against a table of reference values.
//!
//! The table is a CSV with a header: roughness, F0, the directions `v` and `l` in the frame whose z is the normal, and any
//! of the reference columns named in `COLUMNS`. Every one that is present is compared, row by row, as a relative error; a column
//! whose name is not known is refused rather than passed over. The code under test is what the renderer runs: `f32` from
//! the directions on, except that the table's F0 is free and goes to the Fresnel term directly.

use super::{Column, OracleReport};
use diamond_shading::{Angles, BrdfModel, Diffuse, Fresnel, Masking, Material, ggx};
use std::path::Path;

/// Largest relative error of any column.
const TOLERANCE: f64 = 1e-5;

/// The columns that a row is made from.
const INPUTS: [&str; 8] = ["roughness", "F0", "vx", "vy", "vz", "lx", "ly", "lz"];

/// One row's inputs, as the renderer sees them.
struct Row {
    material: Material,
    f0: f32,
    angles: Angles,
}

impl Row {
    fn masking(&self, masking: Masking) -> f32 {
        masking.attenuation(self.material.shaded_roughness(), self.angles.cos_theta_o, self.angles.cos_theta_i)
    }

    fn fresnel(&self, fresnel: Fresnel) -> f32 {
        fresnel.reflectance([self.f0; 3].into(), self.angles.cos_theta_d).x
    }

    /// The whole BRDF of a metal whose colour is `f0`: no diffuse lobe, F0 = base colour.
    fn metal(&self, masking: Masking, f0: f32) -> f32 {
        let metal = Material { base_color: [f0; 3].into(), metalness: 1.0, ..self.material };
        let model = BrdfModel { masking, fresnel: Fresnel::Schlick, diffuse: Diffuse::Lambert };
        model.evaluate_at(&metal, &self.angles).x
    }
}

/// A reference column and our value for it.
type Term = (&'static str, fn(&Row) -> f32);

/// Everything that the table may hold.
const COLUMNS: [Term; 12] = [
    ("D_ggx", |row| ggx::distribution(row.material.alpha(), row.angles.sin2_theta_h)),
    ("G_smith_sep", |row| row.masking(Masking::SmithSeparable)),
    ("G_smith_corr", |row| row.masking(Masking::SmithCorrelated)),
    ("G_karis_k", |row| row.masking(Masking::SchlickRoughness)),
    ("G_schlick_half_alpha", |row| row.masking(Masking::SchlickHalfAlpha)),
    ("F_schlick", |row| row.fresnel(Fresnel::Schlick)),
    ("F_sg", |row| row.fresnel(Fresnel::SphericalGaussian)),
    ("f_sep", |row| row.metal(Masking::SmithSeparable, row.f0)),
    ("f_corr", |row| row.metal(Masking::SmithCorrelated, row.f0)),
    ("f_karis", |row| row.metal(Masking::SchlickRoughness, row.f0)),
    ("mi_principled_f", |row| row.metal(Masking::SmithSeparable, row.f0)),
    ("mi_roughconductor_f_F1", |row| row.metal(Masking::SmithSeparable, 1.0)),
];

/// Compares every row and column of the table at `path`, a CSV file or a folder that holds `ggx.csv`.
///
/// # Errors
/// When the file cannot be read, a row is not made of numbers, an input column is missing, no reference column is present,
/// or a column's name is not known. The message names the file and the line.
pub fn check(path: &Path) -> Result<OracleReport, String> {
    let file = if path.is_dir() { path.join("ggx.csv") } else { path.to_path_buf() };
    let text = std::fs::read_to_string(&file).map_err(|e| format!("{}: {e}; expected a CSV table", file.display()))?;
    compare(&file.display().to_string(), &text)
}

/// [`check`] on the text of a table.
fn compare(name: &str, text: &str) -> Result<OracleReport, String> {
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let (_, header) = lines.next().ok_or_else(|| format!("{name}: empty; expected a header line and rows"))?;
    let header: Vec<&str> = header.trim_start_matches('\u{feff}').split(',').map(str::trim).collect();
    let position = |wanted: &str| header.iter().position(|h| *h == wanted);
    let mut inputs = [0usize; INPUTS.len()];
    for (slot, wanted) in inputs.iter_mut().zip(INPUTS) {
        *slot = position(wanted).ok_or_else(|| {
            format!("{name}:1: no column {wanted}; expected {} and reference columns", INPUTS.join(","))
        })?;
    }
    let known = |h: &str| INPUTS.contains(&h) || COLUMNS.iter().any(|(column, _)| *column == h);
    if let Some(stranger) = header.iter().find(|h| !known(h)) {
        return Err(format!("{name}:1: unknown column {stranger}; known are {}", COLUMNS.map(|c| c.0).join(", ")));
    }
    let terms: Vec<(usize, Term)> =
        COLUMNS.iter().filter_map(|term| position(term.0).map(|place| (place, *term))).collect();
    if terms.is_empty() {
        return Err(format!("{name}:1: no reference column; known are {}", COLUMNS.map(|c| c.0).join(", ")));
    }

    let mut columns: Vec<Column> = terms.iter().map(|(_, (name, _))| Column::new(*name, TOLERANCE)).collect();
    for (index, line) in lines {
        let numbers: Vec<f64> = line
            .split(',')
            .map(|cell| cell.trim().parse())
            .collect::<Result<_, _>>()
            .map_err(|e| format!("{name}:{}: expected numbers, {e} in {line:?}", index + 1))?;
        if numbers.len() != header.len() {
            return Err(format!("{name}:{}: expected {} numbers, found {}", index + 1, header.len(), numbers.len()));
        }
        let [roughness, f0, vx, vy, vz, lx, ly, lz] = inputs.map(|i| numbers[i] as f32);
        let row = Row {
            material: Material { base_color: [f0; 3].into(), roughness, metalness: 1.0 },
            f0,
            angles: Angles::new([0.0, 0.0, 1.0].into(), [vx, vy, vz].into(), [lx, ly, lz].into()),
        };
        for ((place, (_, term)), column) in terms.iter().zip(&mut columns) {
            let (actual, expected) = (f64::from(term(&row)), numbers[*place]);
            column.observe(relative_error(actual, expected), || {
                format!("line {}: ours {actual:e}, theirs {expected:e}", index + 1)
            });
        }
    }
    Ok(OracleReport { title: format!("GGX terms against {name}, relative error"), columns })
}

/// |actual − expected|/|expected|; 0 where both are 0.
fn relative_error(actual: f64, expected: f64) -> f64 {
    if actual == expected { 0.0 } else { (actual - expected).abs() / expected.abs() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> String {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../assets/fixtures/ggx/ggx.csv");
        std::fs::read_to_string(path).expect("the fixture")
    }

    /// `[eq:ggx-d]` `[eq:smith-separable]` `[eq:smith-correlated]` `[eq:schlick-ggx]` `[eq:fresnel-schlick]`
    /// `[eq:fresnel-spherical-gaussian]` `[eq:brdf]`
    #[test]
    fn every_column_of_the_table_agrees() {
        let report = compare("ggx.csv", &table()).expect("a table");
        assert_eq!(report.columns.len(), COLUMNS.len());
        assert!(report.columns.iter().all(|c| c.count == 1999));
        assert!(report.passed(), "{report}");
        println!("{report}");
    }

    /// A reference that is off by two parts in 1e5 in one place is noticed, in its column and on its line, in each column.
    #[test]
    fn planted_errors_are_noticed() {
        let text = table();
        let mut lines: Vec<String> = text.lines().take(12).map(String::from).collect();
        let cells: Vec<String> = lines[7].split(',').map(String::from).collect();
        for place in INPUTS.len()..cells.len() {
            let mut broken = cells.clone();
            broken[place] = format!("{:e}", broken[place].parse::<f64>().expect("a number") * (1.0 + 2e-5));
            lines[7] = broken.join(",");
            let report = compare("broken", &lines.join("\n")).expect("a table");
            let failed: Vec<&Column> = report.failures().collect();
            assert_eq!(failed.len(), 1, "{report}");
            assert_eq!(failed[0].name, COLUMNS[place - INPUTS.len()].0);
            assert!(failed[0].at.starts_with("line 8:"), "{}", failed[0].at);
        }
    }

    #[test]
    fn bad_tables_are_errors_and_not_passes() {
        let text = table();
        let head = text.lines().next().expect("a header");
        let with = |row: &str| compare("t", &format!("{head}\n{row}")).expect_err("must be refused");
        assert!(with("1,2,3").contains("t:2") && with(&"x,".repeat(20)).contains("t:2"));
        assert!(compare("t", "").is_err());
        assert!(compare("t", "roughness,F0\n").expect_err("no vx").contains("vx"));
        assert!(compare("t", &format!("{head},surprise\n")).expect_err("unknown").contains("surprise"));
        assert!(!compare("t", head).expect("a table without rows").passed());
        assert!(check(Path::new("no/such/folder")).is_err());
    }
}
