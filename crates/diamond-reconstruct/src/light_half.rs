//! What of a light does not depend on the view: kept from one view to the next.
use glam::Vec3;

/// What a light is to Gaussians, whatever the view.
pub(crate) struct LightHalf {
    /// Empty where nothing reads it.
    pub visibility: Vec<f32>,
    /// `MediumTerm::sent`; empty without a medium.
    pub medium: Vec<Vec3>,
}

impl LightHalf {
    /// Of `gaussians` Gaussians.
    pub fn bytes(gaussians: usize, visibility: bool, medium: bool) -> usize {
        gaussians * (usize::from(visibility) * size_of::<f32>() + usize::from(medium) * size_of::<Vec3>())
    }

    /// The same for some of the Gaussians.
    pub fn of(&self, rows: &[u32]) -> Self {
        Self {
            visibility: rows.iter().filter_map(|&i| self.visibility.get(i as usize).copied()).collect(),
            medium: rows.iter().filter_map(|&i| self.medium.get(i as usize).copied()).collect(),
        }
    }
}
