//! The way down and the middle of a UNet, which a ControlNet copies.
use super::condition::Pass;
use super::config::UNetConfig;
use super::residual::ResidualBlock;
use super::transformer::Transformer;
use crate::error::Result;
use crate::nn::{Conv2d, Scope};
use candle_core::Tensor;

/// Residual blocks with a transformer behind each, where the level has them.
#[derive(Debug)]
pub(super) struct Stage {
    pub residual: ResidualBlock,
    pub transformer: Option<Transformer>,
}

impl Stage {
    /// Stage `index` of a block at `scope`.
    pub fn new(
        scope: &Scope<'_>,
        config: &UNetConfig,
        level: usize,
        index: usize,
        c_in: usize,
        attention: bool,
    ) -> Result<Self> {
        let resnet = scope.at("resnets").at(index);
        let transformer = match attention {
            true => Some(Transformer::new(&scope.at("attentions").at(index), config, level)?),
            false => None,
        };
        Ok(Self { residual: ResidualBlock::new(&resnet, config, c_in, config.channels[level])?, transformer })
    }

    pub fn forward(&self, x: &Tensor, pass: &Pass<'_>) -> Result<Tensor> {
        let h = self.residual.forward(x, pass)?;
        match &self.transformer {
            Some(transformer) => transformer.forward(&h, pass),
            None => Ok(h),
        }
    }
}

/// One level on the way down.
#[derive(Debug)]
struct Level {
    stages: Vec<Stage>,
    downsample: Option<Conv2d>,
}

/// From the noisy picture to the middle; keeps every feature map on the way.
#[derive(Debug)]
pub(super) struct Encoder {
    conv_in: Conv2d,
    levels: Vec<Level>,
    first: Stage,
    last: ResidualBlock,
}

impl Encoder {
    pub fn new(scope: &Scope<'_>, config: &UNetConfig) -> Result<Self> {
        let deepest = config.channels.len() - 1;
        let conv_in = Conv2d::new(&scope.at("conv_in"), config.in_channels, config.channels[0], 3)?;
        let mut levels = Vec::new();
        let mut c_in = config.channels[0];
        for (level, channels) in config.channels.iter().enumerate() {
            let scope = scope.at("down_blocks").at(level);
            let mut stages = Vec::new();
            for index in 0..config.blocks {
                stages.push(Stage::new(&scope, config, level, index, c_in, config.attention[level])?);
                c_in = *channels;
            }
            let downsample = match level < deepest {
                true => Some(Conv2d::strided(&scope.at("downsamplers.0.conv"), c_in, c_in, 3, 2, 1)?),
                false => None,
            };
            levels.push(Level { stages, downsample });
        }
        let middle = scope.at("mid_block");
        let attention = config.attention.contains(&true);
        Ok(Self {
            conv_in,
            levels,
            first: Stage::new(&middle, config, deepest, 0, c_in, attention)?,
            last: ResidualBlock::new(&middle.at("resnets.1"), config, c_in, c_in)?,
        })
    }

    /// Channels of the feature maps that [`Encoder::forward`] keeps, in order.
    pub fn skip_channels(config: &UNetConfig) -> Vec<usize> {
        let deepest = config.channels.len() - 1;
        let mut skips = vec![config.channels[0]];
        for (level, channels) in config.channels.iter().enumerate() {
            skips.extend(vec![*channels; config.blocks + usize::from(level < deepest)]);
        }
        skips
    }

    /// The feature maps on the way, and the middle's result. `added` is added to the first feature map.
    pub fn forward(&self, x: &Tensor, added: Option<&Tensor>, pass: &Pass<'_>) -> Result<(Vec<Tensor>, Tensor)> {
        let mut h = self.conv_in.forward(x)?;
        if let Some(added) = added {
            h = (h + added)?;
        }
        let mut skips = vec![h.clone()];
        for level in &self.levels {
            for stage in &level.stages {
                h = stage.forward(&h, pass)?;
                skips.push(h.clone());
            }
            if let Some(downsample) = &level.downsample {
                h = downsample.forward(&h)?;
                skips.push(h.clone());
            }
        }
        let h = self.last.forward(&self.first.forward(&h, pass)?, pass)?;
        Ok((skips, h))
    }
}
