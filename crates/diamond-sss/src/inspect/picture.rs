//! The report as a picture.
use super::canvas::{CHAR_WIDTH, Canvas, Colour, TEXT_HEIGHT};
use super::counted;
use super::findings::{BINS, Cell, Findings, Matrix};
use super::map::{Seen, draw_map};
use diamond_dataset::{Capture, DatasetError, Shot, Split, View};
use diamond_image::Image;

pub(super) const BACKGROUND: Colour = [0.075, 0.082, 0.1];
pub(super) const PANEL: Colour = [0.12, 0.13, 0.155];
pub(super) const FAINT: Colour = [0.28, 0.3, 0.34];
pub(super) const TEXT: Colour = [0.86, 0.87, 0.89];
pub(super) const QUIET: Colour = [0.58, 0.6, 0.64];
pub(super) const TRAIN: Colour = [0.38, 0.66, 1.0];
pub(super) const TEST: Colour = [1.0, 0.56, 0.3];
pub(super) const LIGHT: Colour = [1.0, 0.86, 0.35];
const BROKEN: Colour = [0.95, 0.2, 0.25];
/// Cells from dark to bright images, and cells of images that were not looked at.
const DARK: Colour = [0.13, 0.2, 0.36];
const BRIGHT: Colour = [1.0, 0.87, 0.5];
const UNSEEN: Colour = [0.36, 0.4, 0.47];

const WIDTH: usize = 1280;
const MARGIN: usize = 24;
const INNER: usize = WIDTH - 2 * MARGIN;
const GAP: usize = 16;
/// From one line of text to the next.
const LINE: usize = TEXT_HEIGHT + 8;
const THUMBNAILS: usize = 8;
const THUMBNAIL: usize = (INNER - (THUMBNAILS - 1) * 8) / THUMBNAILS;
const MAP: usize = 400;
const CHART_HEIGHT: usize = 260;
const HISTOGRAM: usize = 6 * BINS;
const KEY: &str = "bright cell: bright image; dark: dim; empty: none; red: broken";

/// What there is in a capture as a picture, 1280 pixels wide: three channels of display sRGB in `[0, 1]`, ready to be
/// stored in 8 bits. At most 512 images are decoded.
///
/// Errors: none of the pictures for the contact sheet can be loaded; the error is that of the first. Single images that
/// cannot be loaded are shown as such.
pub fn inspect_picture(capture: &Capture) -> Result<Image, DatasetError> {
    let findings = Findings::of(capture);
    let sheets: Vec<(&str, Colour, Vec<&Shot>)> =
        [("TRAINING", TRAIN, &capture.train), ("HELD OUT", TEST, &capture.test)]
            .into_iter()
            .filter(|(_, _, views)| !views.is_empty())
            .map(|(name, colour, views)| (name, colour, spread(views)))
            .collect();
    let sheet_height = LINE + THUMBNAIL + 4 + LINE + GAP;
    let top = MARGIN + 2 * LINE + GAP;
    let map_top = top + sheets.len() * sheet_height;
    let chart_top = map_top + LINE + MAP + 2 * GAP;
    let mut canvas = Canvas::new(WIDTH, chart_top + 2 * LINE + CHART_HEIGHT + LINE + MARGIN, BACKGROUND);

    let name = capture.root.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    canvas.text(MARGIN, MARGIN, &format!("CAPTURE  {name}"), INNER, TEXT);
    let (train, test) = (findings.train.filled().0, findings.test.filled().0);
    let summary = format!(
        "{} of {}, {} held out of {}, {}",
        counted(train, "training image"),
        counted(capture.train.len(), "view"),
        test,
        counted(capture.test.len(), "view"),
        counted(findings.intrinsics.len(), "camera model"),
    );
    canvas.text(MARGIN, MARGIN + LINE, &summary, INNER, QUIET);

    let (mut shown, mut first_error) = (0, None);
    for (i, (title, colour, shots)) in sheets.iter().enumerate() {
        let y = top + i * sheet_height;
        canvas.text(MARGIN, y, title, INNER, *colour);
        for (k, shot) in shots.iter().enumerate() {
            let x = MARGIN + k * (THUMBNAIL + 8);
            canvas.fill(x, y + LINE, THUMBNAIL, THUMBNAIL, [0.0; 3]);
            match capture.observation(shot) {
                Ok(observation) => {
                    let (w, h) = (observation.radiance.width(), observation.radiance.height());
                    canvas.thumbnail(x, y + LINE, THUMBNAIL, &observation.display, w, h);
                    shown += 1;
                }
                Err(error) => {
                    canvas.text(x + 8, y + LINE + THUMBNAIL / 2, "unreadable", THUMBNAIL, BROKEN);
                    first_error.get_or_insert(error);
                }
            }
            canvas.text(x, y + LINE + THUMBNAIL + 6, &shot.name, THUMBNAIL, QUIET);
        }
    }
    if let Some(error) = first_error.filter(|_| shown == 0) {
        return Err(error);
    }

    draw_map(&mut canvas, capture, &findings, (MARGIN, map_top), MAP, Seen::FromAbove);
    draw_map(&mut canvas, capture, &findings, (MARGIN + MAP + GAP, map_top), MAP, Seen::FromTheSide);
    legend(&mut canvas, &findings, MARGIN + 2 * (MAP + GAP) + 8, map_top);

    let charts = INNER - HISTOGRAM - 2 * GAP;
    // Both parts by the number of their lights, neither below two fifths.
    let (train, test) = (findings.train.columns.max(1), findings.test.columns);
    let first =
        if test == 0 { charts } else { (charts * train / (train + test)).clamp(charts * 2 / 5, charts * 3 / 5) };
    let right = coverage(&mut canvas, "TRAINING COVERAGE", TRAIN, &findings.train, (MARGIN, chart_top), first - GAP);
    if test > 0 {
        let x = right + 2 * GAP;
        let width = (MARGIN + charts).saturating_sub(x);
        coverage(&mut canvas, "HELD OUT", TEST, &findings.test, (x, chart_top), width);
    }
    canvas.text(MARGIN, chart_top + 2 * LINE + CHART_HEIGHT + 8, KEY, charts, QUIET);
    let x = WIDTH - MARGIN - HISTOGRAM;
    histogram(&mut canvas, &findings, x, chart_top, HISTOGRAM);
    Ok(canvas.into_image())
}

/// At most eight shots: views spread over the split, and a different light of each.
fn spread(views: &[View]) -> Vec<&Shot> {
    let n = THUMBNAILS.min(views.iter().map(|view| view.shots.len()).sum());
    (0..n)
        .filter_map(|k| {
            let shots = &views.get(k * views.len() / n)?.shots;
            shots.get((k * 5) % shots.len().max(1))
        })
        .collect()
}

/// Symbols and facts, to the right of the maps.
fn legend(canvas: &mut Canvas, f: &Findings, x: usize, top: usize) {
    let width = WIDTH - MARGIN - x;
    let mut y = top + LINE + 6;
    let symbol = |canvas: &mut Canvas, y: usize, text: &str, colour: Colour, hollow: bool| {
        let (cx, cy) = (x as f32 + 7.0, y as f32 + 7.0);
        match hollow {
            true => canvas.ring(cx, cy, 5.0, 2.0, colour),
            false => canvas.disc(cx, cy, 5.0, colour),
        }
        canvas.text(x + 24, y, text, width - 24, TEXT);
    };
    for (text, colour, hollow) in [
        ("training camera, looking", TRAIN, false),
        ("held-out camera", TEST, false),
        ("light", LIGHT, false),
        ("light only in held-out", LIGHT, true),
        ("framed by every camera", FAINT, true),
    ] {
        symbol(canvas, y, text, colour, hollow);
        y += LINE;
    }
    y += GAP;
    let range = |r: Option<(f32, f32)>, digits: usize| match r {
        None => "none".to_string(),
        Some((a, b)) if (b - a).abs() < 1e-3 * b.abs() => format!("{a:.digits$}"),
        Some((a, b)) => format!("{a:.digits$} to {b:.digits$}"),
    };
    let degrees = |gap: Option<super::findings::Gap>| gap.map_or("none".to_string(), |g| format!("{:.0}°", g.degrees));
    let masks = match (f.masked, f.examined.0) {
        (0, _) => "none".to_string(),
        (a, b) if a == b => "all images".to_string(),
        (a, b) => format!("{a} of {b}"),
    };
    let (seen, unseen) = f.seen_unseen;
    for (name, value) in [
        ("camera distance", range(f.camera_distance, 2)),
        ("light distance", range(f.light_distance, 2)),
        ("field of view", format!("{}°", range(f.fov_x, 1))),
        ("view gap", degrees(f.camera_gap)),
        ("light gap", degrees(f.light_gap)),
        ("masks", masks),
        ("object covers", f.coverage.map_or("unknown".into(), |c| format!("{:.1} %", 100.0 * c))),
        ("held out, seen", counted(seen, "image")),
        ("held out, new", counted(unseen, "image")),
        ("unreadable", counted(f.failures.len(), "image")),
    ] {
        canvas.text(x, y, name, width, QUIET);
        canvas.text(x + 16 * CHAR_WIDTH, y, &value, width.saturating_sub(16 * CHAR_WIDTH), TEXT);
        y += LINE;
    }
}

/// Rows of views, columns of lights; returns the right edge.
fn coverage(
    canvas: &mut Canvas,
    title: &str,
    colour: Colour,
    matrix: &Matrix,
    (x, y): (usize, usize),
    width: usize,
) -> usize {
    let (filled, cells) = matrix.filled();
    let (rows, columns) = (matrix.rows.len().max(1), matrix.columns.max(1));
    // Whole pixels where there is room, fractions for grids larger than the panel.
    let fit = |room: usize, count: usize| {
        let size = (room as f32 / count as f32).min(28.0);
        if size >= 1.0 { size.floor() } else { size }
    };
    let (cell_x, cell_y) = (fit(width, columns), fit(CHART_HEIGHT, rows));
    canvas.text(x, y, title, width, colour);
    let missing = if filled < cells { format!(", {} missing", cells - filled) } else { String::new() };
    let facts = format!("{} x {}{missing}", counted(matrix.rows.len(), "view"), counted(columns, "light"));
    canvas.text(x, y + LINE, &facts, width, QUIET);
    let top = y + 2 * LINE;
    let levels = || matrix.rows.iter().flatten().filter_map(|c| if let Cell::Level(v) = c { Some(*v) } else { None });
    let (least, most) = (levels().fold(1.0, f32::min), levels().fold(0.0, f32::max));
    let paint = |v: f32| (v - least) / (most - least).max(1e-3);
    let extent = |cell: f32| ((cell.ceil() as usize).max(1) - usize::from(cell >= 4.0)).max(1);
    for (j, row) in matrix.rows.iter().enumerate() {
        for (i, content) in row.iter().enumerate() {
            let (cx, cy) = (x + (i as f32 * cell_x) as usize, top + (j as f32 * cell_y) as usize);
            let colour = match content {
                Cell::Missing => PANEL,
                Cell::Present => UNSEEN,
                Cell::Broken => BROKEN,
                Cell::Level(v) => mix(paint(*v)),
            };
            canvas.fill(cx, cy, extent(cell_x), extent(cell_y), colour);
        }
    }
    x + ((columns as f32 * cell_x) as usize).max(facts.len().max(title.len()) * CHAR_WIDTH).min(width)
}

/// From dark blue to bright yellow as `t` goes from 0 to 1.
fn mix(t: f32) -> Colour {
    // Through a reddish middle, so that the scale does not turn grey half way.
    const MIDDLE: Colour = [0.62, 0.36, 0.42];
    let (from, to, u) = if t < 0.5 { (DARK, MIDDLE, 2.0 * t) } else { (MIDDLE, BRIGHT, 2.0 * t - 1.0) };
    [0, 1, 2].map(|c| from[c] + (to[c] - from[c]) * u.clamp(0.0, 1.0))
}

/// Brightness of the object's pixels.
fn histogram(canvas: &mut Canvas, f: &Findings, x: usize, y: usize, width: usize) {
    let (clipped, black) = f.exposure.fractions();
    let title = if f.masked > 0 { "BRIGHTNESS OF THE OBJECT" } else { "BRIGHTNESS (NO MASKS)" };
    canvas.text(x, y, title, width, TEXT);
    let facts = format!("clipped {:.2} %   black {:.2} %", 100.0 * clipped, 100.0 * black);
    canvas.text(x, y + LINE, &facts, width, QUIET);
    let (top, bar) = (y + 2 * LINE, width / BINS);
    canvas.fill(x, top, bar * BINS, CHART_HEIGHT, PANEL);
    // Without masks the black background would dwarf everything else: its bar is cut.
    let counted = &f.exposure.histogram[usize::from(f.masked == 0)..];
    let most = counted.iter().copied().max().unwrap_or(0).max(1) as f32;
    for (i, &n) in f.exposure.histogram.iter().enumerate() {
        let height = ((n as f32 / most).min(1.0) * (CHART_HEIGHT - 8) as f32).ceil() as usize;
        let t = i as f32 / (BINS - 1) as f32;
        let colour = mix(t);
        canvas.fill(x + i * bar, top + CHART_HEIGHT - height, bar - 1, height, colour);
    }
    for (value, at) in [("0", 0), ("128", BINS / 2), ("255", BINS)] {
        let shift = match at {
            0 => 0,
            BINS => value.len() * CHAR_WIDTH,
            _ => value.len() * CHAR_WIDTH / 2,
        };
        canvas.text(x + at * bar - shift, top + CHART_HEIGHT + 8, value, 60, QUIET);
    }
}

/// Whether a light of the held-out split is in training too.
pub(super) fn only_held_out(capture: &Capture) -> Vec<diamond_light::OlatLight> {
    let shots = capture.views(Split::Test).iter().flat_map(|view| &view.shots);
    shots.map(|shot| shot.light).filter(|light| !capture.is_seen_light(light)).collect()
}
