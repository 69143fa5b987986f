//! The objective: every single-view term with its weight, value and gradient, as far as [`crate::Needs`] wants it.
//!
//! Terms are computed on the region of the picture that is not empty. They are means over pixels, so that the mean over
//! the picture is the mean over the region times the region's share of the pixels, plus, for the mask's cross-entropy,
//! what an empty pixel costs there.
use crate::exposure::{expose, expose_pull, fitted_gain};
use crate::forward::{PairGrad, View, ViewGrad};
use crate::needs::StepNeeds;
use crate::photometric::guided_normal;
use crate::random::Random;
use crate::{ActivatedGrad, Attribute, Config, Model, ReconstructError, TrainingPair, error};
use diamond_image::{Image, Transfer};
use diamond_light::{OlatLight, spherical_harmonics::COEFFICIENTS};
use diamond_losses::{Average, PhotometricOptions, Term, believed_photometric};
use diamond_metrics::SsimWindow;
use diamond_shading::pseudo_normals;
use diamond_shading::sh_visibility::{visibilities, visibilities_pull};
use glam::Vec3;

/// One term's name, weight and value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TermValue {
    /// Name, as in [`diamond_losses::TERMS`] (the photometric term is listed as l1, dssim and l2, and with `made_` before them for pictures that nobody
    /// took).
    pub name: &'static str,
    /// Weight λ in the objective.
    pub weight: f32,
    /// Value before weighting.
    pub value: f32,
}

/// The terms of a step.
#[derive(Debug, Clone, Default)]
pub struct Terms {
    /// In order of first appearance.
    pub values: Vec<TermValue>,
}

impl Terms {
    /// Adds `share` of each value.
    pub fn add(&mut self, terms: &[TermValue], share: f32) {
        for term in terms {
            let value = term.value * share;
            match self.values.iter_mut().find(|t| t.name == term.name) {
                Some(t) => t.value += value,
                None => self.values.push(TermValue { value, ..*term }),
            }
        }
    }

    /// The weighted sum.
    pub fn objective(&self) -> f32 {
        self.values.iter().map(|t| t.weight * t.value).sum()
    }
}

/// What the objective says about one pair.
pub struct Outcome {
    /// Gradient, × the pair's share of the batch.
    pub grad: ViewGrad,
    /// Terms, not yet multiplied by the share.
    pub terms: Vec<TermValue>,
    /// PSNR in display sRGB, all pixels, dB.
    pub psnr: f32,
    /// Whether both pictures were encoded once more for it.
    pub psnr_encoded: bool,
    /// Logarithms of the photograph's gain after this visit, if it has one.
    pub log_gain: Option<[f32; 3]>,
}

fn add_scaled(to: &mut Option<Image>, from: &Image, scale: f32) {
    let target = to.get_or_insert_with(|| Image::new(from.width(), from.height(), from.channels()));
    target.data_mut().iter_mut().zip(from.data()).for_each(|(a, b)| *a += b * scale);
}

/// Identical pictures count as this many dB, as in `metrics.json`, so that means stay finite.
const PSNR_CAP: f64 = 150.0;

/// Mean squared error of two linear images in display sRGB, clamped.
fn display_error(rendered: &Image, target: &Image) -> Result<f64, ReconstructError> {
    let mut pair = [rendered, target].map(|image| diamond_losses::encode_image(Transfer::Srgb, image));
    pair.iter_mut().flat_map(|image| image.data_mut()).for_each(|v| *v = v.clamp(0.0, 1.0));
    diamond_metrics::mse(&pair[0], &pair[1]).map_err(error::stage("PSNR"))
}

/// PSNR with peak 1 of a mean squared error, dB.
fn decibel(error: f64) -> f32 {
    if error > 0.0 { (-10.0 * libm::log10(error)).min(PSNR_CAP) as f32 } else { PSNR_CAP as f32 }
}

/// Cross-entropy of a pixel that neither the mask nor a Gaussian covers: not 0, since opacities are kept off 0.
fn empty_pixel_entropy() -> f64 {
    -libm::log(1.0 - diamond_losses::OPACITY_MARGIN)
}

/// Value and gradient of every image term for one pair, with weight `share` in the batch. The photographic terms see the
/// rendering under its gain: what `gain` makes of the gain that fits best here.
pub fn evaluate(
    config: &Config,
    needs: &StepNeeds,
    view: &View<'_>,
    pair: &TrainingPair<'_>,
    share: f32,
    gain: Option<&dyn Fn([Option<f32>; 3]) -> [f32; 3]>,
) -> Result<Outcome, ReconstructError> {
    let loss = &config.loss;
    let (shaded, maps) = (view.shaded, &view.shaded.maps);
    let mut out = ViewGrad::default();
    let mut terms = Vec::with_capacity(10);
    let fail = error::stage("objective");
    let fraction = view.region.fraction(pair.radiance.width(), pair.radiance.height());
    let part = |value: f32| (fraction * f64::from(value)) as f32;
    let target = view.region.crop(pair.radiance).map_err(error::stage("region"))?;
    let mask = match pair.mask {
        Some(mask) => Some(view.region.crop_mask(mask).map_err(error::stage("region"))?),
        None => None,
    };
    let mask = mask.as_ref();

    let options = PhotometricOptions {
        lambda_ssim: loss.ssim,
        lambda_l2: loss.l2,
        space: loss.space.transfer(),
        window: SsimWindow::ZeroPadded,
    };
    let log_gain = gain.map(|step| step(fitted_gain(&shaded.radiance, &target, mask, config.exposure.per_channel)));
    let gain = log_gain.map(|g| Vec3::from(g.map(libm::expf)));
    let exposed = gain.map(|g| expose(&shaded.radiance, g));
    let rendered = exposed.as_ref().unwrap_or(&shaded.radiance);
    let weight = pair.weight;
    let (mut photometric, names, factor) = match pair.believed {
        None => {
            let names = ["l1", "dssim", "l2"];
            (diamond_losses::photometric(rendered, &target, &options, weight).map_err(&fail)?, names, 1.0)
        }
        Some(believed) => {
            let believed = view.region.crop(believed).map_err(error::stage("region"))?;
            let loss = believed_photometric(rendered, &target, &believed, &options).map_err(&fail)?;
            (loss, ["made_l1", "made_dssim", "made_l2"], weight)
        }
    };
    terms.push(TermValue { name: names[0], weight: weight * (1.0 - loss.ssim), value: part(photometric.l1) });
    if needs.window {
        terms.push(TermValue { name: names[1], weight: weight * loss.ssim, value: part(photometric.dssim) });
    }
    if loss.l2 > 0.0 {
        terms.push(TermValue { name: names[2], weight: weight * loss.l2, value: part(photometric.l2) });
    }
    if let Some(gain) = gain {
        expose_pull(gain, &mut photometric.grad);
    }
    // Gradients of means over the region become those of means over the picture with the share of the batch.
    let scale = part(share);
    add_scaled(&mut out.shaded.radiance, &photometric.grad, scale * factor);

    let mut push = |term: Term, weight: f32, value: f32| terms.push(TermValue { name: term.name(), weight, value });
    if let (true, Some(mask)) = (needs.mask, mask) {
        let l = diamond_losses::mask_bce(view.opacity, mask).map_err(&fail)?;
        let value = fraction * f64::from(l.value) + (1.0 - fraction) * empty_pixel_entropy();
        push(Term::Mask, loss.mask, factor * value as f32);
        add_scaled(&mut out.opacity, &l.grad, scale * loss.mask * factor);
    }
    if needs.normal {
        let (pseudo, _) =
            pseudo_normals(view.camera, &maps.depth, view.opacity).map_err(error::stage("pseudo-normals"))?;
        // Where the pseudo-normal is undefined the rendered normal takes its place and the difference is 0.
        let mut target = pseudo;
        for (t, n) in target.data_mut().chunks_exact_mut(3).zip(maps.normal.data().chunks_exact(3)) {
            if t.iter().all(|v| *v == 0.0) {
                t.copy_from_slice(n);
            }
        }
        let l = diamond_losses::normal_consistency(&maps.normal, &target, mask, Average::AllPixels).map_err(&fail)?;
        push(Term::Normal, loss.normal, part(l.value));
        add_scaled(&mut out.shaded.maps.normal, &l.grad, scale * loss.normal);
    }
    let smooth = [
        (
            Term::SmoothBaseColor,
            (needs.smooth_base_color, loss.smooth_base_color),
            &maps.base_color,
            &mut out.shaded.maps.base_color,
        ),
        (
            Term::SmoothMetalness,
            (needs.smooth_metalness, loss.smooth_metalness),
            &maps.metalness,
            &mut out.shaded.maps.metalness,
        ),
        (
            Term::SmoothRoughness,
            (needs.smooth_roughness, loss.smooth_roughness),
            &maps.roughness,
            &mut out.shaded.maps.roughness,
        ),
        (
            Term::SmoothSubsurfaceness,
            (needs.smooth_subsurfaceness, loss.smooth_subsurfaceness),
            &maps.subsurfaceness,
            &mut out.shaded.maps.subsurfaceness,
        ),
    ];
    let edges = match smooth.iter().any(|(_, (needed, _), ..)| *needed) {
        true => Some(diamond_losses::EdgeWeights::new(&target, mask).map_err(&fail)?),
        false => None,
    };
    for (term, (needed, weight), map, grad) in smooth {
        if let (true, Some(edges)) = (needed, &edges) {
            let l = edges.smoothness(map).map_err(&fail)?;
            push(term, weight, part(l.value));
            add_scaled(grad, &l.grad, scale * weight);
        }
    }
    if let Some(guide) = pair.guide.filter(|g| g.weight > 0.0) {
        let crop = |map: &Image| view.region.crop(map).map_err(error::stage("region"));
        let (target, confidence) = (crop(&guide.stereo.normals)?, crop(&guide.stereo.confidence)?);
        let (value, grad) = guided_normal(&maps.normal, &target, &confidence);
        terms.push(TermValue { name: "guided_normal", weight: guide.weight, value: part(value) });
        add_scaled(&mut out.shaded.maps.normal, &grad, scale * guide.weight);
    }
    let mut push = |term: Term, weight: f32, value: f32| terms.push(TermValue { name: term.name(), weight, value });
    if needs.enhancement {
        let l = diamond_losses::enhancement(&maps.base_color, &target, mask, Average::AllPixels).map_err(&fail)?;
        push(Term::Enhancement, loss.enhancement, part(l.value));
        add_scaled(&mut out.shaded.maps.base_color, &l.grad, scale * loss.enhancement);
    }
    if needs.incident {
        let l = diamond_losses::incident_light(maps.incident.data(), maps.visibility.data()).map_err(&fail)?;
        push(Term::Incident, loss.incident, part(l.value));
        let (w, h, _) = maps.incident.shape();
        let grad = Image::from_vec(w, h, 1, l.d_incident).map_err(error::stage("incident term"))?;
        add_scaled(&mut out.shaded.maps.incident, &grad, scale * loss.incident);
    }
    let known = photometric.display_error.filter(|_| !needs.own_psnr);
    let error = match known {
        Some(error) => f64::from(error),
        None => display_error(rendered, &target)?,
    };
    Ok(Outcome { grad: out, terms, psnr: decibel(fraction * error), psnr_encoded: known.is_none(), log_gain })
}

/// Gaussians on which the SH visibility is compared, as often as they are drawn.
pub fn visibility_samples(model: &Model, random: &mut Random) -> Vec<usize> {
    let n = model.len();
    match model.config.visibility.samples {
        samples if samples >= n => (0..n).collect(),
        samples => (0..samples).map(|_| random.below(n)).collect(),
    }
}

/// The SH visibility term on random Gaussians toward one light: adds to `d_sh` and returns the value.
pub fn visibility_term(
    model: &Model,
    random: &mut Random,
    light: &OlatLight,
    traced: &[f32],
    share: f32,
    d_sh: &mut Vec<f32>,
) -> Result<TermValue, ReconstructError> {
    let n = model.len();
    let rows = visibility_samples(model, random);
    let means = model.parameters.values(Attribute::Mean);
    let all = model.parameters.values(Attribute::VisibilitySh);
    let directions: Vec<Vec3> = rows
        .iter()
        .map(|&i| light.incidence(Vec3::from_slice(&means[3 * i..]), diamond_light::Falloff::None).direction)
        .collect();
    let sh: Vec<f32> =
        rows.iter().flat_map(|&i| all[i * COEFFICIENTS..(i + 1) * COEFFICIENTS].iter().copied()).collect();
    let target: Vec<f32> = rows.iter().map(|&i| traced[i]).collect();
    let fitted = visibilities(&sh, &directions).map_err(error::stage("visibility term"))?;
    let l = diamond_losses::visibility(&fitted, &target).map_err(error::stage("visibility term"))?;
    let pulled = visibilities_pull(&sh, &directions, &l.grad).map_err(error::stage("visibility term"))?;
    d_sh.resize(n * COEFFICIENTS, 0.0);
    let scale = share * model.config.loss.visibility;
    for (row, &i) in rows.iter().enumerate() {
        let from = &pulled.coefficients[row * COEFFICIENTS..(row + 1) * COEFFICIENTS];
        for (a, b) in d_sh[i * COEFFICIENTS..(i + 1) * COEFFICIENTS].iter_mut().zip(from) {
            *a += scale * b;
        }
    }
    Ok(TermValue { name: Term::Visibility.name(), weight: model.config.loss.visibility, value: l.value })
}

/// Adds the shrinkage of the transfer vectors to a batch's gradient and terms, where the configuration weighs it.
pub fn regularise(model: &Model, total: &mut ActivatedGrad, terms: &mut Terms) {
    let residual = &model.config.residual;
    let weight = residual.transfer_smoothness;
    if !residual.transfer {
        return;
    }
    let values = model.parameters.values(Attribute::Transfer);
    let (value, grad) = transfer_smoothness(values, residual.transfer_degree as usize, model.len());
    total.transfer.resize(values.len(), 0.0);
    total.transfer.iter_mut().zip(&grad).for_each(|(d, g)| *d += weight * g);
    terms.add(&[TermValue { name: "transfer_smoothness", weight, value }], 1.0);
}

/// `[eq:transfer-smoothness]` Σ l²·t² / N over all coefficients t of band l = 0..=`degree` of N = `gaussians` transfer
/// vectors (three colours each, bands in order), and its gradient: high bands shrink, so that lights that were not
/// photographed are interpolated smoothly.
fn transfer_smoothness(transfer: &[f32], degree: usize, gaussians: usize) -> (f32, Vec<f32>) {
    let bands: Vec<f32> = (0..=degree).flat_map(|l| std::iter::repeat_n((l * l) as f32, 2 * l + 1)).collect();
    let scale = 1.0 / gaussians.max(1) as f32;
    let mut sum = 0.0f64;
    let grad = transfer.iter().enumerate().map(|(i, &t)| {
        let factor = bands[i % bands.len()] * scale;
        sum += f64::from(factor * t * t);
        2.0 * factor * t
    });
    let grad = grad.collect();
    (sum as f32, grad)
}

fn add_vec(to: &mut Vec<f32>, from: &[f32]) {
    if to.is_empty() {
        to.extend_from_slice(from);
    } else {
        to.iter_mut().zip(from).for_each(|(a, b)| *a += b);
    }
}

fn add_vec3(to: &mut Vec<Vec3>, from: &[Vec3]) {
    if to.is_empty() {
        to.extend_from_slice(from);
    } else {
        to.iter_mut().zip(from).for_each(|(a, b)| *a += *b);
    }
}

impl PairGrad {
    /// Adds this pair's gradient to the batch's.
    pub fn add_to(&self, total: &mut ActivatedGrad, network: &mut Vec<Vec<f32>>) -> Result<(), ReconstructError> {
        let from = &self.activated;
        total.gaussians.add_assign(&from.gaussians).map_err(error::stage("accumulate"))?;
        add_vec3(&mut total.normals, &from.normals);
        add_vec3(&mut total.base_color, &from.base_color);
        add_vec(&mut total.roughness, &from.roughness);
        add_vec(&mut total.metalness, &from.metalness);
        add_vec(&mut total.subsurfaceness, &from.subsurfaceness);
        add_vec(&mut total.transfer, &from.transfer);
        add_vec(&mut total.codes, &from.codes);
        network.resize(self.network.len().max(network.len()), Vec::new());
        network.iter_mut().zip(&self.network).for_each(|(a, b)| add_vec(a, b));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::{Dual, Real, gradient};

    /// `[eq:transfer-smoothness]`: value and gradient against dual numbers, degrees 0 to 3.
    #[test]
    fn transfer_smoothness_agrees_with_dual_numbers() {
        for degree in 0..=3usize {
            let (n, k) = (2, (degree + 1) * (degree + 1));
            let x: Vec<f64> = (0..n * 3 * k).map(|i| ((i * 37 + 11) % 23) as f64 / 11.5 - 1.0).collect();
            let oracle = |t: &[Dual]| {
                let mut sum = Dual::of(0.0);
                for vector in t.chunks(k) {
                    for l in 0..=degree {
                        for m in 0..2 * l + 1 {
                            let t = vector[l * l + m];
                            sum += Dual::of((l * l) as f64 / n as f64) * t * t;
                        }
                    }
                }
                sum
            };
            let constants: Vec<Dual> = x.iter().map(|&v| Dual::of(v)).collect();
            let f32s: Vec<f32> = x.iter().map(|&v| v as f32).collect();
            let (value, grad) = transfer_smoothness(&f32s, degree, n);
            let expected = oracle(&constants).v;
            assert!((f64::from(value) - expected).abs() <= 1e-5 * (1.0 + expected), "{value} {expected}");
            for (a, b) in grad.iter().zip(gradient(oracle, &x)) {
                assert!((f64::from(*a) - b).abs() <= 1e-5 * (1.0 + b.abs()), "degree {degree}: {a} {b}");
            }
        }
    }
}
