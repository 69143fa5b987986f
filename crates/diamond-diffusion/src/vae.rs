//! The variational autoencoder of Stable Diffusion: eight times smaller, four channels.
use crate::error::{DiffusionError, Result};
use crate::first_stage::FirstStage;
use crate::nn::{Conv2d, GroupNorm, Linear, Scope, attend, upsample_nearest};
use candle_core::Tensor;

/// Added to the variance in all its group norms.
const EPS: f64 = 1e-6;

/// Bounds of the logarithm of the variance that the encoder may state.
const LOG_VARIANCE: (f64, f64) = (-30.0, 20.0);

/// Sizes of an autoencoder.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VaeConfig {
    /// Channels of each level, finest first; each further level has half the resolution.
    pub channels: Vec<usize>,
    /// Residual blocks of a level on the way down; one more on the way up.
    pub blocks: usize,
    /// Channels of the latents.
    pub latents: usize,
    /// Groups of each group norm.
    pub groups: usize,
    /// What latents are multiplied by.
    pub scale: f64,
}
impl VaeConfig {
    /// That of Stable Diffusion 1 and 2.
    pub fn stable_diffusion() -> Self {
        Self { channels: vec![128, 256, 512, 512], blocks: 2, latents: 4, groups: 32, scale: 0.18215 }
    }
}

/// x + conv₂(SiLU(GN(conv₁(SiLU(GN(x)))))).
#[derive(Debug)]
struct Residual {
    norm1: GroupNorm,
    conv1: Conv2d,
    norm2: GroupNorm,
    conv2: Conv2d,
    shortcut: Option<Conv2d>,
}

impl Residual {
    fn new(scope: &Scope<'_>, groups: usize, c_in: usize, c_out: usize) -> Result<Self> {
        let shortcut = match c_in == c_out {
            true => None,
            false => Some(Conv2d::new(&scope.at("conv_shortcut"), c_in, c_out, 1)?),
        };
        Ok(Self {
            norm1: GroupNorm::new(&scope.at("norm1"), c_in, groups, EPS)?,
            conv1: Conv2d::new(&scope.at("conv1"), c_in, c_out, 3)?,
            norm2: GroupNorm::new(&scope.at("norm2"), c_out, groups, EPS)?,
            conv2: Conv2d::new(&scope.at("conv2"), c_out, c_out, 3)?,
            shortcut,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let h = self.conv1.forward(&self.norm1.forward_silu(x)?)?;
        let h = self.conv2.forward(&self.norm2.forward_silu(&h)?)?;
        let x = self.shortcut.as_ref().map_or(Ok(x.clone()), |shortcut| shortcut.forward(x))?;
        Ok((x + h)?)
    }
}

/// Attention of all pixels with one head.
#[derive(Debug)]
struct PixelAttention {
    norm: GroupNorm,
    to_q: Linear,
    to_k: Linear,
    to_v: Linear,
    to_out: Linear,
}

impl PixelAttention {
    fn new(scope: &Scope<'_>, groups: usize, channels: usize) -> Result<Self> {
        let linear = |name: &str| Linear::new(&scope.at(name), channels, channels);
        Ok(Self {
            norm: GroupNorm::new(&scope.at("group_norm"), channels, groups, EPS)?,
            to_q: linear("to_q")?,
            to_k: linear("to_k")?,
            to_v: linear("to_v")?,
            to_out: linear("to_out.0")?,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let tokens = self.norm.forward(x)?.flatten_from(2)?.transpose(1, 2)?.contiguous()?;
        let (q, k, v) = (self.to_q.forward(&tokens)?, self.to_k.forward(&tokens)?, self.to_v.forward(&tokens)?);
        let out = self.to_out.forward(&attend(&q, &k, &v)?)?.transpose(1, 2)?.contiguous()?;
        Ok((x + out.reshape(x.shape())?)?)
    }
}

/// Residual block, attention, residual block.
#[derive(Debug)]
struct Middle {
    first: Residual,
    attention: PixelAttention,
    last: Residual,
}

impl Middle {
    fn new(scope: &Scope<'_>, groups: usize, channels: usize) -> Result<Self> {
        Ok(Self {
            first: Residual::new(&scope.at("resnets.0"), groups, channels, channels)?,
            attention: PixelAttention::new(&scope.at("attentions.0"), groups, channels)?,
            last: Residual::new(&scope.at("resnets.1"), groups, channels, channels)?,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.last.forward(&self.attention.forward(&self.first.forward(x)?)?)
    }
}

/// Residual blocks, then a change of resolution where there is one.
#[derive(Debug)]
struct Level {
    blocks: Vec<Residual>,
    resample: Option<Conv2d>,
}

/// The autoencoder. The names of its weights are those of the diffusers layout.
#[derive(Debug)]
pub struct KlVae {
    config: VaeConfig,
    encoder_in: Conv2d,
    down: Vec<Level>,
    encoder_middle: Middle,
    encoder_norm: GroupNorm,
    encoder_out: Conv2d,
    quant: Conv2d,
    post_quant: Conv2d,
    decoder_in: Conv2d,
    decoder_middle: Middle,
    up: Vec<Level>,
    decoder_norm: GroupNorm,
    decoder_out: Conv2d,
}

impl KlVae {
    /// With weights from `scope`'s source.
    pub fn new(scope: &Scope<'_>, config: &VaeConfig) -> Result<Self> {
        let (channels, groups, levels) = (&config.channels, config.groups, config.channels.len());
        if levels == 0 || config.blocks == 0 || config.latents == 0 {
            return Err(DiffusionError::setting("channels, blocks, latents", "at least 1 of each", 0));
        }
        let (finest, deepest) = (channels[0], channels[levels - 1]);
        let (encoder, decoder) = (scope.at("encoder"), scope.at("decoder"));
        let mut down = Vec::new();
        let mut c_in = finest;
        for (level, &c_out) in channels.iter().enumerate() {
            let scope = encoder.at("down_blocks").at(level);
            let mut blocks = Vec::new();
            for block in 0..config.blocks {
                blocks.push(Residual::new(&scope.at("resnets").at(block), groups, c_in, c_out)?);
                c_in = c_out;
            }
            let resample = match level + 1 < levels {
                true => Some(Conv2d::strided(&scope.at("downsamplers.0.conv"), c_out, c_out, 3, 2, 0)?),
                false => None,
            };
            down.push(Level { blocks, resample });
        }
        let mut up = Vec::new();
        for (index, &c_out) in channels.iter().rev().enumerate() {
            let scope = decoder.at("up_blocks").at(index);
            let mut blocks = Vec::new();
            for block in 0..=config.blocks {
                blocks.push(Residual::new(&scope.at("resnets").at(block), groups, c_in, c_out)?);
                c_in = c_out;
            }
            let resample = match index + 1 < levels {
                true => Some(Conv2d::new(&scope.at("upsamplers.0.conv"), c_out, c_out, 3)?),
                false => None,
            };
            up.push(Level { blocks, resample });
        }
        let latents = config.latents;
        Ok(Self {
            encoder_in: Conv2d::new(&encoder.at("conv_in"), 3, finest, 3)?,
            down,
            encoder_middle: Middle::new(&encoder.at("mid_block"), groups, deepest)?,
            encoder_norm: GroupNorm::new(&encoder.at("conv_norm_out"), deepest, groups, EPS)?,
            encoder_out: Conv2d::new(&encoder.at("conv_out"), deepest, 2 * latents, 3)?,
            quant: Conv2d::new(&scope.at("quant_conv"), 2 * latents, 2 * latents, 1)?,
            post_quant: Conv2d::new(&scope.at("post_quant_conv"), latents, latents, 1)?,
            decoder_in: Conv2d::new(&decoder.at("conv_in"), latents, deepest, 3)?,
            decoder_middle: Middle::new(&decoder.at("mid_block"), groups, deepest)?,
            up,
            decoder_norm: GroupNorm::new(&decoder.at("conv_norm_out"), finest, groups, EPS)?,
            decoder_out: Conv2d::new(&decoder.at("conv_out"), finest, 3, 3)?,
            config: config.clone(),
        })
    }

    /// Mean and logarithm of the variance of the latents, not scaled.
    fn moments(&self, pictures: &Tensor) -> Result<(Tensor, Tensor)> {
        let factor = self.factor();
        let fits = matches!(pictures.dims(), [_, 3, height, width]
            if height % factor == 0 && width % factor == 0 && *height > 0 && *width > 0);
        if !fits {
            let expected = format!("[batch, 3, height, width] with sides that are multiples of {factor}");
            let found = format!("{:?}", pictures.dims());
            return Err(DiffusionError::Shape { what: "pictures to encode".into(), expected, found });
        }
        let mut h = self.encoder_in.forward(pictures)?;
        for level in &self.down {
            for block in &level.blocks {
                h = block.forward(&h)?;
            }
            if let Some(downsample) = &level.resample {
                // One row and one column of zeros, at the far sides only.
                h = downsample.forward(&h.pad_with_zeros(2, 0, 1)?.pad_with_zeros(3, 0, 1)?)?;
            }
        }
        let h = self.encoder_norm.forward_silu(&self.encoder_middle.forward(&h)?)?;
        let both = self.quant.forward(&self.encoder_out.forward(&h)?)?.chunk(2, 1)?;
        Ok((both[0].contiguous()?, both[1].contiguous()?.clamp(LOG_VARIANCE.0, LOG_VARIANCE.1)?))
    }
}

impl FirstStage for KlVae {
    fn factor(&self) -> usize {
        1 << (self.config.channels.len() - 1)
    }

    fn latent_channels(&self, _: usize) -> usize {
        self.config.latents
    }

    fn scale(&self) -> f64 {
        self.config.scale
    }

    fn encode(&self, pictures: &Tensor) -> Result<Tensor> {
        Ok(self.moments(pictures)?.0)
    }

    fn encode_to_diffuse(&self, pictures: &Tensor, noise: &Tensor) -> Result<Tensor> {
        let (mean, log_variance) = self.moments(pictures)?;
        // tidy: allow(candle's; matrix products differ between machines too)
        let deviation = (log_variance * 0.5)?.exp()?;
        Ok(((mean + (deviation * noise)?)? * self.config.scale)?)
    }

    fn decode(&self, latents: &Tensor) -> Result<Tensor> {
        let h = self.decoder_in.forward(&self.post_quant.forward(&(latents / self.config.scale)?)?)?;
        let mut h = self.decoder_middle.forward(&h)?;
        for level in &self.up {
            for block in &level.blocks {
                h = block.forward(&h)?;
            }
            if let Some(upsample) = &level.resample {
                h = upsample.forward(&upsample_nearest(&h, 2)?)?;
            }
        }
        self.decoder_out.forward(&self.decoder_norm.forward_silu(&h)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gradient_check::{variable, weighed_sum};
    use crate::nn::{Source, VariablesBuilder};
    use candle_core::DType;

    /// The published count, 83 653 863, and names of published files.
    #[test]
    fn the_published_autoencoder_has_its_parameters_and_names() {
        let builder = VariablesBuilder::new(Source::Shapes);
        KlVae::new(&builder.root(), &VaeConfig::stable_diffusion()).unwrap();
        let (variables, _) = builder.finish();
        assert_eq!(variables.parameters(), 83_653_863);
        assert_eq!(variables.shapes().count(), 248);
        let shape = |name: &str| variables.get(name).unwrap_or_else(|| panic!("no {name}")).dims().to_vec();
        assert_eq!(shape("decoder.up_blocks.2.resnets.0.conv_shortcut.weight"), [256, 512, 1, 1]);
        assert_eq!(shape("encoder.mid_block.attentions.0.to_out.0.bias"), [512]);
        assert_eq!(shape("encoder.conv_out.weight"), [8, 512, 3, 3]);
    }

    #[test]
    fn a_small_one_encodes_decodes_and_has_gradients() {
        let config = VaeConfig { channels: vec![4, 8], blocks: 1, latents: 2, groups: 2, scale: 0.5 };
        let builder = VariablesBuilder::new(Source::Seed(4)).dtype(DType::F64);
        let vae = KlVae::new(&builder.root(), &config).unwrap();
        let (variables, _) = builder.finish();
        let pictures = variable("pictures", &[2, 3, 4, 6]);
        let (noise, mode) = (variable("noise", &[2, 2, 2, 3]), vae.encode(&pictures).unwrap());
        assert_eq!(mode.dims(), [2, 2, 2, 3]);
        let zero = noise.zeros_like().unwrap();
        let drawn = vae.encode_to_diffuse(&pictures, &zero).unwrap();
        let worst = (drawn - (mode * 0.5).unwrap()).unwrap().abs().unwrap().max_all().unwrap();
        assert!(worst.to_scalar::<f64>().unwrap() < 1e-15);
        let out = vae.decode(&vae.encode_to_diffuse(&pictures, &noise).unwrap()).unwrap();
        assert_eq!(out.dims(), pictures.dims());
        let gradients = weighed_sum(&out).unwrap().backward().unwrap();
        for (name, var) in variables.vars() {
            let gradient = gradients.get(var).unwrap_or_else(|| panic!("{name} has no gradient"));
            assert!(gradient.abs().unwrap().max_all().unwrap().to_scalar::<f64>().unwrap() > 0.0, "{name}");
        }
        let odd = vae.encode(&variable("odd", &[1, 3, 5, 6])).unwrap_err().to_string();
        assert!(odd.contains("multiples of 2"), "{odd}");
    }
}
