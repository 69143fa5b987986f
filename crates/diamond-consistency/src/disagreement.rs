//! How much two views contradict each other about a shape, as a figure for tables and not as a loss.
use crate::{ConsistencyError, ConsistencyOptions, Fate, ViewGeometry, pair_consistency};

/// What a second view says about the points that a first one shows; sums, so that pairs can be added up.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Disagreement {
    /// Points that land in the second picture.
    pub landed: usize,
    /// Of these, the points that land where it shows no object.
    pub outside: usize,
    /// Points of which both views know a depth, but for those that are hidden in the second.
    pub compared: usize,
    /// Sum of |ẑ − D_j(x')| over these, view-space z, scene units.
    pub gaps: f64,
}

impl Disagreement {
    /// `[eq:cross-view-gap]` Of a pair of views, at `pixels` of the first.
    ///
    /// A point that is farther from the second camera than what that one shows there, by `options.max_gap` or more, is hidden: nothing
    /// contradicts it. One that is nearer than what the second shows should hide it and does not: it counts in full, however
    /// large the gap. That is where this differs from the depth term of [`pair_consistency`], which leaves out both.
    ///
    /// # Errors
    /// Those of [`pair_consistency`].
    pub fn of(
        from: &ViewGeometry<'_>,
        to: &ViewGeometry<'_>,
        pixels: &[u32],
        options: &ConsistencyOptions,
    ) -> Result<Self, ConsistencyError> {
        let (_, pair) = pair_consistency(from, to, pixels, options)?;
        let mut found = Self::default();
        for c in pair.correspondences().iter().filter(|c| c.fate.has_silhouette()) {
            found.landed += 1;
            found.outside += usize::from(c.silhouette <= options.min_silhouette);
            let should_be_seen = c.fate == Fate::Hidden && c.z < c.surface_z;
            if c.fate == Fate::Seen || should_be_seen {
                found.compared += 1;
                found.gaps += f64::from((c.z - c.surface_z).abs());
            }
        }
        Ok(found)
    }

    /// Together with other pairs.
    pub fn add(&mut self, other: &Self) {
        self.landed += other.landed;
        self.outside += other.outside;
        self.compared += other.compared;
        self.gaps += other.gaps;
    }

    /// Mean gap between the depths, scene units; `None` where nothing was compared.
    pub fn mean_gap(&self) -> Option<f64> {
        (self.compared > 0).then(|| self.gaps / self.compared as f64)
    }

    /// Share of points that the second view shows no object at; `None` where no point landed in it.
    pub fn outside_share(&self) -> Option<f64> {
        (self.landed > 0).then(|| self.outside as f64 / self.landed as f64)
    }
}
