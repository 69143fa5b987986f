//! Curves in logarithmic axes, several panels in one SVG.
use std::fmt::Write;

const WIDTH: f64 = 440.0;
const HEIGHT: f64 = 300.0;
const LEFT: f64 = 56.0;
const RIGHT: f64 = 16.0;
const TOP: f64 = 30.0;
const BOTTOM: f64 = 44.0;
const COLOURS: [&str; 6] = ["#1f5fa8", "#b8451f", "#3a7d44", "#8a5aa8", "#a8871f", "#555555"];

/// A line of points (x, y), each with a word beside it.
pub struct Curve {
    /// For the legend.
    pub name: String,
    /// Positive numbers.
    pub points: Vec<(f64, f64)>,
    /// One for each point.
    pub labels: Vec<String>,
}

/// One pair of axes.
pub struct Panel {
    /// Above it.
    pub title: String,
    /// In it.
    pub curves: Vec<Curve>,
}

/// 1, 2 and 5 times the powers of ten in a range, with whether they get a number.
fn ticks(low: f64, high: f64) -> Vec<f64> {
    let first = low.log10().floor() as i32;
    let last = high.log10().ceil() as i32;
    (first..=last)
        .flat_map(|k| [1.0, 2.0, 5.0].map(|m| m * 10f64.powi(k)))
        .filter(|v| (low..=high).contains(v))
        .collect()
}

/// All panels in two columns, with the same axes.
pub fn panels(panels: &[Panel], x_axis: &str, y_axis: &str) -> String {
    let all = || panels.iter().flat_map(|p| &p.curves).flat_map(|c| &c.points);
    let range = |f: &dyn Fn(&(f64, f64)) -> f64| {
        let low = all().map(f).fold(f64::INFINITY, f64::min);
        let high = all().map(f).fold(0.0, f64::max);
        (low / 1.3, high * 1.3)
    };
    let ((x0, x1), (y0, y1)) = (range(&|p| p.0), range(&|p| p.1));
    let rows = panels.len().div_ceil(2) as f64;
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" font-family=\"sans-serif\" font-size=\"11\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n",
        2.0 * WIDTH,
        rows * HEIGHT
    );
    let x = |v: f64| LEFT + (v / x0).ln() / (x1 / x0).ln() * (WIDTH - LEFT - RIGHT);
    let y = |v: f64| HEIGHT - BOTTOM - (v / y0).ln() / (y1 / y0).ln() * (HEIGHT - TOP - BOTTOM);
    for (k, panel) in panels.iter().enumerate() {
        // Writing to a string cannot fail.
        let _ = writeln!(out, "<g transform=\"translate({},{})\">", (k % 2) as f64 * WIDTH, (k / 2) as f64 * HEIGHT);
        let _ = writeln!(out, "<text x=\"{LEFT}\" y=\"18\" font-weight=\"bold\">{}</text>", panel.title);
        for v in ticks(x0, x1) {
            let (at, bottom) = (x(v), HEIGHT - BOTTOM);
            let _ = writeln!(
                out,
                "<path d=\"M{at:.1} {TOP}V{bottom}\" stroke=\"#ddd\"/><text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\" \
                 fill=\"#555\">{v}</text>",
                bottom + 14.0
            );
        }
        for v in ticks(y0, y1) {
            let at = y(v);
            let _ = writeln!(
                out,
                "<path d=\"M{LEFT} {at:.1}H{}\" stroke=\"#ddd\"/><text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\" \
                 fill=\"#555\">{v}</text>",
                WIDTH - RIGHT,
                LEFT - 5.0,
                at + 4.0
            );
        }
        let _ = writeln!(
            out,
            "<text x=\"{}\" y=\"{}\" text-anchor=\"end\" fill=\"#555\">{x_axis}</text>\
             <text transform=\"translate(13,{TOP}) rotate(-90)\" text-anchor=\"end\" fill=\"#555\">{y_axis}</text>",
            WIDTH - RIGHT,
            HEIGHT - 10.0
        );
        for (i, curve) in panel.curves.iter().enumerate() {
            let colour = COLOURS[i % COLOURS.len()];
            let line: Vec<String> = curve.points.iter().map(|p| format!("{:.1},{:.1}", x(p.0), y(p.1))).collect();
            let _ = writeln!(
                out,
                "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.6\"/>",
                line.join(" ")
            );
            for (point, label) in curve.points.iter().zip(&curve.labels) {
                let _ = writeln!(
                    out,
                    "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"2.6\" fill=\"{colour}\"/>\
                     <text x=\"{:.1}\" y=\"{:.1}\" fill=\"{colour}\" font-size=\"9.5\">{label}</text>",
                    x(point.0),
                    y(point.1),
                    x(point.0) + 4.0,
                    y(point.1) - 4.0
                );
            }
            if panel.curves.len() > 1 {
                let at = TOP + 14.0 + 14.0 * i as f64;
                let _ = writeln!(
                    out,
                    "<text x=\"{}\" y=\"{at}\" text-anchor=\"end\" fill=\"{colour}\">{}</text>",
                    WIDTH - RIGHT - 6.0,
                    curve.name
                );
            }
        }
        out.push_str("</g>\n");
    }
    out + "</svg>\n"
}
