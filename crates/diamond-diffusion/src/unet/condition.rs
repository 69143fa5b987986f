//! What a network is told beside the noisy picture.
use super::config::{LIGHT_CHANNELS, UNetConfig};
use crate::error::{DiffusionError, Result};
use crate::nn::{Linear, Scope, resize_bilinear, silu};
use candle_core::Tensor;
use std::cell::RefCell;
use std::collections::BTreeMap;

/// What a network is told beside the noisy picture; what it was not built for must be `None`.
#[derive(Debug, Clone, Copy, Default)]
pub struct Conditions<'a> {
    /// Context tokens (batch, tokens, channels).
    pub context: Option<&'a Tensor>,
    /// Ray maps (batch, 78, height, width), of any size.
    pub rays: Option<&'a Tensor>,
    /// Light codes (batch, 9).
    pub light: Option<&'a Tensor>,
    /// Views of one object that follow each other in the batch; 0 is 1.
    pub views: usize,
}

/// How a light code enters: added to the timestep's embedding, and as tokens of the context.
#[derive(Debug)]
pub(super) struct LightInput {
    time: Linear,
    tokens: Option<(usize, Linear)>,
}

impl LightInput {
    /// `light.time` without bias, and `light.token` where the network has a context.
    pub fn new(scope: &Scope<'_>, config: &UNetConfig) -> Result<Option<Self>> {
        let Some(count) = config.light else { return Ok(None) };
        let tokens = match config.context {
            Some(channels) if count > 0 => {
                Some((count, Linear::new(&scope.at("light.token"), LIGHT_CHANNELS, count * channels)?))
            }
            _ => None,
        };
        let time = Linear::without_bias(&scope.at("light.time"), LIGHT_CHANNELS, config.embedding())?;
        Ok(Some(Self { time, tokens }))
    }

    /// The embedding of the timestep and the context, both with the light.
    pub fn add(&self, light: &Tensor, embedding: Tensor, context: Option<Tensor>) -> Result<(Tensor, Option<Tensor>)> {
        let embedding = (embedding + self.time.forward(light)?)?;
        let Some((count, layer)) = &self.tokens else { return Ok((embedding, context)) };
        let tokens = layer.forward(light)?;
        let tokens = tokens.reshape((light.dim(0)?, *count, tokens.dim(1)? / count))?;
        let context = match context {
            Some(context) => Tensor::cat(&[&context, &tokens], 1)?,
            None => tokens,
        };
        Ok((embedding, Some(context)))
    }
}

/// What the blocks of one pass share.
pub(super) struct Pass<'a> {
    /// SiLU of the embedding of timestep and light, (batch, embedding).
    pub embedding: Tensor,
    /// Context tokens.
    pub context: Option<Tensor>,
    /// Views of one object.
    pub views: usize,
    rays: Option<&'a Tensor>,
    resized: RefCell<BTreeMap<(usize, usize), Tensor>>,
}

impl<'a> Pass<'a> {
    /// From the embedding before its activation.
    pub fn new(embedding: &Tensor, context: Option<Tensor>, conditions: &Conditions<'a>) -> Result<Self> {
        let (views, batch) = (conditions.views.max(1), embedding.dim(0)?);
        if !batch.is_multiple_of(views) {
            return Err(DiffusionError::setting("views", format!("a divisor of the batch of {batch}"), views));
        }
        let resized = RefCell::default();
        Ok(Self { embedding: silu(embedding)?, context, views, rays: conditions.rays, resized })
    }

    /// The ray map at the size of a feature map.
    pub fn rays(&self, height: usize, width: usize) -> Result<Tensor> {
        if let Some(rays) = self.resized.borrow().get(&(height, width)) {
            return Ok(rays.clone());
        }
        let rays = self.rays.ok_or_else(|| DiffusionError::shape("ray map", "[batch, 78, height, width]", "none"))?;
        let rays = resize_bilinear(rays, height, width, false)?;
        self.resized.borrow_mut().insert((height, width), rays.clone());
        Ok(rays)
    }
}
