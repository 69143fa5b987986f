//! Parallel coordinates: an axis for each setting and one for the result, a line for each trial.
use super::search::Span;
use crate::eval::page::{escape, page};
use std::fmt::Write as _;

/// A trial that is done.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    /// Its number.
    pub number: u64,
    /// Values of the settings.
    pub values: Vec<toml::Value>,
    /// The result.
    pub result: f64,
}

const HEIGHT: f64 = 420.0;
const TOP: f64 = 60.0;
const BOTTOM: f64 = 30.0;
const LEFT: f64 = 90.0;
const GAP: f64 = 170.0;

/// From dark blue over green to yellow, for 0 to 1.
fn colour(share: f64) -> String {
    const STOPS: [[f64; 3]; 5] =
        [[68.0, 1.0, 84.0], [59.0, 82.0, 139.0], [33.0, 145.0, 140.0], [94.0, 201.0, 98.0], [238.0, 206.0, 30.0]];
    let at = share.clamp(0.0, 1.0) * 4.0;
    let k = (at as usize).min(3);
    let mix = |c: usize| STOPS[k][c] + (STOPS[k + 1][c] - STOPS[k][c]) * (at - k as f64);
    format!("#{:02x}{:02x}{:02x}", mix(0) as u8, mix(1) as u8, mix(2) as u8)
}

fn show(value: &toml::Value) -> String {
    match value {
        toml::Value::String(text) => text.clone(),
        toml::Value::Float(v) => format!("{}", format!("{v:.2e}").parse::<f64>().unwrap_or(*v)),
        other => other.to_string(),
    }
}

/// Values and names that an axis is labelled with: bottom, middle and top, or all choices.
fn labels(span: &Span) -> Vec<(f64, String)> {
    match span {
        Span::Choices(choices) => choices.iter().filter_map(|c| Some((span.place(c)?, show(c)))).collect(),
        Span::Numbers { .. } => [0.0, 0.25, 0.5, 0.75, 1.0].map(|p| (p, show(&span.value(p)))).to_vec(),
    }
}

/// The plot as SVG. `names` are those of the settings, `result` that of the result; the best line is thick and on top.
pub fn parallel_coordinates(
    names: &[String],
    spans: &[Span],
    result: &str,
    more_is_better: bool,
    points: &[Point],
) -> String {
    let sign = if more_is_better { 1.0 } else { -1.0 };
    let mut points: Vec<&Point> = points.iter().filter(|p| p.result.is_finite()).collect();
    points.sort_by(|a, b| (sign * a.result).total_cmp(&(sign * b.result)));
    let range = |f: fn(f64, f64) -> f64, start: f64| points.iter().map(|p| p.result).fold(start, f);
    let (mut low, mut high) = (range(f64::min, f64::INFINITY), range(f64::max, f64::NEG_INFINITY));
    if points.is_empty() {
        (low, high) = (0.0, 1.0);
    }
    if high - low < 1e-9 {
        (low, high) = (low - 0.5, high + 0.5);
    }
    let width = LEFT + GAP * names.len() as f64 + 110.0;
    let x = |axis: usize| LEFT + GAP * axis as f64;
    let y = |place: f64| HEIGHT - BOTTOM - place * (HEIGHT - TOP - BOTTOM);
    let share = |v: f64| (v - low) / (high - low);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {HEIGHT}\" width=\"{width}\" font-family=\"system-ui, sans-serif\" \
         font-size=\"12\" role=\"img\" aria-label=\"Trials of a search as parallel coordinates\">\
         <rect width=\"{width}\" height=\"{HEIGHT}\" fill=\"white\"/>"
    );
    for (k, point) in points.iter().enumerate() {
        let places = spans.iter().zip(&point.values).map(|(s, v)| s.place(v));
        let Some(places) = places.collect::<Option<Vec<f64>>>() else { continue };
        let good = if more_is_better { share(point.result) } else { 1.0 - share(point.result) };
        let line: Vec<String> = places
            .iter()
            .chain([&share(point.result)])
            .enumerate()
            .map(|(axis, place)| format!("{:.1},{:.1}", x(axis), y(*place)))
            .collect();
        let best = k + 1 == points.len();
        let _ = write!(
            out,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"{}\" stroke-opacity=\"{}\"><title>trial {}: {} \
             {:.3}</title></polyline>",
            line.join(" "),
            if best { "#c0171d".to_owned() } else { colour(good) },
            if best { 3.5 } else { 1.6 },
            if best { 1.0 } else { 0.8 },
            point.number,
            escape(result),
            point.result
        );
    }
    let ends: Vec<(f64, String)> =
        [0.0, 0.25, 0.5, 0.75, 1.0].map(|p| (p, format!("{:.2}", low + p * (high - low)))).to_vec();
    let axes = names.iter().zip(spans).map(|(name, span)| (name.as_str(), labels(span))).chain([(result, ends)]);
    for (axis, (name, labels)) in axes.enumerate() {
        let at = x(axis);
        // Long names in two lines.
        let (first, second) = name.split_once('.').unwrap_or(("", name));
        let _ = write!(
            out,
            "<line x1=\"{at}\" x2=\"{at}\" y1=\"{:.1}\" y2=\"{:.1}\" stroke=\"#222\" stroke-width=\"1.5\"/>\
             <text x=\"{at}\" y=\"20\" text-anchor=\"middle\" fill=\"#555\">{}</text>\
             <text x=\"{at}\" y=\"38\" text-anchor=\"middle\" font-weight=\"bold\">{}</text>",
            y(0.0),
            y(1.0),
            escape(first),
            escape(second)
        );
        for (place, text) in labels {
            let _ = write!(
                out,
                "<line x1=\"{0:.1}\" x2=\"{at}\" y1=\"{1:.1}\" y2=\"{1:.1}\" stroke=\"#222\"/><text x=\"{2:.1}\" y=\"{3:.1}\" text-anchor=\"end\" \
                 paint-order=\"stroke\" stroke=\"white\" stroke-width=\"3\">{4}</text>",
                at - 5.0,
                y(place),
                at - 8.0,
                y(place) + 4.0,
                escape(&text)
            );
        }
    }
    out + "</svg>\n"
}

/// One page: what was searched, the plot, and the trials, best first.
pub fn html(legend: &str, names: &[String], result: &str, more_is_better: bool, points: &[Point], svg: &str) -> String {
    let mut body = format!("<p class=\"quiet\">{}</p><div class=\"wide\">{svg}</div>", escape(legend));
    body += "<h2>Trials, best first</h2><div class=\"wide\"><table><thead><tr><th>trial</th>";
    names.iter().map(String::as_str).chain([result]).for_each(|name| body += &format!("<th>{}</th>", escape(name)));
    body += "</tr></thead><tbody>";
    let sign = if more_is_better { -1.0 } else { 1.0 };
    let mut sorted: Vec<&Point> = points.iter().collect();
    sorted.sort_by(|a, b| (sign * a.result).total_cmp(&(sign * b.result)));
    for (k, point) in sorted.iter().enumerate() {
        let class = if k == 0 && point.result.is_finite() { " class=\"best\"" } else { "" };
        let _ = write!(body, "<tr><td>{}</td>", point.number);
        point.values.iter().for_each(|v| body += &format!("<td>{}</td>", escape(&show(v))));
        let text = if point.result.is_finite() { format!("{:.3}", point.result) } else { "failed".into() };
        let _ = write!(body, "<td{class}>{text}</td></tr>");
    }
    page("Search of settings", &(body + "</tbody></table></div>"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_trial_is_a_line_and_the_best_is_on_top() {
        let spans = [
            Span::Numbers { from: 1e-3, to: 1.0, log: true, whole: false },
            Span::Choices(vec!["bce".into(), "l1".into()]),
        ];
        let names = ["loss.a".to_owned(), "consistency.penalty".to_owned()];
        let point = |number, a: f64, p: &str, result| Point { number, values: vec![a.into(), p.into()], result };
        let points = [point(0, 0.01, "bce", 30.0), point(1, 1.0, "l1", 33.0), point(2, 1e-3, "l1", f64::NAN)];
        for (more, best) in [(true, 1), (false, 0)] {
            let svg = parallel_coordinates(&names, &spans, "PSNR dB", more, &points);
            assert_eq!(svg.matches("<polyline").count(), 2);
            let last = svg.rsplit("<polyline").next().unwrap();
            assert!(last.contains("#c0171d") && last.contains(&format!("trial {best}:")), "{svg}");
            assert!(!svg.contains("NaN") && svg.contains("penalty") && svg.contains("bce"), "{svg}");
            let page = html("what", &names, "PSNR dB", more, &points, &svg);
            assert!(page.contains("failed") && page.contains("class=\"best\""), "{page}");
        }
        for few in [&points[..0], &points[..1], &points[2..]] {
            let svg = parallel_coordinates(&names, &spans, "PSNR dB", true, few);
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
        assert_ne!(colour(0.0), colour(1.0));
    }
}
