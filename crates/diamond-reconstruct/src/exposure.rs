//! Exposure of the photographs: what multiplies the rendered radiance before it is compared.
//!
//! How bright a light is and how long a shutter was open are unknown in real captures. A gain per photograph, per view, or one for
//! all is found beside the scene, as a logarithm, so that it stays positive. At each visit of a photograph the gain under
//! which the rendering fits it best has a closed form; the gain goes there, and the model is compared under it. This
//! happens in a window of the run: earlier a rendering says too little, and in the end gains would follow what the model gets
//! wrong, so that they stay.
//!
//! # What is not determined
//!
//! A scene that is twice as bright under gains half as large gives the same photographs: the logarithms' mean is kept at
//! 0, and renderings have gain 1, the geometric mean of the exposures. Subsurface light is learned per Gaussian and direction
//! of light, so the same holds for each light by itself: with a gain per image the mean is kept at 0 over the images of each
//! light, that is to say that a lamp's brightness is what the capture says. (Images whose light no other one shows are a
//! group together.) A single global gain has no gauge; it is part of every rendering.
use crate::{Config, ExposureMode, Model, ReconstructError, error};
use diamond_dataset::Capture;
use diamond_image::{Image, Mask};
use glam::Vec3;
use serde::{Deserialize, Serialize};

/// Learned gains.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Exposure {
    /// What each gain belongs to: view or image names; `all` for a global one; none where exposure is fixed.
    pub names: Vec<String>,
    /// Natural logarithms of the gains, three per name (equal unless gains are per channel).
    pub log_gains: Vec<f32>,
    /// Which gains have a mean logarithm of 0 together, a number per gain; all of them where empty.
    pub groups: Vec<u32>,
}

/// Logarithms of gains beyond ± this are taken for a mistake of the optimiser: e⁵ is more than seven stops.
const MAX_LOG_GAIN: f32 = 5.0;

/// What a run's folder says about exposure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExposureFile {
    /// One per gain.
    pub gain: Vec<NamedGain>,
}

/// One gain.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NamedGain {
    /// View, image, or `all`.
    pub name: String,
    /// Factors on linear red, green and blue.
    pub gain: [f32; 3],
}

impl Exposure {
    /// Gains of 1 for what the configuration asks for.
    pub fn new(config: &Config, capture: &Capture) -> Self {
        let views = capture.train.iter();
        let mut out = Self::of_names(match config.exposure.mode {
            ExposureMode::Fixed => Vec::new(),
            ExposureMode::Global => vec!["all".into()],
            ExposureMode::PerView => views.map(|v| v.name.clone()).collect(),
            ExposureMode::PerImage => views.flat_map(|v| &v.shots).map(|s| s.name.clone()).collect(),
        });
        if config.exposure.mode == ExposureMode::PerImage {
            out.groups = groups_by_light(capture);
        }
        out
    }

    fn of_names(names: Vec<String>) -> Self {
        let n = names.len();
        Self { names, log_gains: vec![0.0; 3 * n], groups: Vec::new() }
    }

    /// Which gain an image has.
    pub fn index(&self, mode: ExposureMode, view: usize, image: usize) -> Option<usize> {
        match mode {
            ExposureMode::Fixed => None,
            ExposureMode::Global => Some(0),
            ExposureMode::PerView => Some(view),
            ExposureMode::PerImage => Some(image),
        }
        .filter(|&i| i < self.names.len())
    }

    /// Gain `i`.
    pub fn gain(&self, i: usize) -> Vec3 {
        Vec3::from_slice(&self.log_gains[3 * i..]).map(libm::expf)
    }

    /// Gain of renderings: the global one, else 1.
    pub fn of_renderings(&self, mode: ExposureMode) -> Vec3 {
        if mode == ExposureMode::Global && !self.names.is_empty() { self.gain(0) } else { Vec3::ONE }
    }

    /// The logarithms of gain `i` after a visit at which `fitted` were the best gains (see [`fitted_gain`]).
    /// `[eq:exposure-step]` g ← g + rate·(ln fitted / (1 + λ) − g).
    ///
    /// The photograph is compared with the rendering under this gain. At a rate of 1 no gradient of the model points
    /// along the gain, so that the model has no reason to imitate it.
    pub fn toward(&self, config: &Config, i: usize, fitted: [Option<f32>; 3], factor: f32) -> [f32; 3] {
        let exposure = &config.exposure;
        let rate = (exposure.rate * factor).min(1.0);
        std::array::from_fn(|c| {
            let g = self.log_gains[3 * i + c];
            let goal = fitted[c].map_or(g, |f| libm::logf(f.max(f32::MIN_POSITIVE)) / (1.0 + exposure.prior));
            (g + rate * (goal - g)).clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN)
        })
    }

    /// Sets the logarithms of gain `i`, and takes the mean of those of its group back to 0.
    pub fn set(&mut self, mode: ExposureMode, i: usize, log_gain: [f32; 3]) {
        self.log_gains[3 * i..3 * i + 3].copy_from_slice(&log_gain);
        if mode != ExposureMode::Global {
            self.fix_gauge(self.groups.get(i).copied().unwrap_or(0));
        }
    }

    /// Takes the mean of a group's logarithms, channels together, from each: colour casts remain.
    fn fix_gauge(&mut self, group: u32) {
        let groups = &self.groups;
        let member = |i: &usize| groups.get(i / 3).copied().unwrap_or(0) == group;
        let (mut sum, mut count) = (0.0, 0);
        for i in (0..self.log_gains.len()).filter(member) {
            sum += f64::from(self.log_gains[i]);
            count += 1;
        }
        let mean = (sum / count.max(1) as f64) as f32;
        for i in (0..self.log_gains.len()).filter(member) {
            self.log_gains[i] -= mean;
        }
    }

    /// For the run's folder.
    pub fn to_file(&self) -> ExposureFile {
        let gain = self.names.iter().enumerate();
        ExposureFile { gain: gain.map(|(i, n)| NamedGain { name: n.clone(), gain: self.gain(i).to_array() }).collect() }
    }

    /// From the run's folder.
    pub fn from_file(file: &ExposureFile) -> Self {
        let mut out = Self::of_names(file.gain.iter().map(|g| g.name.clone()).collect());
        out.log_gains = file.gain.iter().flat_map(|g| g.gain.map(|v| libm::logf(v.max(f32::MIN_POSITIVE)))).collect();
        out
    }
}

/// `[eq:exposure-gain]` The radiance under a gain, channel by channel: e^g · R.
pub fn expose(radiance: &Image, gain: Vec3) -> Image {
    let mut out = radiance.clone();
    for pixel in out.data_mut().chunks_exact_mut(3) {
        pixel.iter_mut().zip(gain.to_array()).for_each(|(v, g)| *v *= g);
    }
    out
}

/// Pullback of [`expose`] with respect to the radiance: turns `d` into it.
pub fn expose_pull(gain: Vec3, d: &mut Image) {
    for d in d.data_mut().chunks_exact_mut(3) {
        d.iter_mut().zip(gain.to_array()).for_each(|(d, g)| *d *= g);
    }
}

/// A gain is fitted to at most about this many pixels: the median of 4096 values that spread by a tenth is known to 0.2 %.
const FIT_PIXELS: usize = 4096;

/// `[eq:exposure-fit]` The gain under which `radiance` x is closest to `photograph` y: the median of the ratios y/x, each
/// with weight √x·mask, per channel or of the sums of the channels. To first order it is the minimum of the absolute
/// difference of encoded values, and what a few pixels show that the model does not (a highlight, an edge) does not move
/// it. `None` where nothing is in sight.
pub fn fitted_gain(radiance: &Image, photograph: &Image, mask: Option<&Mask>, per_channel: bool) -> [Option<f32>; 3] {
    let stride = radiance.pixels().div_ceil(FIT_PIXELS).max(1);
    let median = |value: &dyn Fn(&[f32]) -> f32| {
        let pixels = radiance.data().chunks_exact(3).zip(photograph.data().chunks_exact(3)).enumerate();
        let ratio = |(i, (x, y)): (usize, (&[f32], &[f32]))| {
            let (x, y) = (value(x).max(0.0), value(y).max(0.0));
            (y / x, x.sqrt() * mask.map_or(1.0, |m| m.data()[i]))
        };
        let seen = |r: &(f32, f32)| r.0.is_finite() && r.1 > 0.0;
        let mut ratios: Vec<(f32, f32)> = pixels.step_by(stride).map(ratio).filter(seen).collect();
        ratios.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let half = 0.5 * ratios.iter().map(|r| f64::from(r.1)).sum::<f64>();
        let mut sum = 0.0;
        let middle = ratios.iter().find(|r| {
            sum += f64::from(r.1);
            sum >= half
        });
        middle.map(|r| r.0).filter(|g| *g > 0.0)
    };
    match per_channel {
        true => [0, 1, 2].map(|c| median(&move |p: &[f32]| p[c])),
        false => [median(&|p: &[f32]| p[0] + p[1] + p[2]); 3],
    }
}

/// A number per image: that of its light, or 0 where no other image shows the same light.
fn groups_by_light(capture: &Capture) -> Vec<u32> {
    let lights: Vec<_> = capture.train.iter().flat_map(|v| &v.shots).map(|s| s.light).collect();
    let first: Vec<usize> = lights.iter().map(|l| lights.iter().position(|m| m == l).unwrap_or(0)).collect();
    let alone = |f: usize| first.iter().filter(|g| **g == f).count() < 2;
    first.iter().map(|&f| if alone(f) { 0 } else { f as u32 + 1 }).collect()
}

/// At most this many images are rendered to find the first exposure.
const FIRST_IMAGES: usize = 8;
/// A residual that does not scale with the light makes the mean depend on the scale affinely: a few rounds settle it.
const ROUNDS: usize = 3;
/// The light unit changes by at most this factor in one round.
const MAX_RATIO: f32 = 1e3;

/// Sets the light unit so that the first renderings are as bright, in the mean, as the photographs. `[eq:first-exposure]`
/// light_scale ← light_scale · mean(photographs) / mean(renderings).
pub fn match_mean(model: &mut Model, capture: &Capture) -> Result<(), ReconstructError> {
    let shots: Vec<_> = capture.train.iter().flat_map(|v| v.shots.iter().map(move |s| (v, s))).collect();
    let stride = shots.len().div_ceil(FIRST_IMAGES).max(1);
    let mean = |image: &Image| image.data().iter().map(|v| f64::from(*v)).sum::<f64>() / image.data().len() as f64;
    for _ in 0..ROUNDS {
        let (mut target, mut rendered) = (0.0, 0.0);
        for (view, shot) in shots.iter().step_by(stride) {
            target += mean(&capture.observation(shot)?.radiance);
            let renderings = model.render(&view.camera, &[shot.light])?;
            let first = renderings.first().ok_or_else(|| error::stage("first exposure")("no rendering"))?;
            rendered += mean(&first.radiance);
        }
        let ratio = (target / rendered) as f32;
        // Nothing to go by in a black capture, or where nothing is in sight.
        if !ratio.is_finite() || ratio <= 0.0 {
            return Ok(());
        }
        model.scene.light_scale *= ratio.clamp(1.0 / MAX_RATIO, MAX_RATIO);
        if (ratio - 1.0).abs() < 1e-3 {
            break;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_testkit::{Dual, Real, gradient};

    fn config(mode: ExposureMode) -> Config {
        let mut config = Config::preset("resolved").unwrap();
        config.exposure.mode = mode;
        config
    }

    /// `[eq:exposure-gain]`: the gradient of radiance against dual numbers.
    #[test]
    fn gains_agree_with_dual_numbers() {
        let radiance: Vec<f32> = (0..18).map(|i| ((i * 7 + 3) % 11) as f32 / 9.0 - 0.2).collect();
        let cotangent: Vec<f32> = (0..18).map(|i| ((i * 5 + 1) % 13) as f32 / 6.0 - 1.0).collect();
        let gain = Vec3::new(1.4, 0.7, 0.1);
        let image = Image::from_vec(3, 2, 3, radiance.clone()).unwrap();
        let exposed = expose(&image, gain);
        let mut d = Image::from_vec(3, 2, 3, cotangent.clone()).unwrap();
        expose_pull(gain, &mut d);
        let x: Vec<f64> = radiance.iter().copied().map(f64::from).collect();
        let under = |x: Dual, i: usize| Dual::of(f64::from(gain[i % 3])) * x;
        let oracle =
            |x: &[Dual]| (0..18).fold(Dual::of(0.0), |s, i| s + Dual::of(f64::from(cotangent[i])) * under(x[i], i));
        for (found, expected) in d.data().iter().copied().zip(gradient(oracle, &x)) {
            assert!((f64::from(found) - expected).abs() < 1e-5 * (1.0 + expected.abs()), "{found} {expected}");
        }
        assert!((0..18).all(|i| exposed.data()[i] == radiance[i] * gain[i % 3]));
    }

    /// `[eq:exposure-fit]`: exact where a gain explains the photograph, also if a quarter of it shows something else; the
    /// least sum of weighted absolute differences where none does; and what is masked or black has no say.
    #[test]
    fn the_fitted_gain_is_the_best_one() {
        let x: Vec<f32> = (0..48).map(|i| ((i * 7 + 3) % 11) as f32 / 9.0).collect();
        let image = |v: Vec<f32>| Image::from_vec(4, 4, 3, v).unwrap();
        let truth = [0.3, 1.0, 2.5];
        let mut exact: Vec<f32> = x.iter().enumerate().map(|(i, x)| x * truth[i % 3]).collect();
        exact[..12].fill(7.0);
        let found = fitted_gain(&image(x.clone()), &image(exact.clone()), None, true);
        assert!((0..3).all(|c| (found[c].unwrap() / truth[c] - 1.0).abs() < 1e-6), "{found:?}");
        let y: Vec<f32> =
            x.iter().enumerate().map(|(i, x)| x * (1.0 + 0.5 * ((i / 3 * 5 % 7) as f32 - 3.0) / 3.0)).collect();
        let mask = Mask::from_vec(4, 4, (0..16).map(|i| if i == 5 { 0.0 } else { 1.0 }).collect()).unwrap();
        let fit = |y: &[f32]| fitted_gain(&image(x.clone()), &image(y.to_vec()), Some(&mask), false)[0].unwrap();
        let best = fit(&y);
        let error = |g: f32| {
            let sum = |v: &[f32], i: usize| v[3 * i] + v[3 * i + 1] + v[3 * i + 2];
            (0..16)
                .filter(|i| sum(&x, *i) > 0.0)
                .map(|i| mask.data()[i] * sum(&x, i).sqrt() * (sum(&y, i) / sum(&x, i) - g).abs())
                .sum::<f32>()
        };
        assert!(error(best) < error(0.98 * best) && error(best) < error(1.02 * best));
        let mut hidden = y.clone();
        hidden[16] = 100.0;
        assert_eq!(fit(&hidden), best);
        assert_eq!(fitted_gain(&image(vec![0.0; 48]), &image(exact), None, false), [None; 3]);
    }

    /// `[eq:exposure-step]`
    #[test]
    fn the_gauge_is_fixed_and_the_file_holds_the_gains() {
        let mut exposure = Exposure::of_names(["a", "b", "c", "d"].map(String::from).to_vec());
        exposure.groups = vec![1, 1, 2, 2];
        let mut per_image = config(ExposureMode::PerImage);
        (per_image.exposure.rate, per_image.exposure.prior) = (0.5, 0.25);
        let log = exposure.toward(&per_image, 0, [Some(4.0); 3], 1.0);
        assert!((log[0] - 0.5 * 4f32.ln() / 1.25).abs() < 1e-6, "half of the way to the shrunk logarithm: {log:?}");
        assert_eq!(exposure.toward(&per_image, 0, [None; 3], 1.0), [0.0; 3], "nothing in sight moves nothing");
        exposure.set(ExposureMode::PerImage, 0, log);
        let [a, b] = [exposure.gain(0), exposure.gain(1)];
        assert!(
            (a * b - Vec3::ONE).length() < 1e-5 && (a.x.ln() - 0.5 * log[0]).abs() < 1e-6,
            "geometric mean: {a} {b}"
        );
        assert_eq!(exposure.gain(2), Vec3::ONE, "another group stays as it is");
        assert_eq!(exposure.of_renderings(ExposureMode::PerImage), Vec3::ONE);
        let back = Exposure::from_file(&exposure.to_file());
        assert!((back.gain(0) - a).length() < 1e-6 && back.names == exposure.names);
        let mut global = Exposure::of_names(vec!["all".into()]);
        global.set(ExposureMode::Global, 0, [0.5; 3]);
        assert!(global.of_renderings(ExposureMode::Global).x > 1.0, "a global gain has no gauge");
    }
}
