//! The terms of the objective on one view: what the kernels are told, and what their sums mean.
use bytemuck::{Pod, Zeroable};
use diamond_image::Transfer;
use diamond_losses::Term;
use diamond_reconstruct::{Loss, StepNeeds, TermValue};

use crate::losses::Photometric;

/// `ImageTerms` of `image_terms.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct ImageTerms {
    pub masked: u32,
    pub pseudo: u32,
    pub mask: f32,
    pub normal: f32,
    pub smooth_base_color: f32,
    pub smooth_metalness: f32,
    pub smooth_roughness: f32,
    pub smooth_subsurfaceness: f32,
    pub enhancement: f32,
    pub incident: f32,
    pub stride: u32,
    pub unused_0: u32,
}

/// A view that is compared.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Compared<'a> {
    pub loss: &'a Loss,
    pub needs: &'a StepNeeds,
    pub size: [u32; 2],
    pub masked: bool,
    /// Of the photometric terms, and of the mask's where parts are believed.
    pub weight: f32,
    /// Whether each pixel has a weight of its own.
    pub believed: bool,
    /// Of the batch.
    pub share: f32,
}

/// Identical pictures count as this many dB, as on the CPU.
const PSNR_CAP: f64 = 150.0;

impl Compared<'_> {
    fn pixels(&self) -> f64 {
        f64::from(self.size[0]) * f64::from(self.size[1])
    }

    /// What the photometric kernels are told.
    pub fn photometric(&self) -> Photometric {
        let n = 3.0 * self.pixels();
        let (lambda, lambda_l2) = (f64::from(self.loss.ssim), f64::from(self.loss.l2));
        let weight = f64::from(self.weight) * f64::from(self.share);
        Photometric {
            width: self.size[0],
            height: self.size[1],
            channels: 3,
            border: 0,
            space: match self.loss.space.transfer() {
                Transfer::Linear => 0,
                Transfer::Srgb => 1,
                Transfer::Gamma22 => 2,
            },
            step_ssim: (-weight * lambda / n) as f32,
            step_l1: (weight * (1.0 - lambda) / n) as f32,
            step_l2: (2.0 * weight * lambda_l2 / n) as f32,
            stride: if self.believed { 4 } else { 3 },
            weighted: self.believed.into(),
            unused_0: 0,
            unused_1: 0,
        }
    }

    /// What the kernel of the other terms is told.
    pub fn terms(&self) -> ImageTerms {
        let (loss, needs) = (self.loss, self.needs);
        let step = |needed: bool, weight: f32, channels: f64| {
            if needed { (f64::from(weight) * f64::from(self.share) / (self.pixels() * channels)) as f32 } else { 0.0 }
        };
        let masked = needs.mask && self.masked;
        ImageTerms {
            masked: masked.into(),
            pseudo: needs.normal.into(),
            mask: step(masked, loss.mask * self.mask_factor(), 1.0),
            normal: step(needs.normal, loss.normal, 3.0),
            smooth_base_color: step(needs.smooth_base_color, loss.smooth_base_color, 3.0),
            smooth_metalness: step(needs.smooth_metalness, loss.smooth_metalness, 1.0),
            smooth_roughness: step(needs.smooth_roughness, loss.smooth_roughness, 1.0),
            smooth_subsurfaceness: step(needs.smooth_subsurfaceness, loss.smooth_subsurfaceness, 1.0),
            enhancement: step(needs.enhancement, loss.enhancement, 3.0),
            incident: step(needs.incident, loss.incident, 1.0),
            stride: self.size[0] * self.size[1],
            unused_0: 0,
        }
    }

    fn mask_factor(&self) -> f32 {
        if self.believed { self.weight } else { 1.0 }
    }

    /// The terms from their sums over pixels (four groups of four), and the PSNR, dB.
    pub fn values(&self, sums: &[[f32; 4]]) -> (Vec<TermValue>, f32) {
        let (loss, needs, weight) = (self.loss, self.needs, self.weight);
        let mean = |sum: f32, channels: f64| (f64::from(sum) / (self.pixels() * channels)) as f32;
        let [a, b, c, photometric] = [sums[0], sums[1], sums[2], sums[3]];
        let names = if self.believed { ["made_l1", "made_dssim", "made_l2"] } else { ["l1", "dssim", "l2"] };
        let mut terms = Vec::with_capacity(10);
        let mut push = |needed: bool, name: &'static str, weight: f32, value: f32| {
            if needed {
                terms.push(TermValue { name, weight, value });
            }
        };
        push(true, names[0], weight * (1.0 - loss.ssim), mean(photometric[1], 3.0));
        push(needs.window, names[1], weight * loss.ssim, mean(photometric[0], 3.0));
        push(loss.l2 > 0.0, names[2], weight * loss.l2, mean(photometric[2], 3.0));
        push(needs.mask && self.masked, Term::Mask.name(), loss.mask, self.mask_factor() * mean(a[0], 1.0));
        push(needs.normal, Term::Normal.name(), loss.normal, mean(a[1], 3.0));
        push(needs.smooth_base_color, Term::SmoothBaseColor.name(), loss.smooth_base_color, mean(a[2], 3.0));
        push(needs.smooth_metalness, Term::SmoothMetalness.name(), loss.smooth_metalness, mean(a[3], 1.0));
        push(needs.smooth_roughness, Term::SmoothRoughness.name(), loss.smooth_roughness, mean(b[0], 1.0));
        let smooth = Term::SmoothSubsurfaceness.name();
        push(needs.smooth_subsurfaceness, smooth, loss.smooth_subsurfaceness, mean(b[1], 1.0));
        push(needs.enhancement, Term::Enhancement.name(), loss.enhancement, mean(b[2], 3.0));
        push(needs.incident, Term::Incident.name(), loss.incident, mean(b[3], 1.0));
        let error = f64::from(c[0]) / (3.0 * self.pixels());
        let psnr = if error > 0.0 { (-10.0 * libm::log10(error)).min(PSNR_CAP) } else { PSNR_CAP };
        (terms, psnr as f32)
    }
}
