//! What a configuration and a capture need, decided once: everything else is not computed.
//!
//! [`Needs::decide`] is the only place where it is decided whether a term, a channel or a part of the model is computed;
//! each [`Decision`] carries its reason. What changes during a run (roughness is a constant at first, density statistics
//! end) is decided for each step by [`Needs::at`], from the same decisions. The step and the renderer read [`StepNeeds`]
//! and never look at a weight to find out whether something is wanted.
//!
//! A fact of the capture never decides what would change a result: an image that has a mask is compared with it even if
//! none of the images that were looked at beforehand had one. Facts say what a decision will save.
use crate::channel_layout::ChannelLayout;
use crate::{
    Activated, AugmentationSource, CaptureFacts, Config, DensityStrategy, IncidentVariant, MetalVariant, StepPlan,
    StoredTransfer,
};
use diamond_shading::channel;
use serde::Serialize;
use std::fmt;

/// Whether something is computed, and why.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Decision {
    /// Whether it is computed.
    pub needed: bool,
    /// Why, in words of the configuration.
    pub reason: String,
}

impl Decision {
    fn new(needed: bool, reason: impl Into<String>) -> Self {
        Self { needed, reason: reason.into() }
    }

    /// A term: needed where its weight is above 0.
    fn weight(key: &str, weight: f32) -> Self {
        Self::new(weight > 0.0, format!("{key} = {weight}"))
    }

    /// `self`, or not for `reason` unless `condition` holds.
    fn only_if(self, condition: bool, reason: &str) -> Self {
        if self.needed && !condition { Self::new(false, reason) } else { self }
    }
}

macro_rules! needs {
    ($($(#[$doc:meta])* $field:ident: $kind:ident, $saves:literal;)*) => {
        /// One decision for each thing that can be left out.
        #[derive(Debug, Clone, PartialEq, Eq, Serialize)]
        pub struct Needs {
            $($(#[$doc])* pub $field: Decision,)*
        }

        impl Needs {
            /// Each decision with its name, kind, and what leaving it out saves.
            pub fn rows(&self) -> Vec<NeedRow<'_>> {
                vec![$(NeedRow {
                    name: stringify!($field),
                    kind: Kind::$kind,
                    decision: &self.$field,
                    saves: $saves,
                },)*]
            }

            /// Every decision turned to "compute it": the reference that skipping is tested against.
            pub fn everything() -> Self {
                Self { $($field: Decision::new(true, "everything is computed"),)* }
            }
        }
    };
}

/// What is decided about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// A term of the objective.
    Term,
    /// A rasterised feature channel.
    Channel,
    /// A part of the model.
    Model,
    /// Work whose result is known without it.
    Work,
}

/// A decision with what belongs to it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct NeedRow<'a> {
    /// Name of the field of [`Needs`].
    pub name: &'static str,
    /// What it is about.
    pub kind: Kind,
    /// The decision.
    pub decision: &'a Decision,
    /// What is saved where it is not needed.
    pub saves: &'static str,
}

needs! {
    /// 1 − SSIM.
    dssim: Term, "two passes of an 11 × 11 window over the picture";
    /// Cross-entropy of opacity and mask.
    mask: Term, "one pass over the opacity";
    /// Rendered normals against those of the depth.
    normal: Term, "pseudo-normals of the depth and one pass over the normals";
    /// Smoothness of base colour.
    smooth_base_color: Term, "one pass over three channels; with all four also the edge weights";
    /// Smoothness of metalness.
    smooth_metalness: Term, "one pass over a channel";
    /// Smoothness of roughness.
    smooth_roughness: Term, "one pass over a channel";
    /// Smoothness of subsurfaceness.
    smooth_subsurfaceness: Term, "one pass over a channel";
    /// Base colour against the enhanced photograph.
    enhancement: Term, "one pass over three channels";
    /// Learned incident light against visibility.
    incident: Term, "one pass over two channels";
    /// SH visibility against traced visibility.
    visibility_sh: Term, "harmonics of the sampled Gaussians and their part of Adam";
    /// Shrinkage of transfer vectors.
    transfer_smoothness: Term, "one pass over the transfer vectors";
    /// LPIPS.
    lpips: Term, "a deep network's two passes";
    /// Silhouettes of different views against each other.
    silhouette_consistency: Term, "with depth_consistency a second view's opacity and depth, forward and backward";
    /// Depths of different views against each other.
    depth_consistency: Term, "with silhouette_consistency a second view's opacity and depth, forward and backward";
    /// Rendered normals against those of photometric stereo.
    guided_normal: Term, "photometric stereo of each view at the start, and one pass over the normals";
    /// First normals from photometric stereo.
    guided_start: Model, "photometric stereo of each view at the start";
    /// Depth from photometric stereo where views are compared.
    guided_depth: Model, "photometric stereo of each view at the start, and its alignment at each comparison";
    /// Roughness.
    roughness_channel: Channel, "1 of 14 channels, forward and backward";
    /// Metalness.
    metalness_channel: Channel, "1 of 14 channels, forward and backward";
    /// Subsurfaceness.
    subsurfaceness_channel: Channel, "1 of 14 channels, forward and backward";
    /// Residual.
    residual_channels: Channel, "3 of 14 channels, forward and backward";
    /// Learned incident light.
    incident_channel: Channel, "1 of 14 channels, forward and backward";
    /// Visibility of the light.
    visibility_channel: Channel, "1 of 14 channels, forward and backward";
    /// Visibility multiplied onto the surface part.
    shadows: Model, "a factor, and the visibility channel in renders";
    /// The residual network.
    network: Model, "the network, forward and backward, for every visible Gaussian";
    /// The network's incident-light head.
    incident_head: Model, "a head of the network";
    /// The gradient of the network's inputs.
    input_gradient: Model, "a product with the first layer";
    /// A homogeneous medium inside the object.
    medium: Model, "a surface and a fit, some three times a run, and a look-up for every visible Gaussian";
    /// Pictures that nobody took, to learn from.
    made_pictures: Model, "a surface and a fit where the model has no medium, and a picture for each view and light that is made";
    /// The residual's pull toward nothing.
    residual_pull: Term, "the network, forward and backward, for some Gaussians";
    /// Latent codes.
    codes: Model, "inputs of the network and their part of Adam";
    /// Transfer vectors.
    transfer: Model, "harmonics of every visible Gaussian and their part of Adam";
    /// Ray-traced visibility.
    traced_visibility: Model, "a hierarchy over all Gaussians and a ray from each to the light";
    /// SH visibility where nothing is traced.
    fitted_visibility: Model, "harmonics of every visible Gaussian";
    /// Adam for metalness.
    metalness_learned: Model, "Adam for one value per Gaussian";
    /// Density control and its statistics.
    density: Model, "gradient statistics at every step and the rounds themselves";
    /// The roughness channel and its smoothness while roughness is a constant.
    frozen_roughness: Work, "1 of 14 channels, forward and backward, and a term, until the unfreeze";
    /// Shading and objective where photograph, mask and render are empty.
    empty_pixels: Work, "shading and objective outside the object's rectangle";
    /// The backward pass of the residual for Gaussians that no pixel passes a gradient to.
    hidden_rows: Work, "the network's backward pass for Gaussians that are covered by others";
    /// Tracing again while the Gaussians have hardly moved.
    unmoved_visibility: Work, "rays of lights whose visibility is old but still right";
    /// Encoding both pictures once more for the PSNR that is logged.
    own_psnr: Work, "four powers per pixel";
}

/// Whether pictures that nobody took are made, and what the capture lacks.
fn made_pictures(config: &Config, facts: &CaptureFacts) -> Decision {
    let settings = &config.augmentation;
    let lacks = match facts.missing_pairs {
        0 => "no view lacks a light of the rig".to_owned(),
        n => format!(
            "{n} of {} pairs of a view and a light of the rig were not photographed",
            facts.views * facts.rig_lights
        ),
    };
    let asks = settings.asks_prior(config.subsurface.model) || settings.asks_relighter();
    let why = match settings.source {
        AugmentationSource::Auto if asks => "augmentation.source = \"auto\" and the model has a medium",
        AugmentationSource::Auto => "augmentation.source = \"auto\" and the model has no medium",
        AugmentationSource::None => "augmentation.source = \"none\"",
        AugmentationSource::Prior => "augmentation.source = \"prior\"",
        AugmentationSource::Diffusion => "augmentation.source = \"diffusion\"",
        AugmentationSource::Both => "augmentation.source = \"both\"",
    };
    let lacking = facts.missing_pairs > 0 || settings.beyond_rig || settings.views > 0;
    match settings.off_because() {
        Some(reason) => Decision::new(false, reason),
        None => Decision::new(asks && lacking, format!("{why}; {lacks}")),
    }
}

impl Needs {
    /// Decides for a configuration and what is known of a capture.
    pub fn decide(config: &Config, facts: &CaptureFacts) -> Self {
        let (loss, shading, residual) = (&config.loss, &config.shading, &config.residual);
        let learned = shading.incident == IncidentVariant::Learned;
        let subsurface = residual.network || residual.transfer || config.subsurface.model.has_medium();
        let no_subsurface = "no subsurface part: residual.network = false and residual.transfer = false";
        let metal = shading.metal != MetalVariant::No;
        let no_metal = "shading.metal = \"no\": the surface is a dielectric, metalness is 0";
        let incident_term = Decision::weight("loss.incident", loss.incident)
            .only_if(learned, "incident light is physical, not learned (shading.incident)");
        let visibility_sh = Decision::weight("loss.visibility", loss.visibility)
            .only_if(config.visibility.traced, "nothing to compare with: visibility.traced = false");
        let visibility_channel = match (shading.surface_visibility, incident_term.needed) {
            (true, _) => Decision::new(true, "shading.surface_visibility = true: it multiplies the surface part"),
            (_, true) => Decision::new(true, "the incident term compares with it"),
            _ => Decision::new(false, "shading.surface_visibility = false and no incident term"),
        };
        let incident_head = Decision::new(true, "shading.incident = \"learned\"")
            .only_if(learned, "incident light is physical, not learned (shading.incident)")
            .only_if(residual.network, "there is no network that could learn it (residual.network = false)");
        let read = match (visibility_channel.needed, residual.network, visibility_sh.needed) {
            (true, ..) => "the visibility channel is rasterised",
            (_, true, _) => "the residual network reads it",
            (_, _, true) => "the SH fit is compared with it",
            _ if config.subsurface.model.has_medium() => "what leaves the medium where it enters reads it",
            _ => "",
        };
        let visibility = match read {
            "" => Decision::new(false, "nothing reads the visibility of a light"),
            read => Decision::new(true, read),
        };
        let one_view = "one training view: there is none that it could be compared with";
        let ever_compared = (0..config.steps).any(|s| StepPlan::new(config, s).consistency > 0.0);
        let never_compared =
            "no step of the run is in consistency.from to until after the first round of density control";
        let guide = &config.photometric;
        // 0 where nothing is known of the capture.
        let enough_lights = !(1..3).contains(&facts.most_view_images);
        let few_lights = "photometric stereo needs three photographs of a view, and no view has more than two";
        let compares = (loss.silhouette_consistency > 0.0 || loss.depth_consistency > 0.0) && facts.views != 1;
        let moved = config.visibility.moved;
        let density = match config.density.strategy {
            DensityStrategy::Adaptive => Decision::new(true, "density.strategy = \"adaptive\""),
            DensityStrategy::Mcmc => Decision::new(true, "density.strategy = \"mcmc\""),
            DensityStrategy::None => Decision::new(false, "density.strategy = \"none\""),
        };
        Self {
            dssim: Decision::weight("loss.ssim", loss.ssim),
            mask: match (facts.masks, facts.looked_at) {
                (0, n) if n > 0 && loss.mask > 0.0 => Decision::new(
                    true,
                    format!(
                        "loss.mask = {}; none of {n} images looked at has a mask: computed where one has",
                        loss.mask
                    ),
                ),
                _ => Decision::weight("loss.mask", loss.mask),
            },
            normal: Decision::weight("loss.normal", loss.normal),
            smooth_base_color: Decision::weight("loss.smooth_base_color", loss.smooth_base_color),
            smooth_metalness: Decision::weight("loss.smooth_metalness", loss.smooth_metalness).only_if(metal, no_metal),
            smooth_roughness: Decision::weight("loss.smooth_roughness", loss.smooth_roughness),
            smooth_subsurfaceness: Decision::weight("loss.smooth_subsurfaceness", loss.smooth_subsurfaceness)
                .only_if(subsurface, no_subsurface),
            enhancement: Decision::weight("loss.enhancement", loss.enhancement),
            transfer_smoothness: Decision::weight("residual.transfer_smoothness", residual.transfer_smoothness)
                .only_if(residual.transfer, "residual.transfer = false"),
            lpips: Decision::new(
                false,
                match loss.lpips > 0.0 {
                    true => "this program has no LPIPS weights: loss.lpips has no effect",
                    false => "loss.lpips = 0, and this program has no LPIPS weights",
                },
            ),
            silhouette_consistency: Decision::weight("loss.silhouette_consistency", loss.silhouette_consistency)
                .only_if(facts.views != 1, one_view)
                .only_if(ever_compared, never_compared),
            depth_consistency: Decision::weight("loss.depth_consistency", loss.depth_consistency)
                .only_if(facts.views != 1, one_view)
                .only_if(ever_compared, never_compared),
            guided_normal: Decision::weight("photometric.supervise", guide.supervise)
                .only_if(guide.until > 0.0, "photometric.until = 0")
                .only_if(enough_lights, few_lights),
            guided_start: Decision::new(guide.initial, format!("photometric.initial = {}", guide.initial))
                .only_if(enough_lights, few_lights),
            guided_depth: Decision::new(guide.depth, format!("photometric.depth = {}", guide.depth))
                .only_if(compares, "no depths are compared (loss.silhouette_consistency, loss.depth_consistency)")
                .only_if(enough_lights, few_lights),
            roughness_channel: Decision::new(
                shading.roughness_unfreeze < 1.0,
                match shading.roughness_unfreeze {
                    1.0 => "shading.roughness_unfreeze = 1: roughness is the constant ½".to_owned(),
                    f if f > 0.0 => format!("learned; the constant ½ for the first {:.0} %", 100.0 * f),
                    _ => "learned from the first step".to_owned(),
                },
            ),
            metalness_channel: Decision::new(
                true,
                match shading.metal {
                    MetalVariant::Auto => "shading.metal = \"auto\": photographs do not say that there is no metal",
                    _ => "shading.metal = \"yes\"",
                },
            )
            .only_if(metal, no_metal),
            subsurfaceness_channel: Decision::new(true, "it weighs the residual").only_if(subsurface, no_subsurface),
            residual_channels: Decision::new(true, "there is a subsurface part").only_if(subsurface, no_subsurface),
            incident_channel: incident_head.clone(),
            shadows: Decision::new(
                shading.surface_visibility,
                format!("shading.surface_visibility = {}", shading.surface_visibility),
            ),
            network: Decision::new(residual.network, format!("residual.network = {}", residual.network)),
            input_gradient: match (residual.network, residual.codes > 0, residual.normal_gradient) {
                (false, ..) => Decision::new(false, "there is no network"),
                (_, true, _) => Decision::new(true, "the codes learn by it"),
                (_, _, true) => Decision::new(true, "residual.normal_gradient = true: the normals learn by it"),
                _ => Decision::new(false, "residual.normal_gradient = false and residual.codes = 0"),
            },
            medium: match config.subsurface.model.has_medium() {
                true => Decision::new(true, "subsurface.model names one"),
                false => Decision::new(false, "subsurface.model = \"mlp\": the network alone"),
            },
            made_pictures: made_pictures(config, facts),
            residual_pull: Decision::weight("subsurface.residual_weight", config.subsurface.residual_weight)
                .only_if(
                    config.subsurface.model.has_medium(),
                    "there is no medium that would explain the light instead",
                )
                .only_if(residual.network || residual.transfer, "there is no residual"),
            codes: Decision::new(residual.codes > 0, format!("residual.codes = {}", residual.codes))
                .only_if(residual.network, "only the network reads codes (residual.network = false)"),
            transfer: Decision::new(residual.transfer, format!("residual.transfer = {}", residual.transfer)),
            traced_visibility: visibility.clone().only_if(config.visibility.traced, "visibility.traced = false"),
            fitted_visibility: Decision::new(true, "visibility.traced = false: the SH fit stands in")
                .only_if(visibility.needed, &visibility.reason)
                .only_if(!config.visibility.traced, "traced visibility is used instead"),
            metalness_learned: Decision::new(true, "metalness is learned").only_if(metal, no_metal),
            density,
            empty_pixels: Decision::new(
                false,
                match facts.content {
                    Some(share) if share < 0.999 => format!(
                        "photograph, mask and render are empty there: the objects' rectangles are {:.0} % of the pictures",
                        100.0 * share
                    ),
                    Some(_) => "decided for each image; here the photographs are filled to the border".to_owned(),
                    None => "decided for each image: where photograph, mask and render are empty".to_owned(),
                },
            ),
            frozen_roughness: Decision::new(
                false,
                format!(
                    "roughness is the constant ½ until shading.roughness_unfreeze = {}",
                    shading.roughness_unfreeze
                ),
            ),
            hidden_rows: Decision::new(false, "their gradient is exactly 0"),
            unmoved_visibility: match moved > 0.0 {
                true => Decision::new(
                    false,
                    format!("kept until some Gaussians have moved by visibility.moved = {moved} of their size"),
                ),
                false => Decision::new(true, "visibility.moved = 0: traced again whenever it is old"),
            },
            own_psnr: match config.loss.space {
                StoredTransfer::Gamma22 => Decision::new(true, "loss.space = \"gamma22\" says nothing of display sRGB"),
                _ => Decision::new(false, "the loss knows the squared error in display sRGB"),
            },
            visibility_sh,
            visibility_channel,
            incident: incident_term,
            incident_head,
        }
    }

    /// What one step needs.
    pub fn at(&self, plan: &StepPlan) -> StepNeeds {
        let roughness = self.roughness_channel.needed && (!plan.roughness_frozen || self.frozen_roughness.needed);
        StepNeeds {
            layout: self.layout(roughness),
            normal: self.normal.needed,
            mask: self.mask.needed,
            smooth_base_color: self.smooth_base_color.needed,
            smooth_metalness: self.smooth_metalness.needed,
            smooth_roughness: self.smooth_roughness.needed && roughness,
            smooth_subsurfaceness: self.smooth_subsurfaceness.needed,
            enhancement: self.enhancement.needed,
            incident: self.incident.needed,
            input_gradient: self.input_gradient.needed,
            all_pixels: self.empty_pixels.needed,
            hidden_rows: self.hidden_rows.needed,
            own_psnr: self.own_psnr.needed,
            visibility: self.traced_visibility.needed || self.fitted_visibility.needed,
            window: self.dssim.needed,
            silhouette_consistency: self.silhouette_consistency.needed && plan.consistency > 0.0,
            depth_consistency: self.depth_consistency.needed && plan.consistency > 0.0,
        }
    }

    /// The channels that are rasterised, `roughness` among them or not.
    pub(crate) fn layout(&self, roughness: bool) -> ChannelLayout {
        ChannelLayout::new(|c| match c {
            channel::ROUGHNESS => roughness,
            channel::METALNESS => self.metalness_channel.needed,
            channel::SUBSURFACENESS => self.subsurfaceness_channel.needed,
            channel::INCIDENT => self.incident_channel.needed,
            channel::VISIBILITY => self.visibility_channel.needed,
            c if channel::RESIDUAL.contains(&c) => self.residual_channels.needed,
            _ => true,
        })
    }

    /// What is not computed, for a short note: name and reason.
    pub fn skipped(&self) -> impl Iterator<Item = NeedRow<'_>> {
        self.rows().into_iter().filter(|row| !row.decision.needed)
    }
}

/// What rendering a model needs: the run's decisions, and what the finished model turns out not to have.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RenderNeeds {
    /// Metalness.
    pub metal: Decision,
    /// Residual and subsurfaceness.
    pub subsurface: Decision,
    /// Learned incident light.
    pub incident: Decision,
    /// The visibility of lights, for the network or the surface.
    pub visibility: Decision,
    /// The visibility channel.
    pub visibility_channel: Decision,
    /// Shading where no Gaussian covers anything.
    pub empty_pixels: Decision,
    /// Residual and visibility of Gaussians that no pixel takes anything of.
    pub hidden_rows: Decision,
}

/// Metalness and subsurfaceness are nil where those of all Gaussians are at most this: their part of the radiance is left
/// out, which changes it by at most about this share.
pub const NIL: f32 = 1e-3;

impl Needs {
    /// What rendering the parameters `activated` needs.
    pub fn rendering(&self, activated: &Activated) -> RenderNeeds {
        let largest = |values: &[f32]| values.iter().copied().fold(0.0, f32::max);
        let (metal, subsurface) = (largest(&activated.metalness), largest(&activated.subsurfaceness));
        let nil = |what: &str, value: f32| format!("nil: the largest {what} is {value:.1e}, at most {NIL}");
        let subsurface = self.residual_channels.clone().only_if(subsurface > NIL, &nil("subsurfaceness", subsurface));
        let reads_visibility = self.shadows.needed
            || (self.network.needed || self.medium.needed) && (subsurface.needed || self.incident_head.needed);
        RenderNeeds {
            metal: self.metalness_channel.clone().only_if(metal > NIL, &nil("metalness", metal)),
            incident: self.incident_head.clone(),
            visibility: match reads_visibility {
                true => Decision::new(true, "the surface part or the network reads it"),
                false => Decision::new(false, "neither the surface part nor the network reads it"),
            },
            visibility_channel: self.shadows.clone(),
            empty_pixels: self.empty_pixels.clone(),
            hidden_rows: self.hidden_rows.clone(),
            subsurface,
        }
    }
}

impl RenderNeeds {
    /// The channels that the radiance depends on.
    pub(crate) fn layout(&self) -> ChannelLayout {
        ChannelLayout::new(|c| match c {
            channel::METALNESS => self.metal.needed,
            channel::SUBSURFACENESS => self.subsurface.needed,
            channel::INCIDENT => self.incident.needed,
            channel::VISIBILITY => self.visibility_channel.needed,
            c if channel::RESIDUAL.contains(&c) => self.subsurface.needed,
            _ => true,
        })
    }

    /// Nothing left out: the reference that skipping is tested against.
    pub fn everything() -> Self {
        let all = || Decision::new(true, "everything is computed");
        Self {
            metal: all(),
            subsurface: all(),
            incident: all(),
            visibility: all(),
            visibility_channel: all(),
            empty_pixels: all(),
            hidden_rows: all(),
        }
    }
}

/// What one step computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StepNeeds {
    /// The channels that are rasterised.
    pub layout: ChannelLayout,
    /// SSIM.
    pub window: bool,
    /// The mask term.
    pub mask: bool,
    /// The normal term.
    pub normal: bool,
    /// Smoothness of base colour.
    pub smooth_base_color: bool,
    /// Smoothness of metalness.
    pub smooth_metalness: bool,
    /// Smoothness of roughness.
    pub smooth_roughness: bool,
    /// Smoothness of subsurfaceness.
    pub smooth_subsurfaceness: bool,
    /// The enhancement term.
    pub enhancement: bool,
    /// The incident term.
    pub incident: bool,
    /// The gradient of the network's inputs.
    pub input_gradient: bool,
    /// Shading and objective on all pixels rather than on the object's rectangle.
    pub all_pixels: bool,
    /// The residual's backward pass for Gaussians without a gradient.
    pub hidden_rows: bool,
    /// PSNR from pictures encoded for it.
    pub own_psnr: bool,
    /// The visibility of the light.
    pub visibility: bool,
    /// Silhouettes of different views against each other, at this step.
    pub silhouette_consistency: bool,
    /// Depths of different views against each other, at this step.
    pub depth_consistency: bool,
}

impl fmt::Display for Needs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rows = self.rows();
        let width = rows.iter().map(|r| r.name.len()).max().unwrap_or(0);
        for (title, needed) in [("computed", true), ("not computed", false)] {
            writeln!(f, "{title}:")?;
            for row in rows.iter().filter(|r| r.decision.needed == needed) {
                write!(f, "  {:width$}  {}", row.name, row.decision.reason)?;
                match needed {
                    true => writeln!(f)?,
                    false => writeln!(f, "; saves {}", row.saves)?,
                }
            }
        }
        Ok(())
    }
}
