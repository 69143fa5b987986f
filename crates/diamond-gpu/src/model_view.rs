//! What the stages between parameters and residual know of the model, the view and the light.
use bytemuck::{Pod, Zeroable};
use diamond_camera::Camera;
use diamond_light::{Falloff, OlatLight};
use diamond_reconstruct::{ChannelLayout, PullSample, StepMedium};
use diamond_shading::{InputScaling, LightDistanceInput, channel};
use glam::Vec3;

/// `ModelView` of `model_view.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, Pod, Zeroable)]
pub(crate) struct ModelView {
    pub eye: [f32; 3],
    pub directional: u32,
    pub centre: [f32; 3],
    pub inverse_half: f32,
    pub light: [f32; 3],
    pub light_reference: f32,
    pub channels: u32,
    pub codes: u32,
    pub harmonics: u32,
    pub network: u32,
    pub first: u32,
    pub rows: u32,
    pub width: u32,
    pub weight: f32,
    pub local: [f32; 3],
    pub whole: f32,
    pub falloff_reference: f32,
    pub tint: f32,
    pub sample_distance: f32,
    pub unused_0: f32,
}

/// Flags of [`ModelView::network`].
pub(crate) mod network {
    /// There is a network.
    pub const THERE: u32 = 1;
    /// It has a head for incident light.
    pub const INCIDENT: u32 = 2;
    /// That head learns.
    pub const INCIDENT_LEARNS: u32 = 4;
    /// Normals learn by the network.
    pub const NORMALS_LEARN: u32 = 8;
}

/// Half the side of a scene's box is at least this, as on the CPU.
const MIN_HALF_EXTENT: f32 = 1e-6;
/// References of distances are at least this, as on the CPU.
const MIN_LENGTH: f32 = 1e-20;

/// A bit for each channel of the shader that is blended.
pub(crate) fn channel_bits(layout: &ChannelLayout) -> u32 {
    (0..channel::COUNT).filter(|c| layout.place(*c).is_some()).fold(0, |bits, c| bits | 1 << c)
}

impl ModelView {
    /// Of a scene, a view and a light; what the network and the medium say is added by the caller.
    pub fn new(camera: &Camera, light: &OlatLight, scaling: &InputScaling) -> Self {
        let half = (0.5 * scaling.bounds_max - 0.5 * scaling.bounds_min).max(Vec3::splat(MIN_HALF_EXTENT));
        let (place, directional) = match *light {
            OlatLight::Point { position, .. } => (position, 0),
            OlatLight::Directional { direction, .. } => (direction, 1),
        };
        Self {
            eye: camera.pose.centre().to_array(),
            directional,
            centre: (0.5 * scaling.bounds_min + 0.5 * scaling.bounds_max).to_array(),
            inverse_half: half.x.recip(),
            light: place.to_array(),
            light_reference: match scaling.light_distance {
                LightDistanceInput::Bounded { reference } => reference.max(MIN_LENGTH),
                LightDistanceInput::Linear => 1.0,
            },
            whole: 1.0,
            ..Self::default()
        }
    }

    /// With a medium.
    pub fn with_medium(self, medium: &StepMedium) -> Self {
        let falloff_reference = match medium.falloff {
            Falloff::InverseSquare { reference } => reference,
            Falloff::None => 0.0,
        };
        Self { local: medium.local.to_array(), whole: medium.whole, falloff_reference, tint: medium.tint, ..self }
    }
}

/// `Sample` of `sample.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct Sample {
    pub viewer: [f32; 3],
    pub gaussian: u32,
    pub light: [f32; 3],
    pub visibility: f32,
}

impl Sample {
    pub fn of(sample: &PullSample) -> Self {
        Self {
            viewer: sample.view.to_array(),
            gaussian: sample.gaussian,
            light: sample.light.to_array(),
            visibility: sample.visibility,
        }
    }
}
