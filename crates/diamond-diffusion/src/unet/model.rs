//! The UNet itself.
use super::condition::{Conditions, LightInput, Pass};
use super::config::{LIGHT_CHANNELS, RAY_CHANNELS, UNetConfig};
use super::control::ControlResiduals;
use super::encoder::{Encoder, Stage};
use super::residual::RESIDUAL_EPS;
use crate::error::{DiffusionError, Result};
use crate::nn::{Conv2d, GroupNorm, Scope, TimeEmbedding, timestep_embedding, upsample_nearest};
use candle_core::Tensor;

/// One level on the way up.
#[derive(Debug)]
struct Level {
    stages: Vec<Stage>,
    upsample: Option<Conv2d>,
}

/// A denoising network. The names of its weights are those of the diffusers layout, with `light.*`, `ray.*`, `norm_views.*` and
/// `attn_views.*` for what that layout does not know.
#[derive(Debug)]
pub struct UNet {
    config: UNetConfig,
    time: TimeEmbedding,
    light: Option<LightInput>,
    encoder: Encoder,
    levels: Vec<Level>,
    norm_out: GroupNorm,
    conv_out: Conv2d,
}

/// Checks a noisy picture and what is told beside it.
pub(super) fn check_input(
    config: &UNetConfig,
    x: &Tensor,
    timesteps: &[f32],
    conditions: &Conditions<'_>,
) -> Result<()> {
    let (multiple, dims) = (config.multiple(), x.dims());
    let fits = matches!(dims, [batch, channels, height, width]
        if *batch == timesteps.len() && *channels == config.in_channels
            && height % multiple == 0 && width % multiple == 0 && *height > 0 && *width > 0);
    if !fits {
        let (batch, channels) = (timesteps.len(), config.in_channels);
        let expected = format!("[{batch}, {channels}, height, width] with sides that are multiples of {multiple}");
        return Err(DiffusionError::Shape { what: "noisy picture".into(), expected, found: format!("{dims:?}") });
    }
    let batch = timesteps.len();
    let given = [
        ("light code", config.light.is_some(), conditions.light, vec![batch, LIGHT_CHANNELS]),
        ("ray map", config.rays, conditions.rays, vec![batch, RAY_CHANNELS]),
    ];
    for (what, wanted, tensor, shape) in given {
        let found = tensor.map(|t| t.dims()[..t.rank().min(2)].to_vec());
        if found != wanted.then_some(shape.clone()) {
            return Err(DiffusionError::shape(what, wanted.then_some(shape), found));
        }
    }
    if let (Some(context), Some(channels)) = (conditions.context, config.context)
        && (context.rank() != 3 || context.dims()[0] != batch || context.dims()[2] != channels)
    {
        return Err(DiffusionError::shape("context", format!("[{batch}, tokens, {channels}]"), context.dims()));
    }
    Ok(())
}

impl UNet {
    /// With weights from `scope`'s source.
    pub fn new(scope: &Scope<'_>, config: &UNetConfig) -> Result<Self> {
        config.validate()?;
        let embedding = config.embedding();
        let light = LightInput::new(scope, config)?;
        let time = TimeEmbedding::new(&scope.at("time_embedding"), config.channels[0], embedding)?;
        let encoder = Encoder::new(scope, config)?;
        let mut skips = Encoder::skip_channels(config);
        let mut c_in = config.channels[config.channels.len() - 1];
        let mut levels = Vec::new();
        for (index, level) in (0..config.channels.len()).rev().enumerate() {
            let scope = scope.at("up_blocks").at(index);
            let mut stages = Vec::new();
            for stage in 0..=config.blocks {
                let c_skip = skips.pop().unwrap_or(0);
                stages.push(Stage::new(&scope, config, level, stage, c_in + c_skip, config.attention[level])?);
                c_in = config.channels[level];
            }
            let upsample = match level > 0 {
                true => Some(Conv2d::new(&scope.at("upsamplers.0.conv"), c_in, c_in, 3)?),
                false => None,
            };
            levels.push(Level { stages, upsample });
        }
        Ok(Self {
            time,
            light,
            encoder,
            levels,
            norm_out: GroupNorm::new(&scope.at("conv_norm_out"), c_in, config.groups, RESIDUAL_EPS)?,
            conv_out: Conv2d::new(&scope.at("conv_out"), c_in, config.out_channels, 3)?,
            config: config.clone(),
        })
    }

    /// The sizes that it was built with.
    pub fn config(&self) -> &UNetConfig {
        &self.config
    }

    /// What the network predicts for noisy pictures (batch, in, height, width), each at a timestep of its own.
    pub fn forward(
        &self,
        x: &Tensor,
        timesteps: &[f32],
        conditions: &Conditions<'_>,
        control: Option<&ControlResiduals>,
    ) -> Result<Tensor> {
        check_input(&self.config, x, timesteps, conditions)?;
        let sines = timestep_embedding(timesteps, self.config.channels[0], x.dtype(), x.device())?;
        let mut embedding = self.time.forward(&sines)?;
        let mut context = conditions.context.cloned();
        if let (Some(input), Some(light)) = (&self.light, conditions.light) {
            (embedding, context) = input.add(light, embedding, context)?;
        }
        let pass = Pass::new(&embedding, context, conditions)?;
        let (mut skips, mut h) = self.encoder.forward(x, None, &pass)?;
        if let Some(control) = control {
            h = (h + &control.middle)?;
            if control.skips.len() != skips.len() {
                return Err(DiffusionError::shape("control", skips.len(), control.skips.len()));
            }
            skips = skips.iter().zip(&control.skips).map(|(a, b)| a + b).collect::<candle_core::Result<_>>()?;
        }
        for level in &self.levels {
            for stage in &level.stages {
                let skip = skips.pop().ok_or_else(|| DiffusionError::shape("feature maps", "one a stage", "none"))?;
                h = stage.forward(&Tensor::cat(&[&h, &skip], 1)?, &pass)?;
            }
            if let Some(upsample) = &level.upsample {
                h = upsample.forward(&upsample_nearest(&h, 2)?)?;
            }
        }
        self.conv_out.forward(&self.norm_out.forward_silu(&h)?)
    }
}
