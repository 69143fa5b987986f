//! Curves as inline SVG.
use std::fmt::Write;

const WIDTH: f64 = 420.0;
const HEIGHT: f64 = 210.0;
const LEFT: f64 = 54.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 30.0;

/// A step of 1, 2 or 5 times a power of ten that divides `span` into at most five parts or so.
fn tick(span: f64) -> f64 {
    let raw = (span / 4.0).max(1e-12);
    let power = 10f64.powf(raw.log10().floor());
    let lead = raw / power;
    power
        * if lead <= 1.0 {
            1.0
        } else if lead <= 2.0 {
            2.0
        } else if lead <= 5.0 {
            5.0
        } else {
            10.0
        }
}

fn label(v: f64) -> String {
    match v.abs() {
        a if a >= 10_000.0 => format!("{}k", (v / 100.0).round() / 10.0),
        a if a >= 100.0 || a == 0.0 => format!("{v:.0}"),
        a if a >= 1.0 => format!("{}", (v * 100.0).round() / 100.0),
        a if a >= 1e-3 => format!("{}", (v * 10_000.0).round() / 10_000.0),
        _ => format!("{v:.0e}"),
    }
}

/// A curve through `points` (x ascending), with axes; `from_zero` makes the vertical axis begin at 0.
pub fn chart(title: &str, unit: &str, points: &[(f64, f64)], from_zero: bool) -> String {
    let points: Vec<(f64, f64)> = points.iter().copied().filter(|p| p.0.is_finite() && p.1.is_finite()).collect();
    let mut out = format!("<figure class=\"chart\"><figcaption>{title} <span>{unit}</span></figcaption>");
    let Some((last_x, last_y)) = points.last().copied() else { return out + "<p>no data</p></figure>" };
    let fold = |f: fn(f64, f64) -> f64, start: f64| points.iter().map(|p| p.1).fold(start, f);
    let (mut low, mut high) = (fold(f64::min, f64::INFINITY), fold(f64::max, f64::NEG_INFINITY));
    if from_zero {
        low = low.min(0.0);
    }
    if high - low < 1e-9 * high.abs().max(1e-9) {
        (low, high) = (low - 0.5 * low.abs().max(1e-3), high + 0.5 * high.abs().max(1e-3));
    }
    let step = tick(high - low);
    (low, high) = ((low / step).floor() * step, (high / step).ceil() * step);
    let end = last_x.max(1.0);
    let x = |v: f64| LEFT + v / end * (WIDTH - LEFT - RIGHT);
    let y = |v: f64| HEIGHT - BOTTOM - (v - low) / (high - low) * (HEIGHT - TOP - BOTTOM);
    // Writing to a string cannot fail.
    let _ = write!(out, "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{title}\">");
    let lines = ((high - low) / step).round() as usize;
    for i in 0..=lines {
        let v = low + i as f64 * step;
        let _ = write!(
            out,
            "<line class=\"grid\" x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{:.1}\" y2=\"{:.1}\"/>\
             <text class=\"y\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
            WIDTH - RIGHT,
            y(v),
            y(v),
            LEFT - 7.0,
            y(v) + 4.0,
            label(v)
        );
    }
    let across = tick(end).max(1.0);
    let mut v = 0.0;
    while v <= end {
        let _ = write!(out, "<text class=\"x\" x=\"{:.1}\" y=\"{:.1}\">{}</text>", x(v), HEIGHT - 9.0, label(v));
        v += across;
    }
    let path: Vec<String> = points.iter().map(|p| format!("{:.1},{:.1}", x(p.0), y(p.1))).collect();
    let _ = write!(
        out,
        "<polyline points=\"{}\"/><circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3.5\"/></svg></figure>",
        path.join(" "),
        x(last_x),
        y(last_y)
    );
    out
}

/// A curve of several: name, colour, points.
pub type Curve<'a> = (&'a str, &'a str, Vec<(f64, f64)>);

/// A file with several curves over a logarithmic axis from above 0, with a legend.
pub fn curves(title: &str, across: &str, up: &str, curves: &[Curve<'_>]) -> String {
    const W: f64 = 640.0;
    const H: f64 = 360.0;
    let all = || curves.iter().flat_map(|c| &c.2).filter(|p| p.0 > 0.0 && p.0.is_finite() && p.1.is_finite());
    let fold = |f: fn(f64, f64) -> f64, start: f64, of: fn(&(f64, f64)) -> f64| all().map(of).fold(start, f);
    let (left, right) = (fold(f64::min, f64::INFINITY, |p| p.0), fold(f64::max, 0.0, |p| p.0));
    let high = fold(f64::max, 0.0, |p| p.1).max(1e-9);
    let step = tick(high);
    let high = (high / step).ceil() * step;
    let span = (right / left).ln().max(1e-9);
    let x = |v: f64| 64.0 + (v / left).ln() / span * (W - 84.0);
    let y = |v: f64| H - 52.0 - v / high * (H - 96.0);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {W} {H}\" font-family=\"sans-serif\" font-size=\"12\">\
         <rect width=\"{W}\" height=\"{H}\" fill=\"white\"/><text x=\"64\" y=\"22\" font-size=\"15\">{title}</text>"
    );
    // Writing to a string cannot fail.
    let mut v = 0.0;
    while v <= high * (1.0 + 1e-9) {
        let _ = write!(
            out,
            "<line x1=\"64\" x2=\"{:.1}\" y1=\"{:.1}\" y2=\"{:.1}\" stroke=\"#ddd\"/><text x=\"58\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            W - 20.0,
            y(v),
            y(v),
            y(v) + 4.0,
            label(v)
        );
        v += step;
    }
    for power in -6..=6 {
        for lead in [1.0, 2.0, 5.0] {
            let v = lead * 10f64.powi(power);
            if v >= left && v <= right {
                let _ = write!(
                    out,
                    "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                    x(v),
                    H - 34.0,
                    label(v)
                );
            }
        }
    }
    let _ = write!(
        out,
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{across}</text><text x=\"64\" y=\"38\" fill=\"#555\">{up}</text>",
        0.5 * W,
        H - 12.0
    );
    for (k, (name, colour, points)) in curves.iter().enumerate() {
        let usable = points.iter().filter(|p| p.0 > 0.0 && p.0.is_finite() && p.1.is_finite());
        let path: Vec<String> = usable.map(|p| format!("{:.1},{:.1}", x(p.0), y(p.1))).collect();
        let _ = write!(
            out,
            "<polyline fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\" points=\"{}\"/><text x=\"{:.1}\" y=\"22\" fill=\"{colour}\">{name}</text>",
            path.join(" "),
            W - 190.0 + 56.0 * k as f64
        );
    }
    out + "</svg>\n"
}

/// Means over neighbours, so that at most `count` points remain and single steps do not hide the course.
pub fn smooth(points: &[(f64, f64)], count: usize) -> Vec<(f64, f64)> {
    let size = points.len().div_ceil(count.max(1)).max(1);
    points.chunks(size).map(|c| (c[c.len() - 1].0, c.iter().map(|p| p.1).sum::<f64>() / c.len() as f64)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn odd_data_make_a_chart_without_nan() {
        for data in [vec![], vec![(1.0, 5.0)], vec![(1.0, 0.0), (2.0, 0.0)], vec![(1.0, f64::NAN), (2.0, 1e-9)]] {
            for zero in [false, true] {
                let svg = chart("t", "dB", &data, zero);
                assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
            }
        }
        for data in [vec![], vec![(0.0, 1.0)], vec![(1.0, f64::NAN)], vec![(0.1, 0.2), (1.0, 0.0)]] {
            let svg = curves("t", "x", "y", &[("a", "red", data)]);
            assert!(!svg.contains("NaN") && !svg.contains("inf") && svg.ends_with("</svg>\n"), "{svg}");
        }
        assert_eq!(smooth(&[(1.0, 1.0), (2.0, 3.0), (3.0, 5.0)], 2), [(2.0, 2.0), (3.0, 5.0)]);
    }
}
