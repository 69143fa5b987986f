//! Holes of a mesh, filled with a fan around the middle of their rim.
use crate::PathtraceError;
use crate::repair::{RepairReport, Soup, open_edges};
use glam::{Vec2, Vec3};
use std::collections::BTreeMap;

/// Fills every hole whose rim is at most `max_hole` times the bounding box's diagonal long.
pub(crate) fn fill_holes(soup: &mut Soup, max_hole: f32, report: &mut RepairReport) -> Result<(), PathtraceError> {
    let open = open_edges(soup);
    if open.is_empty() {
        return Ok(());
    }
    let (low, high) = soup.mesh.bounds();
    let limit = max_hole * (high - low).length();
    for rim in rims(&open)? {
        let points: Vec<Vec3> = rim.iter().map(|v| soup.mesh.positions[*v as usize]).collect();
        let length: f32 = (0..points.len()).map(|i| (points[i] - points[(i + 1) % points.len()]).length()).sum();
        if length > limit {
            return Err(PathtraceError::Mesh {
                problem: format!("a hole with a rim of {} edges, {length} long, near {}", rim.len(), points[0]),
                advice: "close it, or raise the largest hole that may be filled",
            });
        }
        report.filled_holes += 1;
        // The surface runs along the rim; what fills the hole runs against it.
        if let [a, b, c] = rim[..] {
            soup.mesh.triangles.push([a, c, b]);
            report.added_triangles += 1;
            continue;
        }
        let middle = soup.mesh.positions.len() as u32;
        soup.mesh.positions.push(points.iter().sum::<Vec3>() / points.len() as f32);
        soup.place.push(middle);
        if let Some(normals) = &mut soup.mesh.normals {
            let sum: Vec3 = rim.iter().map(|v| normals[*v as usize]).sum();
            normals.push(sum.normalize_or(Vec3::Z));
        }
        if let Some(uvs) = &mut soup.mesh.uvs {
            let sum: Vec2 = rim.iter().map(|v| uvs[*v as usize]).sum();
            uvs.push(sum / rim.len() as f32);
        }
        for i in 0..rim.len() {
            soup.mesh.triangles.push([rim[(i + 1) % rim.len()], rim[i], middle]);
        }
        report.added_triangles += rim.len();
    }
    Ok(())
}

/// Closed loops of open edges, in the surface's direction.
fn rims(open: &BTreeMap<(u32, u32), i32>) -> Result<Vec<Vec<u32>>, PathtraceError> {
    let mut next: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    for (&(a, b), &n) in open {
        (0..n).for_each(|_| next.entry(a).or_default().push(b));
    }
    let mut loops = Vec::new();
    while let Some(start) = next.iter().find(|(_, ends)| !ends.is_empty()).map(|(v, _)| *v) {
        // A walk that cuts off a loop whenever it comes back to itself.
        let mut walk = vec![start];
        while let Some(&at) = walk.last() {
            let Some(to) = next.get_mut(&at).and_then(Vec::pop) else { break };
            if let Some(first) = walk.iter().position(|v| *v == to) {
                loops.push(walk.split_off(first));
                if walk.is_empty() {
                    break;
                }
            } else {
                walk.push(to);
            }
            if walk.last().is_some_and(|v| *v != to) {
                // Go on from where the loop was cut off: its first vertex is the walk's end again.
                walk.push(to);
            }
        }
        if !walk.is_empty() {
            // Open edges balance at each vertex, so that walks end where they began.
            return Err(PathtraceError::Mesh {
                problem: format!("open edges at vertex {} that form no rim", walk[0]),
                advice: "export the mesh again as a closed surface",
            });
        }
    }
    Ok(loops)
}
