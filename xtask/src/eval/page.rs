//! `eval.html`: the tables of an evaluation, and for each object a plot of all runs.
use super::figures::{Figures, MEASURES};
use super::tables::mean;
use super::{Cell, Grid};
use std::fmt::Write as _;

/// Colours that are told apart by everyone (Okabe and Ito), in the order of methods.
pub const COLOURS: [&str; 7] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000"];

const WIDTH: f64 = 760.0;
const LEFT: f64 = 190.0;
const RIGHT: f64 = 20.0;
const ROW: f64 = 18.0;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1200px;padding:0 1rem;color:#1c1c1c}\
h1,h2,h3{line-height:1.2}h2{margin-top:2.5rem}.quiet{color:#555}.wide{overflow-x:auto}\
table{border-collapse:collapse;margin:.5rem 0 1.5rem;font-variant-numeric:tabular-nums}\
th,td{padding:.3rem .7rem;border-bottom:1px solid #ddd;text-align:right;white-space:nowrap}\
th:first-child,td:first-child{text-align:left}thead th{border-bottom:2px solid #999}\
td.best{font-weight:700;background:#eef6ee}svg{max-width:100%;height:auto}svg text{font:12px system-ui,sans-serif;fill:#333}\
.pictures{display:flex;gap:.6rem}figure{margin:0}img{display:block}figcaption{font-size:12px;max-width:160px}";

/// Text for HTML.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A page around a body.
pub fn page(title: &str, body: &str) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\"><title>{title}</title><style>{STYLE}</style></head>\
         <body><h1>{title}</h1>{body}</body></html>\n",
        title = escape(title)
    )
}

impl Grid {
    /// PSNR of each run of an object as a dot, a row per regime and method, and its mean as a bar. Empty where nothing is done.
    fn dots(&self, done: &[(Cell, Figures)], object: &str) -> String {
        let psnr = |f: &Figures| f.values[0].filter(|v| v.is_finite());
        let of = |regime: &str, method: &str| -> Vec<f64> {
            done.iter().filter(|(c, _)| c.names == [object, regime, method]).filter_map(|(_, f)| psnr(f)).collect()
        };
        let all = || done.iter().filter(|(c, _)| c.names[0] == object).filter_map(|(_, f)| psnr(f));
        let (low, high) = (all().fold(f64::INFINITY, f64::min).floor(), all().fold(f64::NEG_INFINITY, f64::max).ceil());
        if !low.is_finite() {
            return String::new();
        }
        let high = high.max(low + 1.0);
        let x = |v: f64| LEFT + (v - low) / (high - low) * (WIDTH - LEFT - RIGHT);
        let mut rows = String::new();
        let mut y = 10.0;
        for regime in &self.regimes {
            for (k, (method, _)) in self.methods.iter().enumerate() {
                y += ROW;
                let colour = COLOURS[k % COLOURS.len()];
                let _ = write!(
                    rows,
                    "<text x=\"{:.0}\" y=\"{:.1}\" text-anchor=\"end\">{}, {}</text>",
                    LEFT - 10.0,
                    y + 4.0,
                    escape(regime),
                    escape(method)
                );
                let values = of(regime, method);
                if let Some((value, _, _)) = mean(values.iter().map(|v| Some(*v))) {
                    let _ = write!(
                        rows,
                        "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"3\" height=\"12\" fill=\"{colour}\"/>",
                        x(value) - 1.5,
                        y - 6.0
                    );
                }
                for value in values {
                    let _ = write!(
                        rows,
                        "<circle cx=\"{:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{colour}\" fill-opacity=\".45\"><title>{value:.3} dB</title>\
                         </circle>",
                        x(value)
                    );
                }
            }
            y += ROW * 0.5;
        }
        let step = ((high - low) / 8.0).ceil().max(1.0);
        let mut grid = String::new();
        let mut v = low;
        while v <= high {
            let _ = write!(
                grid,
                "<line x1=\"{0:.1}\" x2=\"{0:.1}\" y1=\"14\" y2=\"{1:.1}\" stroke=\"#ddd\"/><text x=\"{0:.1}\" y=\"{2:.1}\" \
                 text-anchor=\"middle\">{v:.0}</text>",
                x(v),
                y + 4.0,
                y + 18.0
            );
            v += step;
        }
        format!(
            "<svg viewBox=\"0 0 {WIDTH} {:.0}\" width=\"{WIDTH}\" role=\"img\" aria-label=\"PSNR of every run of {}\">{grid}{rows}\
             <text x=\"{:.0}\" y=\"{:.0}\" text-anchor=\"end\">PSNR, dB</text></svg>",
            y + 24.0,
            escape(object),
            LEFT - 10.0,
            y + 18.0
        )
    }

    /// `eval.html`: self-contained, without scripts.
    pub fn html(&self, done: &[(Cell, Figures)]) -> String {
        let mut body = format!("<p class=\"quiet\">{}</p>", escape(&self.legend(done.len())));
        for (headline, tables) in self.tables(done) {
            let _ = write!(body, "<h2>{}</h2>", escape(&headline));
            for table in tables {
                let _ = write!(body, "<h3>{}</h3><div class=\"wide\"><table><thead><tr>", escape(&table.title));
                table.head.iter().for_each(|name| body += &format!("<th>{}</th>", escape(name)));
                body += "</tr></thead><tbody>";
                for (name, entries) in &table.rows {
                    let _ = write!(body, "<tr><td>{}</td>", escape(name));
                    for entry in entries {
                        let class = if entry.best { " class=\"best\"" } else { "" };
                        let _ = write!(body, "<td{class}>{}</td>", escape(&entry.text));
                    }
                    body += "</tr>";
                }
                body += "</tbody></table></div>";
            }
        }
        let _ = write!(body, "<h2>Every run: {}</h2>", MEASURES[0].title);
        for (object, _) in &self.objects {
            let dots = self.dots(done, object);
            if !dots.is_empty() {
                let _ = write!(body, "<h3>{}</h3>{dots}", escape(object));
            }
        }
        body += &self.pictures(done);
        body += "<h2>Captures and revisions</h2><div class=\"wide\"><table><thead><tr><th>object</th><th>folder</th>\
                 <th>hash</th><th>revisions of its runs</th></tr></thead><tbody>";
        for (object, folder) in &self.objects {
            let list = |of: fn(&Figures) -> &str| {
                let mut all: Vec<&str> = done
                    .iter()
                    .filter(|(c, _)| c.names[0] == *object)
                    .map(|(_, f)| of(f))
                    .filter(|t| !t.is_empty())
                    .collect();
                all.sort_unstable();
                all.dedup();
                escape(&all.iter().map(|t| t.chars().take(20).collect::<String>()).collect::<Vec<_>>().join(", "))
            };
            let _ = write!(
                body,
                "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
                escape(object),
                escape(&folder.display().to_string()),
                list(|f| &f.capture),
                list(|f| &f.revision)
            );
        }
        body += "</tbody></table></div>";
        page("Evaluation", &body)
    }
}
