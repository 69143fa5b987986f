//! The models that files may hold.
use super::comparison::Renamed;
use super::ldm;
use crate::error::Result;
use crate::nn::{Source, Variables, VariablesBuilder};
use crate::unet::{ControlConfig, ControlNet, UNet, UNetConfig};
use crate::vae::{KlVae, VaeConfig};

/// A model by what it is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ModelKind {
    /// The UNet of Stable Diffusion 1.
    StableDiffusion1,
    /// Novel views: that UNet with a source latent, rays, and attention between views.
    Free3d,
    /// The UNet of Stable Diffusion 2.
    StableDiffusion2,
    /// Relighting: that UNet with a light code.
    Relighter,
    /// The relighter's ControlNet.
    RelighterControl,
    /// A plain ControlNet of Stable Diffusion 1, three hints.
    Control1,
    /// Normals or depth: the UNet of Stable Diffusion 2 with a source latent.
    Marigold,
    /// The autoencoder of Stable Diffusion.
    Vae,
    /// The small relighter.
    TinyRelighter,
    /// The small network for novel views.
    TinyViews,
}

impl ModelKind {
    /// All of them with their names on the command line.
    pub const ALL: [(&'static str, Self); 10] = [
        ("sd1-unet", Self::StableDiffusion1),
        ("free3d-unet", Self::Free3d),
        ("sd2-unet", Self::StableDiffusion2),
        ("relighter-unet", Self::Relighter),
        ("relighter-control", Self::RelighterControl),
        ("sd1-control", Self::Control1),
        ("marigold-unet", Self::Marigold),
        ("sd-vae", Self::Vae),
        ("tiny-relighter", Self::TinyRelighter),
        ("tiny-views", Self::TinyViews),
    ];

    fn unet(self) -> Option<UNetConfig> {
        Some(match self {
            Self::StableDiffusion1 => UNetConfig::stable_diffusion_1(),
            Self::Free3d => UNetConfig::free3d(),
            Self::StableDiffusion2 => UNetConfig::stable_diffusion_2(),
            Self::Relighter => UNetConfig::relighter(),
            Self::Marigold => UNetConfig::marigold(),
            Self::TinyRelighter => UNetConfig::tiny_relighter(),
            Self::TinyViews => UNetConfig::tiny_views(),
            Self::RelighterControl | Self::Control1 | Self::Vae => return None,
        })
    }

    fn control(self) -> Option<ControlConfig> {
        let relighter = ControlConfig::relighter();
        match self {
            Self::RelighterControl => Some(relighter),
            Self::Control1 => Some(ControlConfig { unet: UNetConfig::stable_diffusion_1(), hints: 3, ..relighter }),
            _ => None,
        }
    }

    /// Names and shapes of its weights, without memory for them.
    pub fn shapes(self) -> Result<Variables> {
        let builder = VariablesBuilder::new(Source::Shapes);
        if let Some(config) = self.unet() {
            UNet::new(&builder.root(), &config)?;
        } else if let Some(config) = self.control() {
            ControlNet::new(&builder.root(), &config)?;
        } else {
            KlVae::new(&builder.root(), &VaeConfig::stable_diffusion())?;
        }
        Ok(builder.finish().0)
    }

    /// What a published name is in this model.
    pub fn rename(self, name: &str) -> Renamed {
        match (self.unet(), self.control()) {
            (Some(config), _) => ldm::unet(name, &config, "model.diffusion_model."),
            (None, Some(config)) => ldm::control(name, &config),
            (None, None) => ldm::autoencoder(name),
        }
    }
}
