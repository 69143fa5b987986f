//! Closed surfaces inside each other: which face outward, which are cavities, which are superfluous.
use crate::PathtraceError;
use crate::repair::{RepairReport, Soup, edges};
use glam::DVec3;
use std::collections::BTreeMap;

/// Vertices of a surface that are tested against another.
const TESTED: usize = 48;

/// A direction in no symmetry with anything.
const PROBE: DVec3 = DVec3::new(0.331_662_479, 0.583_095_189, 0.741_619_849);

struct Component {
    triangles: Vec<usize>,
    volume: f64,
    low: DVec3,
    high: DVec3,
}

/// Turns closed surfaces so that the object lies behind them: outermost ones outward, cavities inward. Solids inside solids are
/// removed, surfaces that cut through each other refused.
pub(crate) fn turn_outward(soup: &mut Soup, report: &mut RepairReport) -> Result<(), PathtraceError> {
    let components = components(soup);
    let inside = nesting(soup, &components)?;
    let depth = |c: usize| inside[c].len();
    let mut order: Vec<usize> = (0..components.len()).collect();
    order.sort_by_key(|c| depth(*c));
    let mut turned = vec![false; components.len()];
    let mut removed = vec![false; soup.mesh.triangles.len()];
    for c in order {
        let component = &components[c];
        if component.volume == 0.0 {
            return Err(PathtraceError::Mesh {
                problem: format!("a closed surface of {} triangles without volume", component.triangles.len()),
                advice: "remove it, or give it a thickness",
            });
        }
        // A file that is inside out is so as a whole: inner surfaces follow the outermost around them.
        let outermost = inside[c].iter().copied().find(|o| depth(*o) == 0);
        let sign = match outermost {
            None => {
                turned[c] = component.volume < 0.0;
                continue;
            }
            Some(o) => {
                turned[c] = turned[o];
                component.volume * if turned[o] { -1.0 } else { 1.0 }
            }
        };
        let solid_around = depth(c) % 2 == 1;
        if solid_around && sign > 0.0 {
            report.enclosed_components += 1;
            component.triangles.iter().for_each(|t| removed[*t] = true);
        } else if !solid_around && sign < 0.0 {
            turned[c] = !turned[c];
        }
    }
    for (component, turned) in components.iter().zip(&turned) {
        if *turned && !removed[component.triangles[0]] {
            report.turned_components += 1;
            component.triangles.iter().for_each(|t| soup.mesh.triangles[*t].swap(1, 2));
        }
    }
    report.components = components.len() - report.enclosed_components;
    let mut gone = removed.iter();
    soup.mesh.triangles.retain(|_| !gone.next().copied().unwrap_or(false));
    Ok(())
}

/// Triangles that hang together by their edges.
fn components(soup: &Soup) -> Vec<Component> {
    let count = soup.mesh.triangles.len();
    let mut users: BTreeMap<(u32, u32), Vec<usize>> = BTreeMap::new();
    for t in 0..count {
        for (a, b) in edges(soup.places(t)) {
            users.entry((a.min(b), a.max(b))).or_default().push(t);
        }
    }
    let mut seen = vec![false; count];
    let mut found = Vec::new();
    for seed in 0..count {
        if seen[seed] {
            continue;
        }
        seen[seed] = true;
        let (mut stack, mut triangles) = (vec![seed], vec![seed]);
        while let Some(t) = stack.pop() {
            for (a, b) in edges(soup.places(t)) {
                for &other in users.get(&(a.min(b), a.max(b))).into_iter().flatten() {
                    if !seen[other] {
                        seen[other] = true;
                        stack.push(other);
                        triangles.push(other);
                    }
                }
            }
        }
        let corners = |t: usize| soup.mesh.corners(t).map(|v| v.as_dvec3());
        let origin = corners(seed)[0];
        let (mut volume, mut low, mut high) = (0.0, DVec3::INFINITY, DVec3::NEG_INFINITY);
        for &t in &triangles {
            let [a, b, c] = corners(t);
            volume += (a - origin).dot((b - origin).cross(c - origin)) / 6.0;
            low = low.min(a).min(b).min(c);
            high = high.max(a).max(b).max(c);
        }
        found.push(Component { triangles, volume, low, high });
    }
    found
}

/// For each surface, those around it.
fn nesting(soup: &Soup, components: &[Component]) -> Result<Vec<Vec<usize>>, PathtraceError> {
    let mut inside = vec![Vec::new(); components.len()];
    for (c, component) in components.iter().enumerate() {
        for (o, other) in components.iter().enumerate() {
            let apart = !(component.low.cmplt(other.high).all() && component.high.cmpgt(other.low).all());
            if c == o || apart {
                continue;
            }
            let stride = component.triangles.len().div_ceil(TESTED);
            let tested = component.triangles.iter().step_by(stride);
            let mut count = [0usize; 2];
            for &t in tested {
                // The middle of a triangle, and its corners pulled a little towards it: surfaces may touch.
                let corners = soup.mesh.corners(t).map(|v| v.as_dvec3());
                let middle = (corners[0] + corners[1] + corners[2]) / 3.0;
                for point in corners.map(|corner| corner.lerp(middle, 1e-3)).into_iter().chain([middle]) {
                    count[usize::from(contains(soup, other, point))] += 1;
                }
            }
            match count {
                [0, _] => inside[c].push(o),
                [_, 0] => {}
                _ => {
                    return Err(PathtraceError::Mesh {
                        problem: format!(
                            "two closed surfaces of {} and {} triangles cut through each other",
                            component.triangles.len(),
                            other.triangles.len()
                        ),
                        advice: "unite them in a modelling program first",
                    });
                }
            }
        }
    }
    Ok(inside)
}

/// Whether a point lies inside a closed surface, whichever way it faces: the parity of crossings of a ray, in `f64`.
fn contains(soup: &Soup, component: &Component, point: DVec3) -> bool {
    let within = point.cmpge(component.low).all() && point.cmple(component.high).all();
    within && component.triangles.iter().filter(|t| crosses(soup, **t, point)).count() % 2 == 1
}

/// Whether the ray from `point` along [`PROBE`] meets the triangle (Möller and Trumbore).
fn crosses(soup: &Soup, t: usize, point: DVec3) -> bool {
    let [a, b, c] = soup.mesh.corners(t).map(|v| v.as_dvec3());
    let (e, f) = (b - a, c - a);
    let p = PROBE.cross(f);
    let determinant = e.dot(p);
    if determinant == 0.0 {
        return false;
    }
    let s = point - a;
    let u = s.dot(p) / determinant;
    let q = s.cross(e);
    let v = PROBE.dot(q) / determinant;
    u >= 0.0 && v >= 0.0 && u + v < 1.0 && f.dot(q) / determinant > 0.0
}
