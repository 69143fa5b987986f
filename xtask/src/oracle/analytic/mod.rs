//! The path tracer and the closed forms of `diamond-pathtrace` against analytic values of light transport.
//!
//! The table is a CSV: quantity, value, source. The quantity is text that says what was computed (`slab a=0.9 g=0.75 tau=2.0 R
//! normal`); [`row`] reads it. What has to be estimated is traced, with more and more paths, until the standard error is
//! below a fraction of the value, and the column's error is the difference in standard errors: at most 4. What has a closed form
//! is compared relatively. A row that is not understood is named in the title and not compared; a table without any other fails.

mod estimate;
mod row;

use super::{Column, OracleReport};
use row::Quantity;
use std::path::Path;

/// Largest difference of an estimate, in standard errors.
const SIGMAS: f64 = 4.0;
/// Largest standard error of an estimate, relative to the value.
pub const PRECISION: f64 = 1e-3;
/// Largest relative error of a closed form; tables print ten digits.
const CLOSED_FORM: f64 = 2e-7;

/// Compares every row of the table at `path`, a CSV file or a folder that holds `oracles.csv` or `analytic.csv`.
///
/// # Errors
/// When the file cannot be read, or a row has no number where the value should be.
pub fn check(path: &Path) -> Result<OracleReport, String> {
    let file = if path.is_dir() {
        let names = ["oracles.csv", "analytic.csv"].map(|name| path.join(name));
        let found = names.iter().find(|file| file.exists()).cloned().or_else(|| super::only_file(path, "csv"));
        found.ok_or_else(|| format!("{}: expected oracles.csv, analytic.csv or one other CSV in it", path.display()))?
    } else {
        path.to_path_buf()
    };
    let text = std::fs::read_to_string(&file).map_err(|e| format!("{}: {e}; expected a CSV table", file.display()))?;
    compare(&file.display().to_string(), &text, PRECISION)
}

/// The cells of a line; quotes keep commas together.
fn cells(line: &str) -> Vec<String> {
    let (mut cells, mut quoted) = (vec![String::new()], false);
    for c in line.chars() {
        match c {
            '"' => quoted = !quoted,
            ',' if !quoted => cells.push(String::new()),
            c => cells.last_mut().into_iter().for_each(|cell| cell.push(c)),
        }
    }
    cells
}

/// [`check`] on the text of a table, with estimates to the relative standard error `precision`.
pub fn compare(name: &str, text: &str, precision: f64) -> Result<OracleReport, String> {
    let (mut columns, mut strangers) = (Vec::new(), Vec::new());
    for (index, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let cells = cells(line);
        if index == 0 && cells[0] == "quantity" {
            continue;
        }
        let value = cells.get(1).and_then(|cell| cell.trim().parse::<f64>().ok());
        let expected = value.ok_or_else(|| format!("{name}:{}: no number after {:?}", index + 1, cells[0]))?;
        let note = cells.get(2).map_or("", String::as_str);
        let Some(quantity) = row::read(&cells[0]) else {
            strangers.push(format!("line {}: {}", index + 1, cells[0]));
            continue;
        };
        observe(&mut columns, &cells[0], &quantity, expected, precision);
        // A second value in the note: the same scene with the other masking term.
        if let (Quantity::GgxAlbedo { alpha, cos, .. }, Some((_, second))) =
            (&quantity, note.split_once("height-correlated:"))
        {
            let expected = second.trim().parse().map_err(|_| format!("{name}:{}: note {note:?}", index + 1))?;
            let correlated = Quantity::GgxAlbedo { alpha: *alpha, cos: *cos, correlated: true };
            observe(&mut columns, &format!("{} (correlated)", cells[0]), &correlated, expected, precision);
        }
    }
    let skipped = match strangers.len() {
        0 => String::new(),
        n => format!("\n  {n} rows are of no kind that is known here: {}", strangers.join("; ")),
    };
    Ok(OracleReport { title: format!("light transport against {name}{skipped}"), columns })
}

fn observe(columns: &mut Vec<Column>, name: &str, quantity: &Quantity, expected: f64, precision: f64) {
    if let Some(ours) = estimate::closed_form(quantity) {
        let mut column = Column::new(name, CLOSED_FORM);
        let error = if expected == 0.0 { ours.abs() } else { (ours - expected).abs() / expected.abs() };
        column.observe(error, || format!("relative; ours {ours:.9}, theirs {expected:.9}"));
        columns.push(column);
        return;
    }
    let estimate = estimate::estimate(quantity, expected.abs() * precision);
    let mut column = Column::new(name, SIGMAS);
    let at = || format!("s.e.; ours {:.7} ± {:.1e}, theirs {expected:.7}", estimate.mean, estimate.error);
    let difference = (estimate.mean - expected).abs();
    // A table prints so many digits; an estimate without spread (the furnace) is exact up to rounding.
    let sigmas = difference / estimate.error.max(2e-6 * expected.abs());
    // Too wide an error proves nothing.
    let wide = estimate.error > 1.001 * precision * expected.abs();
    column.observe(if wide { f64::NAN } else { sigmas }, at);
    columns.push(column);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fixture() -> String {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../assets/fixtures/transport/analytic.csv");
        std::fs::read_to_string(path).expect("the fixture")
    }

    /// `[eq:henyey-greenstein]` `[eq:roulette]` `[eq:dipole]` `[eq:burley]`: every row, to 1 % here and to 0.1 % in the long test.
    #[test]
    fn every_row_agrees_within_one_percent() {
        let report = compare("analytic.csv", &fixture(), 1e-2).expect("a table");
        assert!(!report.title.contains("no kind"), "{report}");
        assert!(report.columns.len() >= 90 && report.passed(), "{report}");
    }

    #[test]
    #[ignore = "minutes: every estimate to a standard error of 0.1 %"]
    fn every_row_agrees_within_a_thousandth() {
        let report = compare("analytic.csv", &fixture(), PRECISION).expect("a table");
        println!("{report}");
        assert!(report.passed(), "{report}");
    }

    /// A value that is off by 6 % is noticed in each kind of row, and a row that nobody understands is named.
    #[test]
    fn planted_errors_and_strangers_are_noticed() {
        let rows = [
            "\"semiinf_iso a=0.9 plane albedo, mu0=0.5\",0.4774",
            "semiinf_iso a=0.9 BRDF normal->normal [1/sr],0.1300",
            "slab a=0.9 g=0.75 tau=2.0 T Lambert,0.5319",
            "sphere absorb-only sigma*R=1.0: parallel beam transmitted fraction,0.315",
            "\"<r^2> after n=5 flights, g=0.5 [mfp^2]\",17.1",
            "\"Burley CDF(1), d=1\",0.3707",
            "H(1) at a=1,2.9",
            "GGX directional albedo alpha=0.25 cos=0.5 F=1 separable Smith,0.8",
        ];
        for row in rows {
            let report =
                compare("planted", &format!("quantity,value,source/formula\n{row},\n"), 1e-2).expect("a table");
            assert_eq!((report.columns.len(), report.passed()), (1, false), "{report}");
        }
        let report = compare("planted", "temperature of the moon,250,\n", 1e-2).expect("a table");
        assert!(!report.passed() && report.title.contains("temperature of the moon"));
        assert!(compare("planted", "H(1) at a=1,many,\n", 1e-2).is_err());
        // Cut off in the middle of a row, before its number; not text; nothing at all.
        let text = "H(1) at a=1,2.9078105291,\nGGX dir";
        assert!(compare("cut", text, 1.0).expect_err("cut").contains("cut:2"));
        assert!(!compare("empty", "", 1e-2).expect("an empty table").passed());
    }

    /// A table keeps working under another name; a folder without one, or a file that is no text, is an error.
    #[test]
    fn renamed_tables_are_found_and_broken_ones_named() {
        let folder = std::env::temp_dir().join(format!("analytic-oracle-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a folder");
        assert!(check(&folder).expect_err("empty").contains("oracles.csv"));
        std::fs::write(folder.join("more.csv"), "H(1) at a=1,2.9078105291,\n").expect("write");
        assert!(check(&folder).expect("renamed").passed());
        assert!(check(&folder.join("more.csv")).expect("by its name").passed());
        std::fs::write(folder.join("more.csv"), [0xff, 0xfe, 0x00, 0x9c]).expect("write");
        assert!(check(&folder).expect_err("no text").contains("more.csv"));
        std::fs::remove_dir_all(&folder).expect("clean up");
    }

    /// Parameters that the fixture has not: near white, forward and backward, any index, any cosine. What can be known without tracing holds:
    /// nothing is lost without absorption, nothing is gained with it, and the half-space follows Chandrasekhar's function.
    #[test]
    fn other_parameters_of_the_same_kinds_are_traced() {
        let value = |text: &str| estimate::estimate(&row::read(text).expect(text), 2e-3);
        for medium in ["a=1.0 g=0.9 tau=4.0", "a=1.0 g=-0.6 tau=2.0 n=1.3", "a=1.0 g=0.95 tau=8.0 eta=1.8"] {
            for incidence in ["normal", "Lambert", "mu0=0.3"] {
                let [r, t] = ["R", "T total"].map(|side| value(&format!("slab {medium} {side} {incidence}")));
                let (sum, error) = (r.mean + t.mean, r.error.hypot(t.error));
                assert!(error < 4e-3 && (sum - 1.0).abs() < 4.0 * error, "{medium} {incidence}: {sum} ± {error}");
            }
        }
        let absorbing =
            ["n=1.3", "n=1.5", "n=1.8"].map(|n| value(&format!("semiinf a=0.9 g=0.8 {n} total R normal")).mean);
        assert!(absorbing.iter().all(|r| *r > 0.02 && *r < 0.5), "{absorbing:?}");
        for (a, mu) in [(0.7, 0.35), (0.97, 0.8), (0.999, 0.15)] {
            let found = value(&format!("semiinf_iso a={a} plane albedo, mu0={mu}"));
            let h = diamond_pathtrace::closed_form::chandrasekhar_h(a, &[mu])[0];
            let expected = 1.0 - h * (1.0f64 - a).sqrt();
            assert!((found.mean - expected).abs() < 4.0 * found.error.max(1e-5), "{a} {mu}: {found:?} {expected}");
        }
    }
}
