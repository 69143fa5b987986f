//! The ControlNet: a copy of the way down that looks at hints, and whispers to the network on the way up.
use super::condition::{Conditions, LightInput, Pass};
use super::config::UNetConfig;
use super::encoder::Encoder;
use super::model::check_input;
use crate::error::{DiffusionError, Result};
use crate::nn::{Conv2d, Scope, TimeEmbedding, silu, timestep_embedding};
use candle_core::Tensor;

/// What a ControlNet adds to the feature maps of a UNet.
#[derive(Debug, Clone)]
pub struct ControlResiduals {
    /// One for each feature map that is kept on the way down.
    pub skips: Vec<Tensor>,
    /// For the middle.
    pub middle: Tensor,
}

/// Sizes of a ControlNet.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ControlConfig {
    /// The UNet whose way down is copied. Its light code enters here through the timestep.
    pub unet: UNetConfig,
    /// Channels of the hints.
    pub hints: usize,
    /// Channels of the hint network; each after the first halves the resolution.
    pub hint_channels: Vec<usize>,
}

impl ControlConfig {
    /// The relighter's: source colours (3), depth (1) and normals (3) at eight times the resolution of the latents.
    pub fn relighter() -> Self {
        Self { unet: UNetConfig::relighter(), hints: 7, hint_channels: vec![16, 32, 96, 256] }
    }

    /// For [`UNetConfig::tiny_relighter`], with hints at twice its resolution.
    pub fn tiny_relighter(hints: usize) -> Self {
        Self { unet: UNetConfig::tiny_relighter(), hints, hint_channels: vec![16, 32] }
    }
}

/// The hint network: pairs of convolutions that keep and halve the resolution, and a last one of zeros.
#[derive(Debug)]
struct HintNetwork {
    conv_in: Conv2d,
    blocks: Vec<Conv2d>,
    conv_out: Conv2d,
}

impl HintNetwork {
    fn new(scope: &Scope<'_>, config: &ControlConfig) -> Result<Self> {
        let Some(first) = config.hint_channels.first() else {
            return Err(DiffusionError::setting("hint_channels", "at least one entry", "none"));
        };
        let mut blocks = Vec::new();
        for (i, pair) in config.hint_channels.windows(2).enumerate() {
            blocks.push(Conv2d::new(&scope.at("blocks").at(2 * i), pair[0], pair[0], 3)?);
            blocks.push(Conv2d::strided(&scope.at("blocks").at(2 * i + 1), pair[0], pair[1], 3, 2, 1)?);
        }
        let last = config.hint_channels[config.hint_channels.len() - 1];
        Ok(Self {
            conv_in: Conv2d::new(&scope.at("conv_in"), config.hints, *first, 3)?,
            blocks,
            conv_out: Conv2d::zeros(&scope.at("conv_out"), last, config.unet.channels[0], 3)?,
        })
    }

    fn forward(&self, hints: &Tensor) -> Result<Tensor> {
        let mut h = silu(&self.conv_in.forward(hints)?)?;
        for block in &self.blocks {
            h = silu(&block.forward(&h)?)?;
        }
        self.conv_out.forward(&h)
    }
}

/// A ControlNet. The names of its weights are those of the diffusers layout, with `light.*` for the light code.
#[derive(Debug)]
pub struct ControlNet {
    config: ControlConfig,
    time: TimeEmbedding,
    light: Option<LightInput>,
    hint_network: HintNetwork,
    encoder: Encoder,
    zero_skips: Vec<Conv2d>,
    zero_middle: Conv2d,
}

impl ControlNet {
    /// With weights from `scope`'s source.
    pub fn new(scope: &Scope<'_>, config: &ControlConfig) -> Result<Self> {
        config.unet.validate()?;
        let unet = &config.unet;
        let light = LightInput::new(scope, unet)?;
        let zero_skips = Encoder::skip_channels(unet).into_iter().enumerate();
        let zero_skips = zero_skips.map(|(i, c)| Conv2d::zeros(&scope.at("controlnet_down_blocks").at(i), c, c, 1));
        let middle = unet.channels[unet.channels.len() - 1];
        Ok(Self {
            time: TimeEmbedding::new(&scope.at("time_embedding"), unet.channels[0], unet.embedding())?,
            light,
            hint_network: HintNetwork::new(&scope.at("controlnet_cond_embedding"), config)?,
            encoder: Encoder::new(scope, unet)?,
            zero_skips: zero_skips.collect::<Result<_>>()?,
            zero_middle: Conv2d::zeros(&scope.at("controlnet_mid_block"), middle, middle, 1)?,
            config: config.clone(),
        })
    }

    /// The sizes that it was built with.
    pub fn config(&self) -> &ControlConfig {
        &self.config
    }

    /// What to add to the UNet's feature maps. `hints` is (batch, hints, height, width) at the hint network's resolution.
    pub fn forward(
        &self,
        x: &Tensor,
        timesteps: &[f32],
        hints: &Tensor,
        conditions: &Conditions<'_>,
    ) -> Result<ControlResiduals> {
        check_input(&self.config.unet, x, timesteps, conditions)?;
        let (batch, _, height, width) = x.dims4()?;
        let scale = 1 << (self.config.hint_channels.len() - 1);
        let expected = [batch, self.config.hints, height * scale, width * scale];
        if hints.dims() != expected {
            return Err(DiffusionError::shape("hints", expected, hints.dims()));
        }
        let sines = timestep_embedding(timesteps, self.config.unet.channels[0], x.dtype(), x.device())?;
        let mut embedding = self.time.forward(&sines)?;
        let mut context = conditions.context.cloned();
        if let (Some(input), Some(light)) = (&self.light, conditions.light) {
            (embedding, context) = input.add(light, embedding, context)?;
        }
        let pass = Pass::new(&embedding, context, conditions)?;
        let (skips, middle) = self.encoder.forward(x, Some(&self.hint_network.forward(hints)?), &pass)?;
        let skips = skips.iter().zip(&self.zero_skips).map(|(skip, zero)| zero.forward(skip)).collect::<Result<_>>()?;
        Ok(ControlResiduals { skips, middle: self.zero_middle.forward(&middle)? })
    }
}
