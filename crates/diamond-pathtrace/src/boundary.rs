//! The boundary of the translucent object: nothing at all, a polished dielectric, or a rough one.
//!
//! A rough boundary reflects and refracts at the facets of a GGX surface, once (Walter et al. 2007): what microfacets would pass to
//! each other is lost, so it darkens with roughness and a white object behind it is not white. What is traced is radiance,
//! against the light, hence the factor 1/η² on what is transmitted.
use crate::error::{PathtraceError, check};
use crate::fresnel::dielectric;
use crate::ggx;
use crate::{Frame, Rng};
use glam::Vec3;

/// Indices of refraction nearer to 1 than this are a boundary that is none: the half vector of refraction would be 0/0.
const MATCHED: f32 = 1e-4;

/// The boundary between the object and the air around it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Boundary {
    /// The medium has the index of refraction of its surroundings; light passes straight.
    #[default]
    IndexMatched,
    /// A polished dielectric.
    Smooth {
        /// Index of refraction of the inside relative to the outside, 0.25 … 4.
        eta: f32,
    },
    /// A rough dielectric.
    Rough {
        /// Index of refraction of the inside relative to the outside, 0.25 … 4.
        eta: f32,
        /// Width of the GGX lobe (perceptual roughness squared), 0.001 … 1.
        alpha: f32,
    },
}

/// A direction that a boundary was sampled for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoundarySample {
    /// Unit direction in which the path goes on, world.
    pub direction: Vec3,
    /// Factor on the throughput of a path traced from the camera.
    pub weight: f32,
    /// Density per steradian; infinite for a polished boundary.
    pub pdf: f32,
    /// Whether the path goes to the other side.
    pub transmitted: bool,
    /// (index there/index here)² if transmitted, else 1: what the weight's radiance scale has to be multiplied by to be energy.
    pub energy_scale: f32,
}

impl Boundary {
    /// `Err` where a number is outside its range.
    pub fn validate(&self) -> Result<(), PathtraceError> {
        let index = |eta| {
            check("index of refraction of a boundary", eta, "a number from 0.25 to 4", |v| (0.25..=4.0).contains(&v))
        };
        match *self {
            Boundary::IndexMatched => Ok(()),
            Boundary::Smooth { eta } => index(eta),
            Boundary::Rough { eta, alpha } => {
                index(eta)?;
                let expected = "a number from 0.001 to 1 (below, use the smooth boundary)";
                check("alpha of a rough boundary", alpha, expected, |v| (ggx::MIN_ALPHA..=1.0).contains(&v))
            }
        }
    }

    /// The boundary that behaves in the same way, with those that are none recognised.
    pub fn effective(self) -> Self {
        match self {
            Boundary::Smooth { eta } | Boundary::Rough { eta, .. } if (eta - 1.0).abs() < MATCHED => {
                Boundary::IndexMatched
            }
            other => other,
        }
    }

    /// Draws how a path that arrived with `outgoing` (unit, back along the path) goes on. `normal` is the surface's outward
    /// unit normal; on which side of it `outgoing` lies says whether the path comes from outside. `None`: the path is absorbed,
    /// because the light would have needed several facets.
    pub fn sample(&self, outgoing: Vec3, normal: Vec3, rng: &mut Rng) -> Option<BoundarySample> {
        let outside = outgoing.dot(normal) >= 0.0;
        let facing = if outside { normal } else { -normal };
        match self.effective() {
            Boundary::IndexMatched => Some(BoundarySample {
                direction: -outgoing,
                weight: 1.0,
                pdf: f32::INFINITY,
                transmitted: true,
                energy_scale: 1.0,
            }),
            Boundary::Smooth { eta } => {
                Some(sample_smooth(if outside { eta } else { 1.0 / eta }, outgoing, facing, rng))
            }
            Boundary::Rough { eta, alpha } => {
                sample_rough(if outside { eta } else { 1.0 / eta }, alpha, outgoing, facing, rng)
            }
        }
    }

    /// For light that arrives from `incident` and leaves to `outgoing` (both unit, away from the surface): the scattering function
    /// times |cos| of the incident direction, as radiance, and the density with which [`Boundary::sample`] draws `incident`. Zero
    /// for boundaries without a lobe.
    /// `[eq:rough-dielectric]`
    pub fn evaluate(&self, outgoing: Vec3, incident: Vec3, normal: Vec3) -> (f32, f32) {
        let Boundary::Rough { eta, alpha } = self.effective() else { return (0.0, 0.0) };
        let outside = outgoing.dot(normal) >= 0.0;
        let frame = Frame::new(if outside { normal } else { -normal });
        let eta = if outside { eta } else { 1.0 / eta };
        evaluate_rough(eta, alpha, frame.to_local(outgoing), frame.to_local(incident))
    }
}

fn sample_smooth(eta: f32, outgoing: Vec3, facing: Vec3, rng: &mut Rng) -> BoundarySample {
    let cos_o = outgoing.dot(facing).clamp(0.0, 1.0);
    let (reflectance, cos_t) = dielectric(cos_o, eta);
    if rng.uniform() < reflectance {
        let direction = (facing * (2.0 * cos_o) - outgoing).normalize();
        return BoundarySample { direction, weight: 1.0, pdf: f32::INFINITY, transmitted: false, energy_scale: 1.0 };
    }
    let direction = (facing * (cos_o / eta - cos_t) - outgoing / eta).normalize();
    let scale = eta * eta;
    BoundarySample { direction, weight: 1.0 / scale, pdf: f32::INFINITY, transmitted: true, energy_scale: scale }
}

fn sample_rough(eta: f32, alpha: f32, outgoing: Vec3, facing: Vec3, rng: &mut Rng) -> Option<BoundarySample> {
    let frame = Frame::new(facing);
    let o = frame.to_local(outgoing);
    let h = ggx::sample_visible_normal(alpha, o, rng);
    let cos_oh = o.dot(h);
    if cos_oh <= 0.0 {
        return None;
    }
    let (reflectance, cos_t) = dielectric(cos_oh, eta);
    let transmitted = rng.uniform() >= reflectance;
    let i = match transmitted {
        false => h * (2.0 * cos_oh) - o,
        true => h * (cos_oh / eta - cos_t) - o / eta,
    };
    let i = i.normalize();
    // A facet may send light below the horizon, or refract it back above.
    if (i.z < 0.0) != transmitted || i.z == 0.0 {
        return None;
    }
    let (_, pdf) = evaluate_rough(eta, alpha, o, i);
    let scale = if transmitted { eta * eta } else { 1.0 };
    // What is left of value/pdf: the masking of the other direction.
    let weight = ggx::masking(alpha, i) / scale;
    let direction = frame.to_world(i);
    (pdf > 0.0 && pdf.is_finite()).then_some(BoundarySample {
        direction,
        weight,
        pdf,
        transmitted,
        energy_scale: scale,
    })
}

/// [`Boundary::evaluate`] in the frame whose z is on the side of `o`; `eta` is the other side's index over this side's.
fn evaluate_rough(eta: f32, alpha: f32, o: Vec3, i: Vec3) -> (f32, f32) {
    if o.z <= 0.0 || i.z == 0.0 {
        return (0.0, 0.0);
    }
    let reflected = i.z > 0.0;
    let h = if reflected { o + i } else { -(o + i * eta) };
    // Towards the side of `o`, whichever medium is denser.
    let h = if h.z < 0.0 { -h } else { h };
    let Some(h) = h.try_normalize() else { return (0.0, 0.0) };
    let (cos_oh, cos_ih) = (o.dot(h), i.dot(h));
    if cos_oh <= 0.0 || (cos_ih > 0.0) != reflected {
        return (0.0, 0.0);
    }
    let (reflectance, _) = dielectric(cos_oh, eta);
    let visible = ggx::visible_normal_pdf(alpha, o, h);
    let pdf = if reflected {
        reflectance * visible / (4.0 * cos_oh)
    } else {
        let path = cos_oh + eta * cos_ih;
        // Zero only where the two media do not differ, which `effective` has excluded up to rounding.
        let squared = (path * path).max(f32::MIN_POSITIVE);
        (1.0 - reflectance) * visible * eta * eta * cos_ih.abs() / squared
    };
    let scale = if reflected { 1.0 } else { 1.0 / (eta * eta) };
    let value = pdf * ggx::masking(alpha, i) * scale;
    if value.is_finite() { (value, pdf) } else { (0.0, 0.0) }
}
