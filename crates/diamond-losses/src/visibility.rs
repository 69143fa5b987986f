//! Losses on what light arrives at the Gaussians: incident light and spherical-harmonic visibility.
use crate::average::{finite, subgradient};
use crate::error::expect_slice;
use crate::{LossError, SliceLoss};

/// Value and gradients of [`incident_light`].
#[derive(Debug, Clone, PartialEq)]
pub struct IncidentLoss {
    /// The loss.
    pub value: f32,
    /// Gradient with respect to the incident light.
    pub d_incident: Vec<f32>,
    /// Gradient with respect to the visibility; leave it out to detach.
    pub d_visibility: Vec<f32>,
}

/// `[eq:incident]` Mean absolute difference `mean|clamp(L_in, 0, 1) − V|` of the incident light that the network predicts
/// (per Gaussian) and its visibility toward the light, in `[0, 1]`. The clamp passes gradient in `[0, 1]` only; the
/// gradient of |·| at 0 is 0. Empty slices give 0. Errors: unequal lengths, NaN or infinity.
pub fn incident_light(incident: &[f32], visibility: &[f32]) -> Result<IncidentLoss, LossError> {
    expect_slice(incident, incident.len(), "incident loss: incident light")?;
    expect_slice(visibility, incident.len(), "incident loss: visibility")?;
    let clamped: Vec<f32> = incident.iter().map(|v| v.clamp(0.0, 1.0)).collect();
    let loss = absolute(&clamped, visibility);
    let d_visibility = loss.grad.iter().map(|g| -g).collect();
    let passes = |(g, l): (&f32, &f32)| if (0.0..=1.0).contains(l) { *g } else { 0.0 };
    let d_incident = loss.grad.iter().zip(incident).map(passes).collect();
    Ok(IncidentLoss { value: loss.value, d_incident, d_visibility })
}

/// `[eq:visibility]` Mean absolute difference `mean|V_SH − V_RT|` of the visibility that spherical harmonics give and the
/// traced one (a constant), one value per sampled Gaussian and direction; gradient with respect to V_SH, 0 where they
/// are equal. Empty slices give 0. Errors: unequal lengths, NaN or infinity.
pub fn visibility(harmonic: &[f32], traced: &[f32]) -> Result<SliceLoss, LossError> {
    expect_slice(harmonic, harmonic.len(), "visibility loss: spherical harmonics")?;
    expect_slice(traced, harmonic.len(), "visibility loss: traced")?;
    Ok(absolute(harmonic, traced))
}

/// Mean |a − b| and its gradient with respect to `a`.
fn absolute(a: &[f32], b: &[f32]) -> SliceLoss {
    let scale = 1.0 / a.len().max(1) as f64;
    let mut sum = 0.0f64;
    let mut grad = Vec::with_capacity(a.len());
    for (a, b) in a.iter().zip(b) {
        let d = f64::from(*a) - f64::from(*b);
        sum += d.abs();
        grad.push(scale as f32 * subgradient(d as f32));
    }
    SliceLoss { value: finite(sum * scale), grad }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// [eq:incident]
    #[test]
    fn the_clamp_stops_the_gradient() {
        let loss = incident_light(&[-0.5, 0.25, 2.0, 1.0], &[0.5, 0.5, 0.5, 1.0]).unwrap();
        assert!((loss.value - 0.3125).abs() < 1e-7);
        assert_eq!(loss.d_incident, [0.0, -0.25, 0.0, 0.0]);
        assert_eq!(loss.d_visibility, [0.25, 0.25, -0.25, -0.0]);
        assert!(incident_light(&[0.0], &[]).is_err());
    }

    /// [eq:visibility]
    #[test]
    fn empty_slices_are_nothing() {
        assert_eq!(visibility(&[], &[]).unwrap(), SliceLoss { value: 0.0, grad: vec![] });
        assert!(matches!(visibility(&[f32::NAN], &[0.0]), Err(LossError::NonFinite { .. })));
    }
}
