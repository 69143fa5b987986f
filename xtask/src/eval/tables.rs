//! The tables of an evaluation, before they are Markdown or HTML.
use super::figures::{Better, Figures, MEASURES, Measure, index};
use super::{Cell, Grid};
use std::fmt::Write as _;

/// A table.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    /// Above it.
    pub title: String,
    /// Names of the columns, that of the rows' names first.
    pub head: Vec<String>,
    /// Names of the rows and their entries.
    pub rows: Vec<(String, Vec<Entry>)>,
}

/// One entry of a table.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Entry {
    /// What it says.
    pub text: String,
    /// Whether it is the best among those that it is compared with.
    pub best: bool,
}

/// Mean and standard deviation of the values that are there; `None` for none.
pub fn mean(values: impl IntoIterator<Item = Option<f64>>) -> Option<(f64, f64, usize)> {
    let values: Vec<f64> = values.into_iter().flatten().collect();
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let deviation = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
    (!values.is_empty()).then_some((mean, deviation, values.len()))
}

/// Marks the best of entries that are compared, by their values; nothing where there is only one.
fn mark<'a>(entries: impl Iterator<Item = (&'a mut Entry, Option<f64>)>, better: Better) {
    let mut entries: Vec<(&mut Entry, f64)> = entries.filter_map(|(e, v)| Some((e, v?))).collect();
    let sign = if better == Better::More { 1.0 } else { -1.0 };
    let best = entries.iter().map(|(_, v)| sign * v).fold(f64::NEG_INFINITY, f64::max);
    if entries.iter().any(|(_, v)| sign * v < best) {
        entries.iter_mut().for_each(|(e, v)| e.best = sign * *v == best);
    }
}

impl Grid {
    fn runs<'a>(&self, done: &'a [(Cell, Figures)], names: [&str; 3]) -> Vec<&'a Figures> {
        done.iter().filter(|(c, _)| c.names == names).map(|(_, f)| f).collect()
    }

    /// Rows regimes, columns methods: PSNR ± deviation / SSIM / FLIP or LPIPS.
    pub fn main_table(&self, done: &[(Cell, Figures)], object: &str) -> Table {
        let of = |runs: &[&Figures], key: &str| {
            let k = index(key).unwrap_or(0);
            mean(runs.iter().map(|f| f.values[k]))
        };
        let mut rows = Vec::new();
        for regime in &self.regimes {
            let mut entries = Vec::new();
            let mut values = Vec::new();
            for (method, _) in &self.methods {
                let runs = self.runs(done, [object, regime, method]);
                let psnr = of(&runs, "psnr");
                let text = psnr.map_or("–".to_owned(), |(value, deviation, _)| {
                    let show = |key: &str| of(&runs, key).map(|m| format!(" / {:.3}", m.0)).unwrap_or_default();
                    let masked = of(&runs, "psnr_masked").map(|m| format!(" ({:.2})", m.0)).unwrap_or_default();
                    format!("{value:.2} ± {deviation:.2}{}{}{}{masked}", show("ssim"), show("flip"), show("lpips_vgg"))
                });
                entries.push(Entry { text, best: false });
                values.push(psnr.map(|m| m.0));
            }
            mark(entries.iter_mut().zip(values), Better::More);
            rows.push((regime.clone(), entries));
        }
        let head = std::iter::once("regime".to_owned()).chain(self.methods.iter().map(|(name, _)| name.clone()));
        Table { title: object.to_owned(), head: head.collect(), rows }
    }

    /// Rows methods, columns all measures that some run has: the form of the paper's ablation.
    pub fn ablation_table(&self, done: &[(Cell, Figures)], object: &str, regime: &str) -> Table {
        let all: Vec<Vec<&Figures>> =
            self.methods.iter().map(|(m, _)| self.runs(done, [object, regime, m.as_str()])).collect();
        let kept: Vec<(usize, &Measure)> = (MEASURES.iter().enumerate())
            .filter(|(k, _)| all.iter().flatten().any(|f| f.values[*k].is_some()))
            .collect();
        let mut rows: Vec<(String, Vec<Entry>)> =
            self.methods.iter().map(|(name, _)| (name.clone(), vec![Entry::default(); kept.len()])).collect();
        for (column, (k, m)) in kept.iter().enumerate() {
            let means: Vec<_> = all.iter().map(|runs| mean(runs.iter().map(|f| f.values[*k]))).collect();
            for ((_, entries), found) in rows.iter_mut().zip(&means) {
                entries[column].text = found.map_or("–".to_owned(), |(value, deviation, _)| {
                    format!("{:.d$} ± {:.d$}", value * m.scale, deviation * m.scale, d = m.digits)
                });
            }
            let entries = rows.iter_mut().map(|(_, entries)| &mut entries[column]);
            mark(entries.zip(means.iter().map(|m| m.map(|m| m.0))), m.better);
        }
        let head = std::iter::once("method".to_owned()).chain(kept.iter().map(|(_, m)| m.title.to_owned()));
        Table { title: format!("{object}, {regime}"), head: head.collect(), rows }
    }

    /// For each regime, what each method differs by from the first one on the same object and seed: mean over objects and seeds ±
    /// its standard error. Seconds are a ratio, since objects differ.
    pub fn difference_table(&self, done: &[(Cell, Figures)]) -> Option<Table> {
        let (reference, others) = self.methods.split_first()?;
        let seconds = index("seconds")?;
        let kept: Vec<usize> = (0..MEASURES.len())
            .filter(|k| MEASURES[*k].key != "gaussians" && done.iter().any(|(_, f)| f.values[*k].is_some()))
            .collect();
        let mut rows = Vec::new();
        for regime in &self.regimes {
            for (method, _) in others {
                let pairs: Vec<(&Figures, &Figures)> = done
                    .iter()
                    .filter(|(c, _)| c.names[1] == *regime && c.names[2] == *method)
                    .filter_map(|(c, f)| {
                        let same =
                            |o: &Cell| o.names[..2] == c.names[..2] && o.names[2] == reference.0 && o.seed == c.seed;
                        done.iter().find(|(o, _)| same(o)).map(|(_, base)| (f, base))
                    })
                    .collect();
                let entry = |k: &usize| {
                    let m = &MEASURES[*k];
                    let one = |(f, base): &(&Figures, &Figures)| {
                        let (value, base) = (f.values[*k]?, base.values[*k]?);
                        Some(if *k == seconds { value / base } else { (value - base) * m.scale })
                    };
                    let Some((value, deviation, n)) = mean(pairs.iter().map(one)) else {
                        return Entry { text: "–".into(), best: false };
                    };
                    // Of the mean: the sample's deviation over the root of the number.
                    let error = deviation / ((n as f64 - 1.0).max(1.0)).sqrt();
                    let digits = m.digits.max(2);
                    let text = match *k == seconds {
                        true => format!("× {value:.2}"),
                        false => format!("{value:+.digits$} ± {error:.digits$}"),
                    };
                    let good = if m.better == Better::More { value } else { -value };
                    // Marked where it is better by more than two standard errors.
                    Entry { text, best: *k != seconds && n > 1 && good > 2.0 * error }
                };
                let mut entries = vec![Entry { text: pairs.len().to_string(), best: false }];
                entries.extend(kept.iter().map(entry));
                rows.push((format!("{regime}, {method}"), entries));
            }
        }
        let head = ["regime, method".to_owned(), "runs".to_owned()].into_iter();
        let head = head.chain(kept.iter().map(|k| MEASURES[*k].title.to_owned())).collect();
        let title = format!("Difference from {}, over all objects", reference.0);
        (!rows.is_empty()).then_some(Table { title, head, rows })
    }

    /// What the numbers are, for the reader of the tables.
    pub fn legend(&self, done: usize) -> String {
        format!(
            "{done} of {} runs are done. Over all held-out images of a run: PSNR dB ± standard deviation over seeds / SSIM / FLIP, and in \
             brackets PSNR inside the masks; – is not done, LPIPS is left out where it was not measured. IoU: rendered silhouettes \
             against masks; depth error against true geometry, and gap between a view's depth and its neighbours', in per cent of \
             the object's extent; outside: share of points that land beside a neighbour's silhouette. Bold is the best mean, \
             and among differences what is better by more than two standard errors.",
            self.cells().len()
        )
    }

    /// All tables, in the order of the page: headline and the tables below it.
    pub fn tables(&self, done: &[(Cell, Figures)]) -> Vec<(String, Vec<Table>)> {
        let objects = || self.objects.iter().map(|(name, _)| name.as_str());
        let main = objects().map(|o| self.main_table(done, o)).collect();
        let mut out = vec![("Methods and regimes".to_owned(), main)];
        if let Some(table) = self.difference_table(done) {
            out.push(("Differences".to_owned(), vec![table]));
        }
        let mut all = Vec::new();
        for object in objects() {
            all.extend(self.regimes.iter().map(|r| self.ablation_table(done, object, r)));
        }
        // A table without any run says nothing.
        all.retain(|t| t.head.len() > 1);
        out.push(("Every measure".to_owned(), all));
        out
    }

    /// `eval.md`.
    pub fn markdown(&self, done: &[(Cell, Figures)]) -> String {
        let mut out = self.legend(done.len()) + "\n";
        for (headline, tables) in self.tables(done) {
            let _ = write!(out, "\n## {headline}\n");
            for table in tables {
                let _ = write!(
                    out,
                    "\n### {}\n\n| {} |\n|---|{}\n",
                    table.title,
                    table.head.join(" | "),
                    "---|".repeat(table.head.len() - 1)
                );
                for (name, entries) in &table.rows {
                    let cells: Vec<String> = entries
                        .iter()
                        .map(|e| if e.best { format!("**{}**", e.text) } else { e.text.clone() })
                        .collect();
                    let _ = writeln!(out, "| {name} | {} |", cells.join(" | "));
                }
            }
        }
        out
    }
}
