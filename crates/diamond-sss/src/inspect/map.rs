//! Cameras and lights around the scene, seen from above or from the side.
use super::canvas::{Canvas, TEXT_HEIGHT};
use super::findings::Findings;
use super::picture::{FAINT, LIGHT, PANEL, QUIET, TEST, TEXT, TRAIN, only_held_out};
use diamond_dataset::{Capture, View, light_direction};
use diamond_light::OlatLight;
use glam::Vec3;

/// Where the map is seen from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Seen {
    /// Up points at the reader.
    FromAbove,
    /// Up points up on the page.
    FromTheSide,
}

/// World axes on the page.
struct Axes {
    right: Vec3,
    up: Vec3,
}

impl Axes {
    fn of(up: Vec3, seen: Seen) -> Self {
        // The next world axis after `up` lies to the right; the page is right-handed seen from where the reader is.
        let right = Vec3::new(up.z.abs(), up.x.abs(), up.y.abs());
        match seen {
            Seen::FromAbove => Axes { right, up: up.cross(right) },
            Seen::FromTheSide => Axes { right, up },
        }
    }
}

/// `+x` and the like.
fn axis_name(axis: Vec3) -> &'static str {
    let names = [("+x", Vec3::X), ("-x", Vec3::NEG_X), ("+y", Vec3::Y), ("-y", Vec3::NEG_Y), ("+z", Vec3::Z)];
    names.into_iter().find(|(_, v)| v.abs_diff_eq(axis, 1e-3)).map_or("-z", |(name, _)| name)
}

/// Draws one map, `size` pixels square under a line with its title.
pub(super) fn draw_map(
    canvas: &mut Canvas,
    capture: &Capture,
    f: &Findings,
    (x, y): (usize, usize),
    size: usize,
    seen: Seen,
) {
    let title = match seen {
        Seen::FromAbove => format!("FROM ABOVE  (up is {})", axis_name(f.up)),
        Seen::FromTheSide => "FROM THE SIDE".to_string(),
    };
    canvas.text(x, y, &title, size, TEXT);
    let top = y + TEXT_HEIGHT + 8;
    canvas.fill(x, top, size, size, PANEL);
    let axes = Axes::of(f.up, seen);
    let (cx, cy, half) = (x as f32 + 0.5 * size as f32, top as f32 + 0.5 * size as f32, 0.5 * size as f32);
    let reach = reach(capture, f);
    let scale = (half - 22.0) / reach;
    // What lies beyond the map is drawn on its border.
    let to_page = |p: Vec3| {
        let q = (p - f.scene.centre) * scale;
        let (u, v) = (q.dot(axes.right), q.dot(axes.up));
        let limit = half - 8.0;
        let shrink = (limit / u.abs().max(v.abs()).max(limit)).min(1.0);
        (cx + u * shrink, cy - v * shrink)
    };
    for axis in [axes.right, -axes.right, axes.up, -axes.up] {
        canvas.line((cx, cy), to_page(f.scene.centre + axis * reach), 1.0, FAINT.map(|v| 0.7 * v));
    }
    canvas.ring(cx, cy, f.scene.framed_radius * scale, 1.5, FAINT);
    canvas.text(x + size - 28, cy as usize + 6, axis_name(axes.right), 40, QUIET);
    canvas.text(cx as usize + 6, top + 6, axis_name(axes.up), 40, QUIET);

    let place = |light: &OlatLight| match *light {
        OlatLight::Point { position, .. } => position,
        OlatLight::Directional { .. } => f.scene.centre + light_direction(light, f.scene.centre) * reach,
    };
    // Farther ones first, so that nearer ones lie on top.
    let toward_reader = axes.right.cross(axes.up);
    let mut lights: Vec<Vec3> = Vec::new();
    for shot in capture.train.iter().flat_map(|view| &view.shots) {
        let p = place(&shot.light);
        if !lights.contains(&p) {
            lights.push(p);
        }
    }
    lights.sort_by(|a, b| a.dot(toward_reader).total_cmp(&b.dot(toward_reader)));
    let radius = if lights.len() > 200 { 2.0 } else { 5.0 };
    for p in lights {
        let (u, v) = to_page(p);
        canvas.disc(u, v, radius, LIGHT);
    }
    for light in only_held_out(capture) {
        let (u, v) = to_page(place(&light));
        canvas.ring(u, v, radius, 2.0, LIGHT);
    }
    for (views, colour) in [(&capture.test, TEST), (&capture.train, TRAIN)] {
        for view in views {
            let eye = view.camera.pose.centre();
            let from = to_page(eye);
            canvas.line(from, to_page(eye + look(view) * (0.16 * reach)), 2.0, colour);
            canvas.disc(from.0, from.1, 4.5, colour);
        }
    }
}

/// The direction in which a view looks.
fn look(view: &View) -> Vec3 {
    view.camera.pose.rotation.row(2)
}

/// Half the side of the map in scene units: all cameras and lights but those farther than three times the median, so
/// that one stray light does not shrink everything else to a dot.
fn reach(capture: &Capture, f: &Findings) -> f32 {
    let views = || capture.train.iter().chain(&capture.test);
    let mut distances: Vec<f32> = views().map(|view| view.camera.pose.centre().distance(f.scene.centre)).collect();
    distances.extend(views().flat_map(|view| &view.shots).filter_map(|shot| match shot.light {
        OlatLight::Point { position, .. } => Some(position.distance(f.scene.centre)),
        OlatLight::Directional { .. } => None,
    }));
    distances.sort_by(f32::total_cmp);
    let median = distances.get(distances.len() / 2).copied().unwrap_or(1.0);
    let largest = distances.iter().copied().filter(|d| *d <= 3.0 * median).fold(0.0, f32::max);
    largest.max(f.scene.framed_radius).max(1e-6)
}
