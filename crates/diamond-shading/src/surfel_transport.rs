//! Subsurface transport between surfels: what enters through a surface leaves it around the place, by a radial profile.
//!
//! The radiosity that leaves at x is M_c(x) = Σ_j R_c(|x − x_j|)·E_jc·A_j over surfels with irradiance E and area A, for
//! all lights of a rig at once. The Gaussians of the profile have fixed widths, so the transport of each width depends on
//! geometry alone: [`Receivers::basis`] gives it apart, a column of a least-squares system for each width, and [`Receivers::exitance`]
//! gives the sum under a profile, with a pullback to the profile's weights and to the irradiance.
//!
//! Distances are Euclidean and R belongs to a flat half space. On a sphere light would be lost, in a sheet that is thinner
//! than R both sides would receive all of it: more than entered. [`Balance::Conserving`] scales each Gaussian symmetrically,
//! K(x, y) = d(x)·G(|x−y|)·d(y), so that all that enters anywhere leaves somewhere and no more (Sinkhorn's iteration): then
//! no profile with a reflectance of at most 1 creates energy on any surface, and light still goes as easily from x to y as from y to x.
//!
//! ```
//! use diamond_shading::{Balance, RadialProfile, Surfels, SurfelTransport};
//! use glam::Vec3;
//! let surfels = Surfels { positions: vec![Vec3::ZERO, Vec3::X], areas: vec![0.5; 2] };
//! let transport = SurfelTransport::new(surfels, vec![0.4, 2.0], Balance::Conserving)?;
//! let receivers = transport.receivers(&[Vec3::ZERO, Vec3::X])?;
//! let profile = RadialProfile::new(vec![0.4, 2.0], vec![Vec3::splat(0.2), Vec3::splat(0.3)])?;
//! // One light, that shines on the first surfel only.
//! let (exitance, _) = receivers.exitance(&profile, &[1.0, 1.0, 1.0, 0.0, 0.0, 0.0])?;
//! assert!(exitance[0] > exitance[3] && exitance[3] > 0.0);
//! # Ok::<(), diamond_shading::ShadingError>(())
//! ```
use crate::error::{ShadingError, check_length};
use crate::gaussian_sum::{GaussianSum, prefers_lattice};
use crate::radial_profile::{RadialProfile, check_widths};
use crate::row_chunks::map_chunks;
use glam::Vec3;

/// Most rounds of the balance; some five are enough on ordinary surfaces.
const BALANCE_ROUNDS: usize = 16;
/// The balance ends when what leaves of what entered anywhere is off by no more than this.
const BALANCE_TOLERANCE: f32 = 1e-3;

/// Receivers to which less than this fraction of a surfel's own peak comes see nothing of that width (guards a division: beyond some four widths the
/// sums are truncation).
const MIN_ARRIVING: f32 = 1e-6;

/// Columns that are summed at a time.
const WIDE: usize = 16;
/// Columns where there are no more than these.
const FEW: usize = 4;

/// Points of a surface with the area that each stands for.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Surfels {
    /// World coordinates, scene units.
    pub positions: Vec<Vec3>,
    /// Square scene units, ≥ 0.
    pub areas: Vec<f32>,
}

/// Whether transport keeps to what enters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Balance {
    /// The profile over Euclidean distance as it is: too little light on small convex bodies, too much in thin parts. The default, since fitted
    /// weights make up for most of it and pictures come out a little better (decision 0027).
    #[default]
    Plain,
    /// Scaled symmetrically so that exactly what enters leaves, for each width: for profiles that are given, not fitted.
    Conserving,
}

/// One Gaussian's transport: what surfels' irradiance is multiplied by before the sum.
#[derive(Debug, Clone)]
struct Gaussian {
    width: f32,
    lattice: bool,
    /// Area times the balance d_j.
    leaving: Vec<f32>,
    /// At most 1: what the last round of the balance left above what enters.
    scale: f32,
}

/// Transport from surfels to anywhere on the surface.
#[derive(Debug, Clone)]
pub struct SurfelTransport {
    surfels: Surfels,
    widths: Vec<f32>,
    balance: Balance,
    origin: Vec3,
    gaussians: Vec<Gaussian>,
}

fn finite(what: &'static str, positions: &[Vec3]) -> Result<(), ShadingError> {
    match positions.iter().position(|p| !p.is_finite()) {
        None => Ok(()),
        Some(i) => Err(ShadingError::Setting {
            what,
            expected: "finite coordinates".into(),
            found: format!("{} at index {i}", positions[i]),
        }),
    }
}

impl SurfelTransport {
    /// Prepares transport for Gaussians of these widths (scene units, ascending). With [`Balance::Conserving`] this costs several
    /// sums of one column.
    ///
    /// Errors where positions and areas differ in number, are not finite, an area is negative or none is positive, or the widths are none.
    pub fn new(surfels: Surfels, widths: Vec<f32>, balance: Balance) -> Result<Self, ShadingError> {
        check_length("areas of surfels", surfels.positions.len(), surfels.areas.len())?;
        check_widths(&widths)?;
        finite("positions of surfels", &surfels.positions)?;
        let total: f64 = surfels.areas.iter().map(|a| f64::from(*a)).sum();
        // Written so that NaN fails it.
        if !(surfels.areas.iter().all(|a| *a >= 0.0) && total > 0.0 && total < f64::from(f32::MAX)) {
            return Err(ShadingError::Setting {
                what: "areas of surfels",
                expected: "finite numbers ≥ 0, not all 0".into(),
                found: format!("a sum of {total}"),
            });
        }
        let origin = surfels.positions.iter().copied().reduce(Vec3::min).unwrap_or(Vec3::ZERO);
        let area = (total / surfels.positions.len() as f64) as f32;
        let gaussians = map_chunks(widths.len(), |k| {
            let (width, lattice) = (widths[k], prefers_lattice(widths[k], area));
            let plain = Gaussian { width, lattice, leaving: surfels.areas.clone(), scale: 1.0 };
            match balance {
                Balance::Plain => plain,
                Balance::Conserving => balanced(plain, &surfels, origin),
            }
        });
        Ok(Self { surfels, widths, balance, origin, gaussians })
    }

    /// The widths, scene units.
    pub fn widths(&self) -> &[f32] {
        &self.widths
    }

    /// The surfels.
    pub fn surfels(&self) -> &Surfels {
        &self.surfels
    }

    /// Prepares transport to these world positions, which should lie on the surface. Errors where one is not finite.
    pub fn receivers<'a>(&'a self, positions: &'a [Vec3]) -> Result<Receivers<'a>, ShadingError> {
        finite("positions of receivers", positions)?;
        let arrivals = map_chunks(self.gaussians.len(), |k| {
            let g = &self.gaussians[k];
            let sum = GaussianSum::new(&self.surfels.positions, positions, g.width, self.origin, g.lattice);
            let factors = match self.balance {
                Balance::Plain => vec![1.0; positions.len()],
                Balance::Conserving => {
                    let arriving = one_column(&sum, &g.leaving);
                    inverse(&arriving, g).iter().map(|r| g.scale * r).collect()
                }
            };
            (sum, factors)
        });
        Ok(Receivers { transport: self, positions, arrivals })
    }
}

/// Σ_j G·v_j of one column.
fn one_column(sum: &GaussianSum<'_>, values: &[f32]) -> Vec<f32> {
    let values: Vec<[f32; 1]> = values.iter().map(|v| [*v]).collect();
    sum.apply(&values).iter().map(|[v]| *v).collect()
}

/// 1/g, and 0 where nothing arrives.
fn inverse(arriving: &[f32], gaussian: &Gaussian) -> Vec<f32> {
    let peak = 1.0 / (2.0 * std::f32::consts::PI * gaussian.width * gaussian.width);
    let largest = gaussian.leaving.iter().fold(0.0f32, |m, v| m.max(*v));
    let least = (MIN_ARRIVING * peak * largest).max(f32::MIN_POSITIVE);
    arriving.iter().map(|g| if *g > least { 1.0 / g } else { 0.0 }).collect()
}

/// Symmetric scaling: d ← √(d/g), g = G·(A·d), until d·g = 1. `[eq:transport-balance]`
fn balanced(mut gaussian: Gaussian, surfels: &Surfels, origin: Vec3) -> Gaussian {
    let areas = &surfels.areas;
    let sum = GaussianSum::new(&surfels.positions, &surfels.positions, gaussian.width, origin, gaussian.lattice);
    let mut d = vec![1.0f32; areas.len()];
    let weighted = |d: &[f32]| -> Vec<f32> { areas.iter().zip(d).map(|(a, d)| a * d).collect() };
    for _ in 0..BALANCE_ROUNDS {
        gaussian.leaving = weighted(&d);
        let arriving = one_column(&sum, &gaussian.leaving);
        let inverse = inverse(&arriving, &gaussian);
        let off = d.iter().zip(&arriving).map(|(d, g)| (d * g - 1.0).abs()).fold(0.0, f32::max);
        if off <= BALANCE_TOLERANCE {
            break;
        }
        d.iter_mut().zip(&inverse).for_each(|(d, r)| *d = (*d * r).sqrt());
    }
    gaussian.leaving = weighted(&d);
    let arriving = one_column(&sum, &gaussian.leaving);
    let inverse = inverse(&arriving, &gaussian);
    // What leaves anywhere of one unit that enters at j; the most of it is brought to 1.
    let back = one_column(&sum, &weighted(&inverse));
    let most = d.iter().zip(&back).map(|(d, b)| d * b).fold(1.0f32, f32::max);
    gaussian.scale = 1.0 / most;
    gaussian
}

/// Transport to certain positions.
pub struct Receivers<'a> {
    transport: &'a SurfelTransport,
    positions: &'a [Vec3],
    /// For each width the sum and what it is multiplied by at each receiver.
    arrivals: Vec<(GaussianSum<'a>, Vec<f32>)>,
}

/// Columns `start .. start + length` of a matrix of `columns`, each row times its factor.
fn pack<const C: usize>(values: &[f32], columns: usize, start: usize, length: usize, factors: &[f32]) -> Vec<[f32; C]> {
    let row = |(row, factor): (&[f32], &f32)| {
        let mut packed = [0.0; C];
        packed.iter_mut().zip(&row[start..start + length]).for_each(|(p, v)| *p = factor * v);
        packed
    };
    values.chunks_exact(columns).zip(factors).map(row).collect()
}

/// The sum over sources of some columns, without the receivers' factors: targets × length.
fn summed(
    sum: &GaussianSum<'_>,
    factors: &[f32],
    values: &[f32],
    columns: usize,
    (start, length): (usize, usize),
) -> Vec<f32> {
    fn flat<const C: usize>(rows: &[[f32; C]], length: usize) -> Vec<f32> {
        rows.iter().flat_map(|row| row[..length].iter().copied()).collect()
    }
    if length <= FEW {
        flat(&sum.apply(&pack::<FEW>(values, columns, start, length, factors)), length)
    } else {
        flat(&sum.apply(&pack::<WIDE>(values, columns, start, length, factors)), length)
    }
}

/// Where each group of columns begins, and how many it has.
fn groups(columns: usize) -> Vec<(usize, usize)> {
    (0..columns).step_by(WIDE).map(|start| (start, WIDE.min(columns - start))).collect()
}

impl<'a> Receivers<'a> {
    fn columns(&self, irradiance: &[f32]) -> Result<usize, ShadingError> {
        let surfels = self.transport.surfels.positions.len();
        if surfels > 0 && !irradiance.is_empty() && irradiance.len().is_multiple_of(surfels) {
            return Ok(irradiance.len() / surfels);
        }
        Err(ShadingError::Shape {
            what: "irradiance of surfels",
            expected: format!("a multiple of {surfels} values, one row for each surfel"),
            found: format!("{} values", irradiance.len()),
        })
    }

    /// Transport of each width alone: for every width a matrix receivers × columns of radiosity, from irradiance of surfels ×
    /// columns (lights, or lights × channels).
    /// `[eq:surfel-transport]`
    pub fn basis(&self, irradiance: &[f32]) -> Result<Vec<Vec<f32>>, ShadingError> {
        let columns = self.columns(irradiance)?;
        let groups = groups(columns);
        let parts = map_chunks(self.arrivals.len() * groups.len(), |task| {
            let (k, group) = (task / groups.len(), groups[task % groups.len()]);
            summed(&self.arrivals[k].0, &self.transport.gaussians[k].leaving, irradiance, columns, group)
        });
        let matrix = |k: usize| {
            let mut out = vec![0.0; self.positions.len() * columns];
            for ((start, length), part) in groups.iter().zip(&parts[k * groups.len()..]) {
                for (i, factor) in self.arrivals[k].1.iter().enumerate() {
                    let to = &mut out[i * columns + start..][..*length];
                    to.iter_mut().zip(&part[i * length..]).for_each(|(o, v)| *o = factor * v);
                }
            }
            out
        };
        Ok((0..self.arrivals.len()).map(matrix).collect())
    }

    /// [`Receivers::exitance`] of white light, which has one column for each light instead of three: receivers × lights × 3, from scalar
    /// irradiance of surfels × lights. Up to three times as fast.
    /// `[eq:surfel-transport]`
    pub fn white_exitance(&self, profile: &RadialProfile, irradiance: &[f32]) -> Result<Vec<f32>, ShadingError> {
        let lights = self.columns(irradiance)?;
        self.check_widths_of(profile, lights)?;
        let mut out = vec![0.0f32; self.positions.len() * lights * 3];
        for (start, length) in groups(lights) {
            let parts = map_chunks(self.arrivals.len(), |k| {
                let leaving = &self.transport.gaussians[k].leaving;
                summed(&self.arrivals[k].0, leaving, irradiance, lights, (start, length))
            });
            for (k, part) in parts.iter().enumerate() {
                let weight = profile.weights[k].to_array();
                for (i, factor) in self.arrivals[k].1.iter().enumerate() {
                    let to = &mut out[(i * lights + start) * 3..][..3 * length];
                    for (to, v) in to.as_chunks_mut::<3>().0.iter_mut().zip(&part[i * length..]) {
                        (0..3).for_each(|c| to[c] += weight[c] * factor * v);
                    }
                }
            }
        }
        Ok(out)
    }

    fn check_widths_of(&self, profile: &RadialProfile, columns: usize) -> Result<(), ShadingError> {
        if profile.widths() == self.transport.widths {
            return Ok(());
        }
        Err(ShadingError::Shape {
            what: "exitance under a profile",
            expected: format!("the widths {:?}", self.transport.widths),
            found: format!("{columns} columns and the widths {:?}", profile.widths()),
        })
    }

    /// Radiosity under a profile whose widths are the transport's: receivers × lights × 3, from irradiance of surfels × lights × 3.
    /// Radiance of an ideally diffuse exit is that over π. The pullback takes a cotangent of the result.
    /// `[eq:surfel-transport]`
    pub fn exitance<'p>(
        &'p self,
        profile: &'p RadialProfile,
        irradiance: &'p [f32],
    ) -> Result<(Vec<f32>, ExitancePullback<'p>), ShadingError> {
        let columns = self.columns(irradiance)?;
        self.check_widths_of(profile, columns)?;
        if !columns.is_multiple_of(3) {
            return Err(ShadingError::Shape {
                what: "exitance under a profile",
                expected: "three columns for each light".into(),
                found: format!("{columns} columns"),
            });
        }
        let mut out = vec![0.0f32; self.positions.len() * columns];
        for (start, length) in groups(columns) {
            let parts = map_chunks(self.arrivals.len(), |k| {
                let leaving = &self.transport.gaussians[k].leaving;
                summed(&self.arrivals[k].0, leaving, irradiance, columns, (start, length))
            });
            for (k, part) in parts.iter().enumerate() {
                let weight = profile.weights[k].to_array();
                for (i, factor) in self.arrivals[k].1.iter().enumerate() {
                    for c in 0..length {
                        out[i * columns + start + c] += weight[(start + c) % 3] * factor * part[i * length + c];
                    }
                }
            }
        }
        Ok((out, ExitancePullback { receivers: self, profile, irradiance }))
    }
}

/// Takes a cotangent of [`Receivers::exitance`] to the profile's weights and to the irradiance of surfels (and from there to normals
/// and positions, by [`crate::SurfelLighting::pull`]). Distances, areas and the balance are constants.
pub struct ExitancePullback<'p> {
    receivers: &'p Receivers<'p>,
    profile: &'p RadialProfile,
    irradiance: &'p [f32],
}

/// Gradient of a scalar with respect to what [`Receivers::exitance`] was made from.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ExitanceGrad {
    /// With respect to the weights of the profile.
    pub weights: Vec<Vec3>,
    /// With respect to the irradiance: surfels × lights × 3.
    pub irradiance: Vec<f32>,
}

impl ExitancePullback<'_> {
    /// The pullback. `d_out` is receivers × lights × 3.
    /// `[eq:surfel-transport]`
    pub fn pull(&self, d_out: &[f32]) -> Result<ExitanceGrad, ShadingError> {
        let Receivers { transport, positions, arrivals } = self.receivers;
        let columns = self.receivers.columns(self.irradiance)?;
        check_length("cotangent of the exitance", positions.len() * columns, d_out.len())?;
        let surfels = &transport.surfels.positions;
        let reversed = map_chunks(arrivals.len(), |k| {
            let g = &transport.gaussians[k];
            GaussianSum::new(positions, surfels, g.width, transport.origin, g.lattice)
        });
        let mut grad =
            ExitanceGrad { weights: vec![Vec3::ZERO; arrivals.len()], irradiance: vec![0.0; self.irradiance.len()] };
        let mut d_weights = vec![[0.0f64; 3]; arrivals.len()];
        for (start, length) in groups(columns) {
            let parts = map_chunks(arrivals.len(), |k| {
                let ((sum, factors), leaving) = (&arrivals[k], &transport.gaussians[k].leaving);
                let forward = summed(sum, leaving, self.irradiance, columns, (start, length));
                let mut d_weight = [0.0f64; 3];
                for (i, factor) in factors.iter().enumerate() {
                    for c in 0..length {
                        let product = factor * forward[i * length + c] * d_out[i * columns + start + c];
                        d_weight[(start + c) % 3] += f64::from(product);
                    }
                }
                (d_weight, summed(&reversed[k], factors, d_out, columns, (start, length)))
            });
            for (k, (d_weight, back)) in parts.iter().enumerate() {
                let weight = self.profile.weights[k].to_array();
                (0..3).for_each(|c| d_weights[k][c] += d_weight[c]);
                for (j, leaving) in transport.gaussians[k].leaving.iter().enumerate() {
                    for c in 0..length {
                        grad.irradiance[j * columns + start + c] +=
                            weight[(start + c) % 3] * leaving * back[j * length + c];
                    }
                }
            }
        }
        let narrow = |d: &[f64; 3]| Vec3::new(d[0] as f32, d[1] as f32, d[2] as f32);
        grad.weights = d_weights.iter().map(narrow).collect();
        Ok(grad)
    }
}
