//! Light that goes through a homogeneous object from surfel to surfel, without the light and for every albedo at once.
//!
//! Walks start at a surfel as light would leave it backwards: an outer direction from the cosine distribution, through the boundary, free
//! flights and Henyey–Greenstein inside, *without absorption*. Where a walk comes out, the nearest surfel j and the number n of scatterings
//! are kept, and nothing else. Transport is reciprocal, so the radiosity that leaves the surfel is the mean over its walks of
//! αⁿ·A(μ_j)·E_j, for any albedo α and any irradiance E of the surfels: a sparse matrix ([`ExitWalks::collapse`]), or numbers that are
//! linear in powers of α ([`ExitWalks::moments`]).
//!
//! Lamps are collimated and exits are not: A is the distribution of the walks' outer cosines over the cosine distribution, one function for
//! the whole object ([`AngularExit`]), and contains what the boundary reflects. Radiance toward the cosine μ_o is A(μ_o)·M/π. That
//! light enters with A(μ) *and* leaves with A(μ), independently of each other and of the place, is the approximation here: light that falls in
//! obliquely goes on obliquely, and this forgets it. Objects of 20 mean free paths come out 1 to 3 % too bright in the mean, those of 3 by 7 to 15 %;
//! what a lamp from behind sends around the outline is short of a third (`cargo xtask bench prior`). A fit to photographs should read
//! [`crate::ViewWalks`], which forget nothing and are within 1 %.
//!
//! A walk that comes out without a scattering (n = 0) is what one sees through the object, no part of M, and ends. One that comes out and
//! meets the object again goes on there, after it has been recorded: whether a lamp reaches a place through air is for the caller to put
//! into E. What a boundary reflects on its outer side on that way is followed, but a lamp's reflection on it is not seen.
//!
//! ```
//! use diamond_pathtrace::{Boundary, ExitWalkOptions, ExitWalks, Geometry, Mesh};
//! use glam::Vec3;
//! let mesh = Mesh::icosphere(Vec3::ZERO, 1.0, 2);
//! let patches = mesh.patches(0.1)?;
//! let geometry = Geometry::from_mesh(mesh)?;
//! let options = ExitWalkOptions { walks: 64, ..Default::default() };
//! let walks = ExitWalks::trace(&geometry, 8.0, 0.0, Boundary::IndexMatched, &patches, &options, &|_| ())?;
//! // One lamp over the north pole.
//! let cosines: Vec<f32> = patches.iter().map(|p| p.normal.z.max(0.0)).collect();
//! let irradiance: Vec<f32> = cosines.iter().map(|mu| 3.0 * mu).collect();
//! let dark = walks.radiosity(0.5, &irradiance, &cosines)?;
//! let bright = walks.radiosity(0.99, &irradiance, &cosines)?;
//! assert!(bright.iter().sum::<f32>() > 2.0 * dark.iter().sum::<f32>());
//! # Ok::<(), diamond_pathtrace::PathtraceError>(())
//! ```
mod angular;
pub(crate) mod moments;
mod operator;
pub(crate) mod surfel_grid;
pub(crate) mod walker;

pub use angular::AngularExit;
pub use moments::ExitMoments;
pub use operator::WalkOperator;

use crate::error::check;
use crate::medium::MAX_MEAN_COSINE;
use crate::{Boundary, Geometry, Patch, PathtraceError};
use angular::{AngularBasis, AngularSums, CLASSES};
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};
use surfel_grid::SurfelGrid;
use walker::{Walked, Walker};

/// How walks are made. Time goes with `walks`, noise with one over its root.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExitWalkOptions {
    /// Walks from each surfel, 1 … 2²⁰.
    pub walks: u32,
    /// Scatterings after which a walk is cut off, 1 … 65 535. No roulette can end walks that are for every albedo; see
    /// [`ExitWalks::lost_by_cutting`].
    pub max_events: u32,
    /// Walks of different seeds are independent.
    pub seed: u64,
}

impl Default for ExitWalkOptions {
    fn default() -> Self {
        Self { walks: 256, max_events: 65_535, seed: 0 }
    }
}

impl ExitWalkOptions {
    /// `Err` where a number is outside its range.
    pub fn validate(&self) -> Result<(), PathtraceError> {
        let whole = |what: &str, value: u32, expected: &'static str, accept: bool| match accept {
            true => Ok(()),
            false => Err(PathtraceError::Value { what: what.into(), expected, found: format!("{value}") }),
        };
        whole("walks from each surfel", self.walks, "1 … 2²⁰", (1..=1 << 20).contains(&self.walks))?;
        whole("events of a walk", self.max_events, "1 … 65 535", (1..=65_535).contains(&self.max_events))
    }
}

/// What became of the walks, as fractions of all that were started, surfels weighted by area. They add up to 1, but that a walk which meets
/// the object again counts once, where it ends.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct WalkFates {
    /// Did not pass the boundary at the start: reflected, or lost between its facets.
    pub refused: f64,
    /// Came out unscattered.
    pub unscattered: f64,
    /// Came out after a scattering.
    pub left: f64,
    /// Absorbed by a rough boundary (light that would need several facets), or by rounding at an edge.
    pub lost: f64,
    /// Cut off after [`ExitWalkOptions::max_events`].
    pub cut: f64,
}

/// Walks between the surfels of an object, of one σ_t, g and boundary.
///
/// Memory: 6 bytes for each walk that comes out.
#[derive(Debug, Clone)]
pub struct ExitWalks {
    sigma_t: f32,
    g: f32,
    boundary: Boundary,
    options: ExitWalkOptions,
    /// Start of each surfel's exits, and the end of the last's.
    starts: Vec<usize>,
    /// For each exit, sorted within a surfel: where, and after how many scatterings.
    exits: Vec<u32>,
    scatterings: Vec<u16>,
    angular: [AngularExit; CLASSES],
    /// What [`AngularExit`]s are weighted by: area-weighted numbers of exits for each number of scatterings.
    histogram: Vec<f64>,
    fates: WalkFates,
}

impl ExitWalks {
    /// Walks from every patch through the medium inside `geometry`. `sigma_t` > 0 per scene unit and `g` are those of a gray medium.
    /// Patches should lie on the surface; where they do not, walks start at the surface above or below them, if it is nearer than the root
    /// of the patch's area. `progress` is told the fraction that is done, from any thread.
    ///
    /// Errors: invalid numbers or shapes; no patches, or patches that are not finite.
    /// `[eq:exit-walks]`
    pub fn trace(
        geometry: &Geometry,
        sigma_t: f32,
        g: f32,
        boundary: Boundary,
        patches: &[Patch],
        options: &ExitWalkOptions,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Result<Self, PathtraceError> {
        options.validate()?;
        geometry.validate()?;
        boundary.validate()?;
        check("sigma_t of walks", sigma_t, "a number > 0 and ≤ 10⁹ (per scene unit)", |v| v > 0.0 && v <= 1e9)?;
        check("g of walks", g, "a number from −0.999 to 0.999", |v| v.abs() <= MAX_MEAN_COSINE)?;
        let grid = SurfelGrid::new(patches)?;
        let walker = Walker { geometry, sigma_t, g, boundary: boundary.effective(), grid: &grid, options: *options };
        let done = AtomicUsize::new(0);
        let rows: Vec<Walked> = patches
            .par_iter()
            .enumerate()
            .with_max_len(8)
            .map(|(k, patch)| {
                let row = walker.walks_from(patch, k as u64);
                let n = done.fetch_add(1, Ordering::Relaxed) + 1;
                if n.is_multiple_of(64) || n == patches.len() {
                    progress(n as f32 / patches.len() as f32);
                }
                row
            })
            .collect();
        // Everything that is added up is added in the order of the patches.
        let area: f64 = patches.iter().map(|p| f64::from(p.area)).sum();
        let mut fates = WalkFates::default();
        let mut sums = AngularSums::default();
        let mut starts = vec![0];
        let total = rows.iter().map(|row| row.exits.len()).sum();
        let (mut exits, mut scatterings) = (Vec::with_capacity(total), Vec::with_capacity(total));
        let mut histogram = Vec::new();
        for (row, patch) in rows.iter().zip(patches) {
            let weight = f64::from(patch.area) / area;
            let fraction = weight / f64::from(options.walks);
            fates.refused += fraction * f64::from(row.refused);
            fates.unscattered += fraction * f64::from(row.unscattered);
            fates.left += fraction * f64::from(row.left);
            fates.lost += fraction * f64::from(row.lost);
            fates.cut += fraction * f64::from(row.cut);
            sums.add(&row.angular, weight);
            for &(surfel, n) in &row.exits {
                exits.push(surfel);
                scatterings.push(n);
                if usize::from(n) >= histogram.len() {
                    histogram.resize(usize::from(n) + 1, 0.0);
                }
                histogram[usize::from(n)] += fraction;
            }
            starts.push(exits.len());
        }
        let basis = AngularBasis::new(boundary);
        let angular = std::array::from_fn(|class| basis.exit(&sums, class));
        Ok(Self { sigma_t, g, boundary, options: *options, starts, exits, scatterings, angular, histogram, fates })
    }

    /// Number of surfels.
    pub fn surfels(&self) -> usize {
        self.starts.len() - 1
    }

    /// Extinction of the medium, 1/scene unit.
    pub fn sigma_t(&self) -> f32 {
        self.sigma_t
    }

    /// Mean cosine of the medium's phase function.
    pub fn g(&self) -> f32 {
        self.g
    }

    /// The boundary that was walked through.
    pub fn boundary(&self) -> Boundary {
        self.boundary
    }

    /// What became of the walks.
    pub fn fates(&self) -> WalkFates {
        self.fates
    }

    /// Bytes of memory.
    pub fn bytes(&self) -> usize {
        6 * self.exits.len() + 8 * (self.starts.len() + self.histogram.len())
    }

    /// Most of the incident light that walks which were cut off could have brought at this albedo: their fraction times α^max_events.
    pub fn lost_by_cutting(&self, albedo: f32) -> f64 {
        self.fates.cut * f64::from(albedo.clamp(0.0, 1.0)).powi(self.options.max_events as i32)
    }

    /// Fraction of the light that falls on the object from all sides, evenly, which leaves it scattered, at an albedo 0 … 1.
    pub fn diffuse_albedo(&self, albedo: f32) -> f64 {
        powers(f64::from(albedo), self.histogram.len()).iter().zip(&self.histogram).map(|(p, h)| p * h).sum()
    }

    fn check_albedo(albedo: f32) -> Result<(), PathtraceError> {
        check("albedo", albedo, "a number from 0 to 1", |v| (0.0..=1.0).contains(&v))
    }

    /// The exits of a surfel.
    fn row(&self, surfel: usize) -> (&[u32], &[u16]) {
        let range = self.starts[surfel]..self.starts[surfel + 1];
        (&self.exits[range.clone()], &self.scatterings[range])
    }
}

/// αⁿ for n = 0 … count − 1.
pub(crate) fn powers(albedo: f64, count: usize) -> Vec<f64> {
    let mut power = 1.0f64;
    (0..count)
        .map(|_| {
            let this = power;
            // Denormal numbers are slow and say nothing.
            power = if this > 1e-30 { this * albedo } else { 0.0 };
            this
        })
        .collect()
}

#[cfg(test)]
mod tests;
