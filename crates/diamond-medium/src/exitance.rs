//! The light that leaves the surfels of a surface under any lights, for a given medium.
use crate::fit::{irradiance, normals_of, surfel_transport};
use crate::walk_fit::{boundary, cosines};
use crate::{Medium, MediumError, Surface, Transport};
use diamond_light::{Falloff, OlatLight};
use diamond_pathtrace::{ExitWalkOptions, ExitWalks, WalkOperator};
use diamond_shading::{RadialProfile, SurfelTransport};
use glam::Vec3;
use std::f32::consts::PI;

/// Walks from each surfel: their noise is averaged over the surfels around a place.
const WALKS: u32 = 256;
/// Scatterings after which a walk is cut off.
const MAX_EVENTS: u32 = 20_000;

/// Transport of a medium between the surfels of a surface, made once for all lights.
#[derive(Debug)]
pub struct Exitance {
    form: Form,
}

#[derive(Debug)]
enum Form {
    Profile { profile: RadialProfile, transport: Box<SurfelTransport> },
    Walk { operators: Box<[WalkOperator; 3]>, gain: Vec3 },
}

impl Exitance {
    /// Prepares transport: for walks, traces them.
    pub fn new(surface: &Surface, medium: &Medium) -> Result<Self, MediumError> {
        medium.validate()?;
        let form = match &medium.transport {
            Transport::Profile { .. } => {
                let profile = medium.profile()?;
                let transport = Box::new(surfel_transport(surface, profile.widths().to_vec())?);
                Form::Profile { profile, transport }
            }
            Transport::Walk { sigma_t, albedo, g, ior, gain } => {
                let options = ExitWalkOptions { walks: WALKS, max_events: MAX_EVENTS, seed: 0 };
                let trace = |sigma: f32| {
                    let (geometry, patches) = (surface.geometry(), surface.patches());
                    ExitWalks::trace(geometry, sigma, *g, boundary(*ior), patches, &options, &|_| ())
                };
                let mut walks: Vec<(f32, ExitWalks)> = Vec::new();
                for sigma in sigma_t {
                    if !walks.iter().any(|w| w.0 == *sigma) {
                        walks.push((*sigma, trace(*sigma)?));
                    }
                }
                let of = |c: usize| {
                    let found = walks.iter().find(|w| w.0 == sigma_t[c]).map(|w| w.1.collapse(albedo[c]));
                    found.unwrap_or_else(|| trace(sigma_t[c])?.collapse(albedo[c]))
                };
                Form::Walk { operators: Box::new([of(0)?, of(1)?, of(2)?]), gain: Vec3::from(*gain) }
            }
        };
        Ok(Self { form })
    }

    /// Radiance that leaves each surfel under each light with intensity 1, averaged over directions: for each light surfels × 3, linear RGB.
    pub fn under(
        &self,
        surface: &Surface,
        lights: &[OlatLight],
        falloff: Falloff,
    ) -> Result<Vec<Vec<f32>>, MediumError> {
        let lamps: Vec<OlatLight> = lights.iter().map(OlatLight::of_unit_intensity).collect();
        let entering = irradiance(surface, surface.positions(), &normals_of(surface), &lamps, falloff)?;
        let (n, surfels) = (lamps.len(), surface.positions().len());
        match &self.form {
            Form::Profile { profile, transport } => {
                let out = transport.receivers(surface.positions())?.white_exitance(profile, &entering)?;
                let of =
                    |l: usize| (0..surfels).flat_map(|j| out[(j * n + l) * 3..][..3].iter().map(|v| v / PI)).collect();
                Ok((0..n).map(of).collect())
            }
            Form::Walk { operators, gain } => {
                let cosines = cosines(surface, &lamps);
                let mut out = vec![vec![0.0f32; 3 * surfels]; n];
                for (c, operator) in operators.iter().enumerate() {
                    let radiosity = operator.radiosity(&entering, &cosines)?;
                    for (l, out) in out.iter_mut().enumerate() {
                        (0..surfels).for_each(|j| out[3 * j + c] = gain[c] * radiosity[j * n + l] / PI);
                    }
                }
                Ok(out)
            }
        }
    }

    /// How far light goes: of what leaves anywhere, the part per ring of distance between entry and exit, for rings whose radius grows by a constant factor
    /// from half a surfel's width to the diameter of the object; (outer radius in scene units, linear RGB that add up to the reflectance of the object
    /// under light from all sides). Distances below a surfel's width are together.
    pub fn spread(&self, surface: &Surface) -> Vec<(f32, Vec3)> {
        let (least, most) = (0.5 * surface.spacing(), 2.0 * surface.radius());
        let ratio = libm::logf(most / least);
        let ring = |d: f32| ((libm::logf(d.max(least) / least) / ratio * RINGS as f32) as usize).min(RINGS - 1);
        let mut rings: Vec<(f32, Vec3)> =
            (0..RINGS).map(|k| (least * libm::expf(ratio * (k + 1) as f32 / RINGS as f32), Vec3::ZERO)).collect();
        match &self.form {
            Form::Profile { profile, .. } => {
                // Within a circle a Gaussian has 1 − exp(−r²/2σ²).
                let within = |r: f32| -> Vec3 {
                    let each = profile.widths().iter().zip(&profile.weights);
                    each.map(|(s, w)| *w * (1.0 - libm::expf(-0.5 * (r / s) * (r / s)))).sum()
                };
                let mut before = Vec3::ZERO;
                for (radius, share) in &mut rings {
                    let now = within(*radius);
                    *share = now - before;
                    before = now;
                }
            }
            Form::Walk { operators, gain } => {
                let patches = surface.patches();
                let area: f32 = patches.iter().map(|p| p.area).sum();
                for (c, operator) in operators.iter().enumerate() {
                    for (i, patch) in patches.iter().enumerate() {
                        for k in operator.offsets[i] as usize..operator.offsets[i + 1] as usize {
                            let apart = patch.position.distance(patches[operator.sources[k] as usize].position);
                            rings[ring(apart)].1[c] += gain[c] * operator.weights[k] * patch.area / area;
                        }
                    }
                }
            }
        }
        rings
    }

    /// Factor on the radiance of a surfel toward the outer cosine `mu`, −1 … 1: linear RGB; 1 for profiles in front. Nothing leaves toward the inside: what is seen from behind, through
    /// gaps between Gaussians, falls to 0 with 1 + mu, slowly, since normals are not exact.
    #[inline]
    pub fn toward(&self, mu: f32) -> Vec3 {
        let front = (1.0 + mu).clamp(0.0, 1.0);
        match &self.form {
            Form::Profile { .. } => Vec3::splat(front),
            Form::Walk { operators, .. } => {
                // Seen at the very edge as if a little before it, so that no normal turns a Gaussian black.
                let mu = mu.max(MIN_COS_THETA_O);
                front * Vec3::from(std::array::from_fn(|c| operators[c].angular.at(mu)))
            }
        }
    }
}

/// Rings of [`Exitance::spread`].
const RINGS: usize = 40;

/// Least outer cosine at which exits are looked up.
const MIN_COS_THETA_O: f32 = 0.1;

impl Medium {
    /// The part that leaves where it enters, radiance per irradiance: linear RGB.
    pub fn local(&self) -> Vec3 {
        match &self.transport {
            Transport::Profile { local, .. } => Vec3::from(*local) / PI,
            Transport::Walk { .. } => Vec3::ZERO,
        }
    }
}
