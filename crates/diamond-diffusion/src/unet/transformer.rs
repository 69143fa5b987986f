//! The transformer of a UNet: tokens are the pixels of a feature map.
use super::condition::Pass;
use super::config::{UNetConfig, ViewAttention};
use crate::error::Result;
use crate::nn::{Attention, Conv2d, FeedForward, GroupNorm, LayerNorm, Linear, Scope};
use candle_core::Tensor;

/// Added to the variance in the group norm of transformers.
const TRANSFORMER_EPS: f64 = 1e-6;

/// Added to the variance in the layer norms of transformers.
const TOKEN_EPS: f64 = 1e-5;

/// The way into and out of a transformer.
#[derive(Debug)]
enum Projection {
    Linear(Linear),
    Convolution(Conv2d),
}

impl Projection {
    fn new(scope: &Scope<'_>, linear: bool, channels: usize) -> Result<Self> {
        Ok(match linear {
            true => Self::Linear(Linear::new(scope, channels, channels)?),
            false => Self::Convolution(Conv2d::new(scope, channels, channels, 1)?),
        })
    }
}

/// (batch, channels, h, w) to (batch, h·w, channels).
fn tokens(x: &Tensor) -> Result<Tensor> {
    Ok(x.flatten_from(2)?.transpose(1, 2)?.contiguous()?)
}

/// The inverse of [`tokens`].
fn pixels(x: &Tensor, height: usize, width: usize) -> Result<Tensor> {
    let (batch, _, channels) = x.dims3()?;
    Ok(x.transpose(1, 2)?.contiguous()?.reshape((batch, channels, height, width))?)
}

/// Self-attention, attention to the context, attention between views, feed-forward; each is added to its input.
#[derive(Debug)]
pub(super) struct Transformer {
    norm: GroupNorm,
    proj_in: Projection,
    norm1: LayerNorm,
    own: Attention,
    context: Option<(LayerNorm, Attention)>,
    views: Option<(LayerNorm, Attention)>,
    all_places: bool,
    norm3: LayerNorm,
    feed_forward: FeedForward,
    proj_out: Projection,
}

impl Transformer {
    /// Of level `level`.
    pub fn new(scope: &Scope<'_>, config: &UNetConfig, level: usize) -> Result<Self> {
        let (channels, heads) = (config.channels[level], config.heads[level]);
        let block = scope.at("transformer_blocks.0");
        let norm = |name: &str| LayerNorm::new(&block.at(name), channels, TOKEN_EPS);
        let context = match config.context {
            Some(context) => Some((norm("norm2")?, Attention::new(&block.at("attn2"), channels, context, heads)?)),
            None => None,
        };
        let views = match config.views {
            ViewAttention::None => None,
            // Zero only the output: with zeros everywhere nothing would have a gradient.
            _ => Some((norm("norm_views")?, Attention::silent(&block.at("attn_views"), channels, channels, heads)?)),
        };
        Ok(Self {
            norm: GroupNorm::new(&scope.at("norm"), channels, config.groups, TRANSFORMER_EPS)?,
            proj_in: Projection::new(&scope.at("proj_in"), config.linear_projection, channels)?,
            norm1: norm("norm1")?,
            own: Attention::new(&block.at("attn1"), channels, channels, heads)?,
            context,
            views,
            all_places: config.views == ViewAttention::AllAtLowest && level + 1 == config.channels.len(),
            norm3: norm("norm3")?,
            feed_forward: FeedForward::new(&block.at("ff"), channels)?,
            proj_out: Projection::new(&scope.at("proj_out"), config.linear_projection, channels)?,
        })
    }

    fn between_views(&self, h: &Tensor, attention: &Attention, views: usize) -> Result<Tensor> {
        let (batch, places, channels) = h.dims3()?;
        let scenes = batch / views;
        if self.all_places {
            let all = attention.forward(&h.reshape((scenes, views * places, channels))?, None)?;
            return Ok(all.reshape((batch, places, channels))?);
        }
        let by_place = h.reshape((scenes, views, places, channels))?.transpose(1, 2)?.contiguous()?;
        let seen = attention.forward(&by_place.reshape((scenes * places, views, channels))?, None)?;
        let seen = seen.reshape((scenes, places, views, channels))?.transpose(1, 2)?.contiguous()?;
        Ok(seen.reshape((batch, places, channels))?)
    }

    pub fn forward(&self, x: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        let (_, _, height, width) = x.dims4()?;
        let h = self.norm.forward(x)?;
        let mut h = match &self.proj_in {
            Projection::Linear(linear) => linear.forward(&tokens(&h)?)?,
            Projection::Convolution(convolution) => tokens(&convolution.forward(&h)?)?,
        };
        h = (&h + self.own.forward(&self.norm1.forward(&h)?, None)?)?;
        if let Some((norm, attention)) = &self.context {
            let context = pass
                .context
                .as_ref()
                .ok_or_else(|| crate::DiffusionError::shape("context", "[batch, tokens, channels]", "none"))?;
            h = (&h + attention.forward(&norm.forward(&h)?, Some(context))?)?;
        }
        if let Some((norm, attention)) = &self.views {
            h = (&h + self.between_views(&norm.forward(&h)?, attention, pass.views)?)?;
        }
        h = (&h + self.feed_forward.forward(&self.norm3.forward(&h)?)?)?;
        let out = match &self.proj_out {
            Projection::Linear(linear) => pixels(&linear.forward(&h)?, height, width)?,
            Projection::Convolution(convolution) => convolution.forward(&pixels(&h, height, width)?)?,
        };
        Ok((x + out)?)
    }
}
