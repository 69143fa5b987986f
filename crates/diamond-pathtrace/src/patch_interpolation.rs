//! Values between the patches of a surface, as pictures need them.
use crate::bulk::points::SurfacePoints;
use crate::exit_walks::surfel_grid::check_patches;
use crate::{Patch, PathtraceError};
use glam::Vec3;

/// Patches that places between them take their values from: a linear fit in the tangent plane, weighted towards near patches of like
/// orientation.
#[derive(Debug)]
pub struct PatchInterpolation {
    points: SurfacePoints,
}

impl PatchInterpolation {
    /// Patches of about equal size; small ones among them do no harm, but a few large ones blur everything. Errors where there are none, or one is not
    /// finite.
    pub fn new(patches: &[Patch]) -> Result<Self, PathtraceError> {
        check_patches(patches)?;
        Ok(Self { points: SurfacePoints::of_patches(patches) })
    }

    /// Replaces `out` by patches and weights, which add up to 1 (some may be negative), for a place of the surface with a unit normal. Never empty.
    pub fn weights(&self, position: Vec3, normal: Vec3, out: &mut Vec<(u32, f32)>) {
        self.points.weights(position, normal, out);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Mesh, Rng};

    /// `[eq:surface-fit]`: linear functions on the sides of a box, up to its edges, and not across them.
    #[test]
    fn linear_functions_on_flat_sides_are_reproduced() {
        let patches = Mesh::cuboid(Vec3::splat(-1.0), Vec3::splat(1.0)).patches(0.02).unwrap();
        let between = PatchInterpolation::new(&patches).unwrap();
        let mut rng = Rng::new(8, 8);
        let mut weights = Vec::new();
        for _ in 0..500 {
            let place = Vec3::new(2.0 * rng.uniform() - 1.0, 2.0 * rng.uniform() - 1.0, 1.0);
            between.weights(place, Vec3::Z, &mut weights);
            let found: Vec3 = weights.iter().map(|(k, w)| patches[*k as usize].position * *w).sum();
            assert!((found - place).length() < 0.02, "{place} {found}");
            assert!(weights.iter().all(|(k, _)| patches[*k as usize].normal == Vec3::Z));
        }
        assert!(PatchInterpolation::new(&[]).is_err());
    }
}
