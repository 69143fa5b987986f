//! The residual block: two convolutions, told of timestep, light and rays.
use super::condition::Pass;
use super::config::{RAY_CHANNELS, UNetConfig};
use crate::error::Result;
use crate::nn::{Conv2d, GroupNorm, Linear, Scope};
use candle_core::Tensor;

/// Added to the variance in the group norms of residual blocks.
pub(crate) const RESIDUAL_EPS: f64 = 1e-5;

/// h = conv₁(SiLU(GN(x))·(1 + s) + t) + embedding, x + conv₂(SiLU(GN(h))), with (s, t) from the ray map where there is one.
#[derive(Debug)]
pub(super) struct ResidualBlock {
    norm1: GroupNorm,
    ray: Option<Conv2d>,
    conv1: Conv2d,
    embedding: Linear,
    norm2: GroupNorm,
    conv2: Conv2d,
    shortcut: Option<Conv2d>,
}

impl ResidualBlock {
    pub fn new(scope: &Scope<'_>, config: &UNetConfig, c_in: usize, c_out: usize) -> Result<Self> {
        // The convolution commutes with the resizing of the map, so it is applied to the resized map.
        let ray = match config.rays {
            true => Some(Conv2d::zeros(&scope.at("ray"), RAY_CHANNELS, 2 * c_in, 1)?),
            false => None,
        };
        let shortcut = match c_in == c_out {
            true => None,
            false => Some(Conv2d::new(&scope.at("conv_shortcut"), c_in, c_out, 1)?),
        };
        Ok(Self {
            norm1: GroupNorm::new(&scope.at("norm1"), c_in, config.groups, RESIDUAL_EPS)?,
            ray,
            conv1: Conv2d::new(&scope.at("conv1"), c_in, c_out, 3)?,
            embedding: Linear::new(&scope.at("time_emb_proj"), config.embedding(), c_out)?,
            norm2: GroupNorm::new(&scope.at("norm2"), c_out, config.groups, RESIDUAL_EPS)?,
            conv2: Conv2d::new(&scope.at("conv2"), c_out, c_out, 3)?,
            shortcut,
        })
    }

    pub fn forward(&self, x: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        let mut h = self.norm1.forward_silu(x)?;
        if let Some(ray) = &self.ray {
            let (_, _, height, width) = h.dims4()?;
            let both = ray.forward(&pass.rays(height, width)?)?.chunk(2, 1)?;
            h = ((&h * (both[0].contiguous()? + 1.0)?)? + both[1].contiguous()?)?;
        }
        let embedding = self.embedding.forward(&pass.embedding)?;
        let (batch, channels) = embedding.dims2()?;
        let h = self.conv1.forward(&h)?.broadcast_add(&embedding.reshape((batch, channels, 1, 1))?)?;
        let h = self.conv2.forward(&self.norm2.forward_silu(&h)?)?;
        let x = match &self.shortcut {
            Some(shortcut) => shortcut.forward(x)?,
            None => x.clone(),
        };
        Ok((x + h)?)
    }
}
