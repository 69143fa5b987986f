//! The course of a run, step by step: what `log.csv` holds and the report's curves show.
use crate::{SssError, write_output};
use diamond_reconstruct::StepReport;
use std::path::Path;

/// Means over the steps since the row before.
#[derive(Debug, Clone, PartialEq)]
pub struct LogRow {
    /// Steps done at the end of the row.
    pub step: u64,
    /// Weighted sum of all terms.
    pub objective: f64,
    /// Each term before weighting, in the order of [`TrainingLog::terms`].
    pub terms: Vec<f64>,
    /// PSNR of the training images, dB.
    pub psnr: f64,
    /// Gaussians after the last step.
    pub gaussians: usize,
}

/// The course of a run. Rows are means over a fixed number of steps; memory and file stay small however long the run.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TrainingLog {
    /// Names of the terms.
    pub terms: Vec<String>,
    /// Rows in order of steps.
    pub rows: Vec<LogRow>,
    every: u64,
    pending: Vec<StepReport>,
}

/// At most about this many rows are written for a run.
const MAX_ROWS: u64 = 2000;
/// Running means shown to the user extend over this many steps.
const RUNNING: usize = 100;

impl TrainingLog {
    /// An empty log for a run of `steps` steps.
    pub fn new(steps: u64) -> Self {
        Self { every: steps.div_ceil(MAX_ROWS).max(1), ..Self::default() }
    }

    /// Adds a step.
    pub fn push(&mut self, report: &StepReport) {
        self.pending.push(report.clone());
        if (report.step + 1).is_multiple_of(self.every) {
            self.flush();
        }
    }

    /// Makes a row of the steps that have none yet.
    pub fn flush(&mut self) {
        let Some(last) = self.pending.last() else { return };
        for term in self.pending.iter().flat_map(|r| &r.terms) {
            if !self.terms.iter().any(|name| name == term.name) {
                self.terms.push(term.name.to_owned());
            }
        }
        let n = self.pending.len() as f64;
        let mean = |f: &dyn Fn(&StepReport) -> f64| self.pending.iter().map(f).sum::<f64>() / n;
        let term = |name: &str| mean(&|r| r.terms.iter().find(|t| t.name == name).map_or(0.0, |t| f64::from(t.value)));
        self.rows.push(LogRow {
            step: last.step + 1,
            objective: mean(&|r| f64::from(r.objective)),
            terms: self.terms.iter().map(|name| term(name)).collect(),
            psnr: mean(&|r| f64::from(r.psnr)),
            gaussians: last.gaussians,
        });
        self.pending.clear();
    }

    /// PSNR over about the last 100 steps, dB; `None` before the first.
    pub fn running_psnr(&self) -> Option<f64> {
        let rows = (RUNNING as u64 / self.every.max(1)).max(1) as usize;
        let recent = self.rows.iter().rev().take(rows).map(|r| r.psnr);
        let values: Vec<f64> = self.pending.iter().map(|r| f64::from(r.psnr)).chain(recent).take(RUNNING).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    }

    /// The log as CSV.
    pub fn to_csv(&self) -> String {
        let mut out = format!(
            "step,objective,psnr,gaussians{}\n",
            self.terms.iter().map(|t| format!(",{t}")).collect::<String>()
        );
        for row in &self.rows {
            out += &format!("{},{},{},{}", row.step, row.objective, row.psnr, row.gaussians);
            for k in 0..self.terms.len() {
                out += &format!(",{}", row.terms.get(k).copied().unwrap_or(0.0));
            }
            out.push('\n');
        }
        out
    }

    /// Writes `log.csv`.
    pub fn write(&self, path: &Path) -> Result<(), SssError> {
        write_output(path, self.to_csv().as_bytes())
    }

    /// Reads the rows up to `step` of a log written before, to go on from there. A file that is missing or damaged is
    /// an empty log: the run matters more than its curve.
    pub fn read_until(path: &Path, steps: u64, step: u64) -> Self {
        let mut log = Self::new(steps);
        let Ok(text) = std::fs::read_to_string(path) else { return log };
        let mut lines = text.lines();
        let header: Vec<&str> = lines.next().unwrap_or_default().split(',').collect();
        if header.len() < 4 || header[..4] != ["step", "objective", "psnr", "gaussians"] {
            return log;
        }
        log.terms = header[4..].iter().map(|s| (*s).to_owned()).collect();
        for line in lines {
            let cells: Vec<f64> = line.split(',').filter_map(|c| c.parse().ok()).collect();
            if cells.len() != header.len() || cells.iter().any(|c| !c.is_finite()) || cells[0] as u64 > step {
                break;
            }
            log.rows.push(LogRow {
                step: cells[0] as u64,
                objective: cells[1],
                psnr: cells[2],
                gaussians: cells[3] as usize,
                terms: cells[4..].to_vec(),
            });
        }
        log
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_reconstruct::TermValue;

    fn report(step: u64) -> StepReport {
        StepReport {
            step,
            objective: 1.0 / (step + 1) as f32,
            terms: vec![TermValue { name: "l1", weight: 0.8, value: step as f32 }],
            psnr: 20.0 + step as f32,
            gaussians: 10,
            ..Default::default()
        }
    }

    #[test]
    fn a_log_is_read_back_up_to_the_checkpoint() {
        let mut log = TrainingLog::new(6000);
        (0..10).for_each(|s| log.push(&report(s)));
        assert_eq!(log.rows.len(), 3);
        assert_eq!(log.rows[1].terms, [4.0]);
        log.flush();
        assert_eq!(log.rows.last().unwrap().step, 10);
        let path = std::env::temp_dir().join(format!("diamond-log-{}.csv", std::process::id()));
        log.write(&path).unwrap();
        let again = TrainingLog::read_until(&path, 6000, 6);
        assert_eq!(again.rows, log.rows[..2]);
        assert_eq!(again.terms, ["l1"]);
        std::fs::write(&path, "step,objective,psnr,gaussians\n1,0.5,20,9\n2,NaN,20,9\n3,0.5,20,9\n").unwrap();
        assert_eq!(TrainingLog::read_until(&path, 6000, 6).rows.len(), 1, "a row that is not finite ends it");
        std::fs::write(&path, "nonsense").unwrap();
        assert!(TrainingLog::read_until(&path, 6000, 6).rows.is_empty());
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn the_running_mean_covers_about_a_hundred_steps() {
        let mut log = TrainingLog::new(1000);
        assert_eq!(log.running_psnr(), None);
        (0..500).for_each(|s| log.push(&report(s)));
        assert!((log.running_psnr().unwrap() - (20.0 + 449.5)).abs() < 1e-3);
    }
}
