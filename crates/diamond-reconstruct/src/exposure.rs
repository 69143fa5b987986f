//! Exposure of the photographs: what multiplies the rendered radiance before it is compared.
//!
//! How bright a light is and how long a shutter was open are unknown in real captures. A gain per photograph, per view, or one for
//! all is learned beside the scene, as a logarithm, so that it stays positive. A scene that is twice as bright under
//! gains half as large gives the same photographs: with more than one gain the logarithms' mean is kept at 0, and
//! renderings have gain 1, the geometric mean of the exposures. A single global gain is part of every rendering.
use crate::{Config, ExposureMode, Model, ReconstructError, error};
use diamond_dataset::Capture;
use diamond_image::Image;
use glam::Vec3;
use serde::{Deserialize, Serialize};

/// Learned gains.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Exposure {
    /// What each gain belongs to: view or image names; `all` for a global one; none where exposure is fixed.
    pub names: Vec<String>,
    /// Natural logarithms of the gains, three per name (equal unless gains are per channel).
    pub log_gains: Vec<f32>,
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
        Self::of_names(match config.exposure.mode {
            ExposureMode::Fixed => Vec::new(),
            ExposureMode::Global => vec!["all".into()],
            ExposureMode::PerView => views.map(|v| v.name.clone()).collect(),
            ExposureMode::PerImage => views.flat_map(|v| &v.shots).map(|s| s.name.clone()).collect(),
        })
    }

    fn of_names(names: Vec<String>) -> Self {
        let n = names.len();
        Self { names, log_gains: vec![0.0; 3 * n] }
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
        Vec3::from_slice(&self.log_gains[3 * i..]).exp()
    }

    /// Gain of renderings: the global one, else 1.
    pub fn of_renderings(&self, mode: ExposureMode) -> Vec3 {
        if mode == ExposureMode::Global && !self.names.is_empty() { self.gain(0) } else { Vec3::ONE }
    }

    /// One step on gain `i` along its gradient, and the mean of many gains' logarithms back to 0.
    ///
    /// `[eq:exposure-step]` g ← g − rate·(Σ dₖ / Σ |dₖ| + λ·g) over pixels k, with d the products of [`expose_pull`]: the
    /// share by which pixels that want more light outweigh those that want less. Adam would remember the first, dark
    /// renderings for a thousand visits, and an image is visited a few dozen times.
    pub fn step(&mut self, config: &Config, i: usize, d: &GainGrad, factor: f32) {
        let exposure = &config.exposure;
        let share = |d: f32, weight: f32| if weight > 0.0 { d / weight } else { 0.0 };
        let shares = match exposure.per_channel {
            true => [0, 1, 2].map(|c| share(d.log_gain[c], d.weight[c])),
            false => [share(d.log_gain.element_sum(), d.weight.element_sum()); 3],
        };
        for (g, share) in self.log_gains[3 * i..3 * i + 3].iter_mut().zip(shares) {
            *g -= exposure.rate * factor * (share + exposure.prior * *g);
            *g = g.clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN);
        }
        if exposure.mode != ExposureMode::Global {
            self.fix_gauge();
        }
    }

    /// Takes the mean of all logarithms, channels together, from each: colour casts remain.
    fn fix_gauge(&mut self) {
        let sum: f64 = self.log_gains.iter().map(|g| f64::from(*g)).sum();
        let mean = (sum / self.log_gains.len().max(1) as f64) as f32;
        self.log_gains.iter_mut().for_each(|g| *g -= mean);
    }

    /// For the run's folder.
    pub fn to_file(&self) -> ExposureFile {
        let gain = self.names.iter().enumerate();
        ExposureFile { gain: gain.map(|(i, n)| NamedGain { name: n.clone(), gain: self.gain(i).to_array() }).collect() }
    }

    /// From the run's folder.
    pub fn from_file(file: &ExposureFile) -> Self {
        let mut out = Self::of_names(file.gain.iter().map(|g| g.name.clone()).collect());
        out.log_gains = file.gain.iter().flat_map(|g| g.gain.map(|v| v.max(f32::MIN_POSITIVE).ln())).collect();
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

/// Gradient of the logarithm of a gain, and how much it is the sum of.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GainGrad {
    /// d loss / d log-gain, per channel: Σ d·E.
    pub log_gain: Vec3,
    /// Σ |d·E|.
    pub weight: Vec3,
}

impl GainGrad {
    /// Adds another one × `share`.
    pub fn add(&mut self, other: &GainGrad, share: f32) {
        self.log_gain += other.log_gain * share;
        self.weight += other.weight * share;
    }
}

/// Pullback of [`expose`] at its result: turns `d` into the gradient of the radiance, and gives that of log-gain.
pub fn expose_pull(exposed: &Image, gain: Vec3, d: &mut Image) -> GainGrad {
    let (mut sum, mut weight) = ([0.0f64; 3], [0.0f64; 3]);
    for (d, exposed) in d.data_mut().chunks_exact_mut(3).zip(exposed.data().chunks_exact(3)) {
        for c in 0..3 {
            let product = f64::from(d[c]) * f64::from(exposed[c]);
            sum[c] += product;
            weight[c] += product.abs();
            d[c] *= gain[c];
        }
    }
    let vec3 = |v: [f64; 3]| Vec3::from_array(v.map(|v| v as f32));
    GainGrad { log_gain: vec3(sum), weight: vec3(weight) }
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

    /// `[eq:exposure-gain]`: gradients of radiance and log-gain against dual numbers.
    #[test]
    fn gains_agree_with_dual_numbers() {
        let radiance: Vec<f32> = (0..18).map(|i| ((i * 7 + 3) % 11) as f32 / 9.0 - 0.2).collect();
        let cotangent: Vec<f32> = (0..18).map(|i| ((i * 5 + 1) % 13) as f32 / 6.0 - 1.0).collect();
        let log_gain = Vec3::new(0.4, -0.7, 0.1);
        let image = Image::from_vec(3, 2, 3, radiance.clone()).unwrap();
        let exposed = expose(&image, log_gain.exp());
        let mut d = Image::from_vec(3, 2, 3, cotangent.clone()).unwrap();
        let d_log = expose_pull(&exposed, log_gain.exp(), &mut d);
        let x: Vec<f64> = radiance.iter().copied().chain(log_gain.to_array()).map(f64::from).collect();
        let oracle = |x: &[Dual]| {
            (0..18).fold(Dual::of(0.0), |sum, i| sum + Dual::of(f64::from(cotangent[i])) * x[18 + i % 3].exp() * x[i])
        };
        for (found, expected) in d.data().iter().copied().chain(d_log.log_gain.to_array()).zip(gradient(oracle, &x)) {
            assert!((f64::from(found) - expected).abs() < 1e-5 * (1.0 + expected.abs()), "{found} {expected}");
        }
    }

    /// `[eq:exposure-step]`
    #[test]
    fn the_gauge_is_fixed_and_the_file_holds_the_gains() {
        let mut exposure = Exposure::of_names(vec!["a".into(), "b".into()]);
        let per_image = config(ExposureMode::PerImage);
        for _ in 0..5 {
            let d = GainGrad { log_gain: Vec3::new(-1.0, -2.0, -3.0), weight: Vec3::splat(4.0) };
            exposure.step(&per_image, 0, &d, 1.0);
        }
        let [a, b] = [exposure.gain(0), exposure.gain(1)];
        assert!(a.x > 1.0 && a.x == a.y && a.y == a.z, "one gain for all channels: {a}");
        assert!((a * b - Vec3::ONE).length() < 1e-5, "geometric mean: {a} {b}");
        // Half of the weight agrees: half the rate each time, and half of that after the gauge.
        let expected = 5.0 * 0.5 * per_image.exposure.rate * 0.5;
        assert!((a.x.ln() - expected).abs() < 0.02 * expected, "{a} {expected}");
        assert_eq!(exposure.of_renderings(ExposureMode::PerImage), Vec3::ONE);
        let back = Exposure::from_file(&exposure.to_file());
        assert!((back.gain(0) - a).length() < 1e-6 && back.names == exposure.names);
        let mut global = Exposure::of_names(vec!["all".into()]);
        let d = GainGrad { log_gain: -Vec3::ONE, weight: Vec3::ONE };
        global.step(&config(ExposureMode::Global), 0, &d, 1.0);
        assert!(global.of_renderings(ExposureMode::Global).x > 1.0, "a global gain has no gauge");
    }
}
