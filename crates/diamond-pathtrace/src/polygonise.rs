//! Surfaces of fields as meshes, by surface nets (Gibson 1998).
//!
//! Each cell of a grid that the surface passes through gets one vertex, at the mean of where the field is zero along the cell's edges; each edge of
//! the grid with a change of sign gets a quadrilateral between its four cells. Every quadrilateral's side is shared with the next one around its
//! cell's face, so the result is closed wherever the surface stays inside the grid. Vertices are then drawn onto the field's zero.
use crate::error::check;
use crate::{DistanceField, Mesh, PathtraceError};
use glam::{UVec3, Vec3};

/// Steps of Newton's method that bring a vertex to the surface.
const NEWTON_STEPS: u32 = 2;

impl DistanceField {
    /// The field's surface as a closed mesh with vertex normals, from a grid with `resolution` cells (8 … 512) along the longest
    /// side of its bounding box. Errors where it has no part that adds anything, or its surface is smaller than a cell.
    pub fn polygonise(&self, resolution: u32) -> Result<Mesh, PathtraceError> {
        check("resolution of a procedural object", resolution as f32, "8 to 512 cells", |n| {
            (8.0..=512.0).contains(&n)
        })?;
        let (low, high) = self.bounds();
        if !(low.is_finite() && high.is_finite()) {
            return Err(PathtraceError::Mesh {
                problem: "a procedural object without parts, or with one that is not finite".into(),
                advice: "give at least one part that is added",
            });
        }
        polygonise(|p| self.distance(p), low, high, resolution)
    }
}

/// The surface on which `field` is zero (negative inside), as a closed mesh with vertex normals. The surface must lie within the box
/// from `low` to `high`; what sticks out is cut off flat.
pub fn polygonise(field: impl Fn(Vec3) -> f32, low: Vec3, high: Vec3, resolution: u32) -> Result<Mesh, PathtraceError> {
    let cell = (high - low).max_element() / resolution as f32;
    check("size of the box around a surface", cell, "a number > 0", |v| v > 0.0)?;
    // Two samples beyond the box on each side, where nothing is.
    let size = ((high - low) / cell).ceil().as_uvec3() + 5;
    let origin = low - 2.0 * cell;
    let at = |v: UVec3| origin + v.as_vec3() * cell;
    let index = |v: UVec3| ((v.z * size.y + v.y) * size.x + v.x) as usize;
    let mut values = vec![0.0f32; (size.x * size.y * size.z) as usize];
    for z in 0..size.z {
        for y in 0..size.y {
            for x in 0..size.x {
                let v = UVec3::new(x, y, z);
                let rim = v.cmplt(UVec3::splat(2)).any() || v.cmpge(size - 2).any();
                let value = field(at(v));
                // NaN counts as outside, zero too: a sign is one or the other.
                values[index(v)] = if rim || value.is_nan() { value.max(cell) } else { value };
            }
        }
    }
    let inside = |v: UVec3| values[index(v)] < 0.0;
    let mut mesh = Mesh::default();
    let mut vertex_of = vec![u32::MAX; values.len()];
    let steps = [UVec3::X, UVec3::Y, UVec3::Z];
    for z in 0..size.z - 1 {
        for y in 0..size.y - 1 {
            for x in 0..size.x - 1 {
                let base = UVec3::new(x, y, z);
                let (mut sum, mut count) = (Vec3::ZERO, 0);
                for axis in 0..3 {
                    let (p, q) = (steps[(axis + 1) % 3], steps[(axis + 2) % 3]);
                    for start in [base, base + p, base + q, base + p + q] {
                        let end = start + steps[axis];
                        if inside(start) != inside(end) {
                            let (a, b) = (values[index(start)], values[index(end)]);
                            let t = (a / (a - b)).clamp(0.0, 1.0);
                            sum += at(start).lerp(at(end), if t.is_finite() { t } else { 0.5 });
                            count += 1;
                        }
                    }
                }
                if count > 0 {
                    let corner = at(base);
                    let start = sum / count as f32;
                    vertex_of[index(base)] = mesh.positions.len() as u32;
                    mesh.positions.push(drawn_to_surface(&field, start, corner, cell));
                }
            }
        }
    }
    for z in 1..size.z - 1 {
        for y in 1..size.y - 1 {
            for x in 1..size.x - 1 {
                let v = UVec3::new(x, y, z);
                for axis in 0..3 {
                    let (p, q) = (steps[(axis + 1) % 3], steps[(axis + 2) % 3]);
                    let from = inside(v);
                    if from == inside(v + steps[axis]) {
                        continue;
                    }
                    let quad = [v - p - q, v - q, v, v - p].map(|c| vertex_of[index(c)]);
                    let [a, b, c, d] = if from { quad } else { [quad[0], quad[3], quad[2], quad[1]] };
                    // Along the shorter diagonal.
                    let length =
                        |i: u32, j: u32| (mesh.positions[i as usize] - mesh.positions[j as usize]).length_squared();
                    if length(a, c) <= length(b, d) {
                        mesh.triangles.extend([[a, b, c], [a, c, d]]);
                    } else {
                        mesh.triangles.extend([[a, b, d], [b, c, d]]);
                    }
                }
            }
        }
    }
    if mesh.triangles.is_empty() {
        return Err(PathtraceError::Mesh {
            problem: "no surface was found on the grid".into(),
            advice: "raise the resolution, or enlarge the object",
        });
    }
    let normals = mesh.positions.iter().map(|p| gradient(&field, *p, 0.25 * cell).normalize_or(Vec3::Z)).collect();
    mesh.normals = Some(normals);
    Ok(mesh)
}

fn gradient(field: &impl Fn(Vec3) -> f32, p: Vec3, h: f32) -> Vec3 {
    let slope = |axis: Vec3| field(p + axis * h) - field(p - axis * h);
    let g = Vec3::new(slope(Vec3::X), slope(Vec3::Y), slope(Vec3::Z)) / (2.0 * h);
    if g.is_finite() { g } else { Vec3::ZERO }
}

/// A vertex brought nearer to the zero of the field; it stays in its cell, so that triangles keep their order.
fn drawn_to_surface(field: &impl Fn(Vec3) -> f32, start: Vec3, corner: Vec3, cell: f32) -> Vec3 {
    let mut p = start;
    for _ in 0..NEWTON_STEPS {
        let g = gradient(field, p, 0.1 * cell);
        let step = g * (field(p) / g.length_squared().max(1e-6));
        if !step.is_finite() {
            break;
        }
        p = (p - step.clamp_length_max(0.5 * cell)).clamp(corner, corner + cell);
    }
    p
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Operation, Solid};

    #[test]
    fn a_ball_has_its_volume_and_its_normals() {
        let ball = DistanceField {
            parts: vec![(Operation::Union, Solid::Sphere { centre: Vec3::new(0.1, 0.2, 0.3), radius: 0.7 })],
            blend: 0.0,
            noise: None,
        };
        let mesh = ball.polygonise(48).unwrap();
        assert!(mesh.is_closed());
        let exact = 4.0 / 3.0 * std::f64::consts::PI * 0.343;
        assert!((mesh.signed_volume() / exact - 1.0).abs() < 2e-3, "{}", mesh.signed_volume() / exact);
        for (p, n) in mesh.positions.iter().zip(mesh.normals.as_ref().unwrap()) {
            let outward = (*p - Vec3::new(0.1, 0.2, 0.3)).normalize();
            assert!(outward.dot(*n) > 0.999 && ball.distance(*p).abs() < 1e-3);
        }
    }

    /// Closed and outward without any repair, whatever the object.
    #[test]
    fn random_objects_are_closed_and_the_same_again() {
        for seed in 0..8 {
            let mesh = DistanceField::random(seed).polygonise(32).unwrap();
            assert_eq!(mesh, DistanceField::random(seed).polygonise(32).unwrap());
            assert!(mesh.is_closed(), "seed {seed}");
            let volume = mesh.signed_volume();
            assert!(volume > 0.02 && volume < 8.0, "seed {seed}: {volume}");
            let (_, report) = mesh.repair(&Default::default()).unwrap_or_else(|e| panic!("seed {seed}: {e}"));
            assert_eq!(report.filled_holes + report.turned_triangles, 0, "seed {seed}: {report}");
        }
    }

    #[test]
    fn what_sticks_out_of_the_box_is_closed_too() {
        let mesh = polygonise(|p| p.length() - 1.0, Vec3::splat(-0.8), Vec3::splat(0.8), 24).unwrap();
        assert!(mesh.is_closed() && mesh.signed_volume() > 3.0);
        assert!(polygonise(|_| 1.0, Vec3::ZERO, Vec3::ONE, 10).is_err());
        assert!(polygonise(|_| f32::NAN, Vec3::ZERO, Vec3::ONE, 10).is_err());
    }
}
