//! Sizes of a UNet, with those of the published models.
use crate::error::{DiffusionError, Result};

/// Numbers of a harmonically embedded Plücker ray: 6 · 6 sines, 6 · 6 cosines, and 6 as they are.
pub const RAY_CHANNELS: usize = 78;

/// Numbers of a light code: real spherical harmonics of bands 0 to 2.
pub const LIGHT_CHANNELS: usize = 9;

/// Which tokens of other views a token sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ViewAttention {
    /// None: each view by itself.
    None,
    /// The tokens at its own place in all views.
    SamePlace,
    /// As `SamePlace`, and all tokens of all views at the lowest resolution.
    AllAtLowest,
}

/// A UNet: which channels at which resolution, and what it is told beside the noisy picture.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UNetConfig {
    /// Channels in: those of the noisy picture first, then what is stacked behind it.
    pub in_channels: usize,
    /// Channels out.
    pub out_channels: usize,
    /// Channels of each level, finest first; each further level has half the resolution.
    pub channels: Vec<usize>,
    /// Residual blocks of a level on the way down; one more on the way up.
    pub blocks: usize,
    /// Whether a level has transformers behind its residual blocks.
    pub attention: Vec<bool>,
    /// Heads of the attention of each level.
    pub heads: Vec<usize>,
    /// Channels of the context tokens that transformers look at; without, they look at the picture alone.
    pub context: Option<usize>,
    /// Whether transformers are entered and left through linear layers instead of 1 × 1 convolutions.
    pub linear_projection: bool,
    /// Groups of each group norm.
    pub groups: usize,
    /// Whether residual blocks are modulated by a ray map of [`RAY_CHANNELS`].
    pub rays: bool,
    /// How views of one object see each other.
    pub views: ViewAttention,
    /// Whether there is a light code of [`LIGHT_CHANNELS`]: it is added to the timestep's embedding, and becomes this many tokens
    /// behind those of the context.
    pub light: Option<usize>,
}

impl UNetConfig {
    /// Stable Diffusion 1.5: 4 channels of latents, context 768.
    pub fn stable_diffusion_1() -> Self {
        Self {
            in_channels: 4,
            out_channels: 4,
            channels: vec![320, 640, 1280, 1280],
            blocks: 2,
            attention: vec![true, true, true, false],
            heads: vec![8; 4],
            context: Some(768),
            linear_projection: false,
            groups: 32,
            rays: false,
            views: ViewAttention::None,
            light: None,
        }
    }

    /// Free3D: [`UNetConfig::stable_diffusion_1`] with the source view's latent behind the noisy one, ray conditioning, and
    /// attention between views.
    pub fn free3d() -> Self {
        let views = ViewAttention::SamePlace;
        Self { in_channels: 8, rays: true, views, ..Self::stable_diffusion_1() }
    }

    /// Stable Diffusion 2.1: context 1024, heads of 64 channels, linear projections.
    pub fn stable_diffusion_2() -> Self {
        let heads = vec![5, 10, 20, 20];
        Self { heads, context: Some(1024), linear_projection: true, ..Self::stable_diffusion_1() }
    }

    /// The relighter's denoiser: [`UNetConfig::stable_diffusion_2`] with a light code.
    pub fn relighter() -> Self {
        Self { light: Some(1), ..Self::stable_diffusion_2() }
    }

    /// Marigold: [`UNetConfig::stable_diffusion_2`] with the picture's latent before the noisy one of depth or normals.
    pub fn marigold() -> Self {
        Self { in_channels: 8, ..Self::stable_diffusion_2() }
    }

    /// A relighter that trains on a CPU: 32 × 32 blocks of 2 × 2 pixels from 64 × 64, with a light code.
    pub fn tiny_relighter() -> Self {
        Self {
            in_channels: 12,
            out_channels: 12,
            channels: vec![48, 96, 128],
            blocks: 1,
            attention: vec![false, true, true],
            heads: vec![2, 4, 4],
            context: Some(64),
            linear_projection: true,
            groups: 16,
            rays: false,
            views: ViewAttention::None,
            light: Some(4),
        }
    }

    /// Novel views on a CPU: as [`UNetConfig::tiny_relighter`], with the source view behind the noisy one, rays and views instead of light.
    pub fn tiny_views() -> Self {
        Self { in_channels: 24, rays: true, views: ViewAttention::AllAtLowest, light: None, ..Self::tiny_relighter() }
    }

    /// Numbers of the timestep's embedding.
    pub fn embedding(&self) -> usize {
        4 * self.channels.first().copied().unwrap_or(0)
    }

    /// Sides of pictures must be multiples of this.
    pub fn multiple(&self) -> usize {
        1 << self.channels.len().saturating_sub(1)
    }

    /// Whether the numbers fit together.
    pub fn validate(&self) -> Result<()> {
        let levels = self.channels.len();
        if levels == 0 || levels > 8 {
            return Err(DiffusionError::setting("channels", "1 to 8 levels", levels));
        }
        if self.attention.len() != levels || self.heads.len() != levels {
            let found = format!("{} and {}", self.attention.len(), self.heads.len());
            return Err(DiffusionError::setting(
                "attention and heads",
                format!("{levels} entries, one a level"),
                found,
            ));
        }
        if self.blocks == 0 || self.in_channels == 0 || self.out_channels == 0 {
            return Err(DiffusionError::setting("blocks, in_channels, out_channels", "at least 1", 0));
        }
        for (i, (channels, heads)) in self.channels.iter().zip(&self.heads).enumerate() {
            if *channels == 0 || self.groups == 0 || channels % self.groups != 0 {
                let expected = format!("multiples of {} groups", self.groups);
                return Err(DiffusionError::setting("channels", expected, format!("{channels} at level {i}")));
            }
            if *heads == 0 || channels % heads != 0 {
                let expected = format!("a divisor of {channels} channels");
                return Err(DiffusionError::setting("heads", expected, format!("{heads} at level {i}")));
            }
        }
        Ok(())
    }
}
