//! A mesh as even patches: places with a normal and the area that each stands for, as light transport between surfels wants them.
use crate::{Mesh, PathtraceError, error::check};
use glam::Vec3;

/// A triangle is cut into at most this many parts along a side.
const MAX_PARTS: u32 = 256;

/// A piece of a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Patch {
    /// Its centroid, world.
    pub position: Vec3,
    /// Outward unit normal of its triangle.
    pub normal: Vec3,
    /// Area, square scene units, > 0.
    pub area: f32,
}

impl Mesh {
    /// The triangles, each cut into n² equal ones so that none exceeds `max_area` (n up to 256); triangles without area are left out. The
    /// areas add up to the mesh's. Errors for a mesh that is none or an area that is not positive.
    pub fn patches(&self, max_area: f32) -> Result<Vec<Patch>, PathtraceError> {
        self.validate()?;
        check("largest area of a patch", max_area, "a number > 0", |v| v > 0.0)?;
        let mut patches = Vec::new();
        for t in 0..self.triangles.len() {
            let [a, b, c] = self.corners(t);
            let vector = self.area_vector(t);
            let area = (0.5 * vector.length()) as f32;
            let Some(normal) = vector.try_normalize().map(|n| n.as_vec3()).filter(|_| area > 0.0) else { continue };
            let parts = ((area / max_area).sqrt().ceil() as u32).clamp(1, MAX_PARTS);
            let (n, e, f) = (parts as f32, b - a, c - a);
            let mut add = |u: f32, v: f32| {
                patches.push(Patch { position: a + (e * u + f * v) / n, normal, area: area / (n * n) });
            };
            for i in 0..parts {
                for j in 0..parts - i {
                    // Upright, and upside down where there is room.
                    add(i as f32 + 1.0 / 3.0, j as f32 + 1.0 / 3.0);
                    if i + j + 1 < parts {
                        add(i as f32 + 2.0 / 3.0, j as f32 + 2.0 / 3.0);
                    }
                }
            }
        }
        Ok(patches)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patches_are_small_face_outward_and_cover_the_mesh() {
        let cube = Mesh::cuboid(Vec3::splat(-1.0), Vec3::splat(1.0));
        for (max, count) in [(10.0, 12), (2.0, 12), (0.5, 48), (0.3, 108)] {
            let patches = cube.patches(max).unwrap();
            assert_eq!(patches.len(), count);
            assert!((patches.iter().map(|p| p.area).sum::<f32>() - 24.0).abs() < 1e-4);
            let mean: Vec3 = patches.iter().map(|p| p.position * p.area).sum();
            assert!(mean.length() < 1e-4);
            assert!(patches.iter().all(|p| p.area <= max && p.position.dot(p.normal) > 0.99));
        }
        assert!(cube.patches(0.0).is_err() && Mesh::default().patches(1.0).is_err());
    }
}
