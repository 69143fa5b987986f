//! Small models in training.
use super::*;
use crate::first_stage::{FirstStage, SpaceToDepth};
use crate::nn::{Source, Variables, VariablesBuilder};
use crate::noise::Noise;
use crate::parameterization::Parameterization;
use crate::schedule::Schedule;
use crate::unet::{Conditions, ControlConfig, ControlNet, UNet, UNetConfig, ViewAttention};
use crate::{DiffusionError, Result};
use candle_core::{Device, Tensor};

/// Two levels of few channels, with a light code and hints.
fn config() -> ControlConfig {
    let unet = UNetConfig {
        in_channels: 12,
        out_channels: 12,
        channels: vec![24, 32],
        blocks: 1,
        attention: vec![false, true],
        heads: vec![1, 2],
        context: Some(8),
        linear_projection: true,
        groups: 4,
        rays: false,
        views: ViewAttention::None,
        light: Some(2),
    };
    ControlConfig { unet, hints: 7, hint_channels: vec![8, 8] }
}

struct Model {
    unet: UNet,
    control: ControlNet,
}

fn model(seed: u64) -> (Model, Variables) {
    let builder = VariablesBuilder::new(Source::Seed(seed));
    let unet = UNet::new(&builder.root().at("unet"), &config().unet).unwrap();
    let control = ControlNet::new(&builder.root().at("control"), &config()).unwrap();
    (Model { unet, control }, builder.finish().0)
}

fn objective(image: ImageTerms) -> Objective {
    let schedule = Schedule::stable_diffusion().with_zero_terminal_snr();
    Objective { schedule, parameterization: Parameterization::V, min_snr: Some(5.0), image, noise_only: 0.0 }
}

/// Smooth pictures (2, 3, 8, 8) in [−1, 1], their hints and light codes.
fn batch() -> (Tensor, Tensor, Tensor) {
    let wave = |i: usize, c: usize| {
        let (b, channel, y, x) = (i / 64 / c, i / 64 % c, i / 8 % 8, i % 8);
        ((x * (channel + 1) + y * (b + 1)) as f32 * 0.4).sin() * 0.8
    };
    let picture =
        |c: usize| Tensor::from_vec((0..2 * c * 64).map(|i| wave(i, c)).collect(), (2, c, 8, 8), &Device::Cpu);
    let light = Noise::new(1, "light", 0).normal_tensor((2, 9), &Device::Cpu).unwrap();
    (picture(3).unwrap(), picture(7).unwrap(), light)
}

fn loss(model: &Model, objective: &Objective, timesteps: &[usize], noise_of: u64) -> Result<Tensor> {
    let (pictures, hints, light) = batch();
    let clean = SpaceToDepth(2).encode(&pictures)?;
    let noise = Noise::new(3, "noise", noise_of).normal_tensor(clean.shape(), &Device::Cpu)?;
    objective.value(&clean, &noise, timesteps, &SpaceToDepth(2), None, |noisy, t| {
        let conditions = Conditions { light: Some(&light), ..Conditions::default() };
        let control = model.control.forward(noisy, t, &hints, &conditions)?;
        model.unet.forward(noisy, t, &conditions, Some(&control))
    })
}

/// One batch at fixed noise is learned by heart: the objective falls below 1e-3.
#[test]
fn one_batch_is_overfitted() {
    let (model, variables) = model(1);
    let settings =
        TrainSettings { steps: 700, warm_up: 10, rate: 4e-3, decay: 0.0, average: 0.9, ..TrainSettings::default() };
    let mut trainer = Trainer::new(variables, settings).unwrap();
    let objective = objective(ImageTerms::NONE);
    let mut best = f64::INFINITY;
    let mut first = 0.0;
    for _ in 0..settings.steps {
        let report = trainer.step(|_| loss(&model, &objective, &[600, 900], 0)).unwrap();
        first = if report.step == 1 { report.loss } else { first };
        best = best.min(report.loss);
        if best < 1e-3 {
            break;
        }
    }
    assert!(first > 0.1 && best < 1e-3, "from {first} to {best} in {} steps", trainer.step_number());
}

/// A few steps in, every weight has a gradient: zero convolutions have let the others through.
#[test]
fn every_weight_learns_after_a_few_steps() {
    let (model, variables) = model(2);
    let mut trainer = Trainer::new(variables, TrainSettings { warm_up: 1, ..TrainSettings::default() }).unwrap();
    let objective = objective(ImageTerms::default());
    for _ in 0..3 {
        trainer.step(|step| loss(&model, &objective, &[200, 700], step)).unwrap();
    }
    let gradients = loss(&model, &objective, &[200, 700], 3).unwrap().backward().unwrap();
    for (name, var) in trainer.variables().vars() {
        let gradient = gradients.get(var).unwrap_or_else(|| panic!("{name} has no gradient"));
        let largest = gradient.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(largest > 0.0, "{name} has a gradient of zeros");
    }
}

fn bits<'a>(tensors: impl Iterator<Item = (&'a str, &'a Tensor)>) -> Vec<(String, Vec<u32>)> {
    let bits = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect();
    tensors.map(|(name, t)| (name.to_owned(), bits(t))).collect()
}

#[test]
fn a_resumed_run_has_the_bits_of_one_that_was_not_interrupted() {
    let folder = std::env::temp_dir().join(format!("diamond-trainer-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("checkpoint.safetensors");
    let settings = TrainSettings { steps: 6, warm_up: 2, ..TrainSettings::default() };
    let objective = objective(ImageTerms::default());
    let run = |trainer: &mut Trainer, model: &Model, steps: u64| {
        for _ in 0..steps {
            let timesteps = |step| objective.timesteps(settings.seed, step, 2, 1);
            trainer.step(|step| loss(model, &objective, &timesteps(step), step)).unwrap();
        }
    };
    let (whole_model, variables) = model(3);
    let mut whole = Trainer::new(variables, settings).unwrap();
    run(&mut whole, &whole_model, 6);
    let (first_model, variables) = model(3);
    let mut first = Trainer::new(variables, settings).unwrap();
    run(&mut first, &first_model, 4);
    first.save(&path).unwrap();
    // Another seed: everything must come from the checkpoint.
    let (second_model, variables) = model(4);
    let mut second = Trainer::resume(variables, settings, &path).unwrap();
    assert_eq!(second.step_number(), 4);
    assert_ne!(bits(whole.variables().tensors()), bits(second.variables().tensors()));
    run(&mut second, &second_model, 2);
    assert_eq!(bits(whole.variables().tensors()), bits(second.variables().tensors()));
    assert_eq!(bits(whole.averages()), bits(second.averages()));

    let other = TrainSettings { seed: 1, ..settings };
    let (_, variables) = model(3);
    let error = Trainer::resume(variables, other, &path).unwrap_err().to_string();
    assert!(error.contains("other settings"), "{error}");
    let builder = VariablesBuilder::new(Source::Seed(0));
    UNet::new(&builder.root().at("unet"), &config().unet).unwrap();
    let error = Trainer::resume(builder.finish().0, settings, &path).unwrap_err().to_string();
    assert!(error.contains("no such weight"), "{error}");
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn what_is_not_finite_stops_training_and_moves_nothing() {
    let (model, variables) = model(5);
    let mut trainer = Trainer::new(variables, TrainSettings::default()).unwrap();
    let before = bits(trainer.variables().tensors());
    let broken = |_: u64| Ok((loss(&model, &objective(ImageTerms::NONE), &[1, 2], 0)? * f64::NAN)?);
    let error = trainer.step(broken).unwrap_err();
    assert!(matches!(error, DiffusionError::NonFinite { .. }) && error.to_string().contains("step 0"));
    assert_eq!(bits(trainer.variables().tensors()), before);
    let wrong = TrainSettings { clip: 0.0, ..TrainSettings::default() };
    assert!(wrong.validate().unwrap_err().to_string().contains("clip"));
}

/// [eq:min-snr]: the exact prediction costs nothing; weights by hand; [eq:training-rate] and [eq:average] by hand.
#[test]
fn weights_rates_and_averages_have_their_values() {
    let objective = objective(ImageTerms::default());
    let clean = Noise::new(1, "clean", 0).normal_tensor((2, 12, 4, 4), &Device::Cpu).unwrap();
    let noise = Noise::new(1, "noise", 0).normal_tensor((2, 12, 4, 4), &Device::Cpu).unwrap();
    let exact = |scale: f64| {
        let t = [999, 300];
        let weights: Vec<_> = t
            .iter()
            .map(|t| Parameterization::V.target_weights(objective.schedule.level(*t)))
            .map(|(a, b)| (a * scale, b * scale))
            .collect();
        let value = objective.value(&clean, &noise, &t, &SpaceToDepth(2), None, |_, _| {
            crate::parameterization::combine(&clean, &noise, &weights)
        });
        value.unwrap().to_scalar::<f32>().unwrap()
    };
    assert!(exact(1.0) < 1e-6 && exact(0.9) > 1e-3, "{} {}", exact(1.0), exact(0.9));
    let level = objective.schedule.level(300);
    let snr = level.snr();
    assert!((objective.weight(300) - (snr + 1.0).min(5.0) / (snr + 1.0)).abs() < 1e-12);
    assert_eq!(objective.weight(999), 1.0);
    let epsilon = Objective { parameterization: Parameterization::Epsilon, ..objective.clone() };
    assert!((epsilon.weight(0) - 5.0 / epsilon.schedule.level(0).snr()).abs() < 1e-12 && epsilon.weight(900) == 1.0);
    let settings = TrainSettings { steps: 110, warm_up: 10, rate: 2.0, ..TrainSettings::default() };
    assert!((settings.rate_at(4) - 1.0).abs() < 1e-12 && (settings.rate_at(10) - 2.0).abs() < 1e-12);
    assert!((settings.rate_at(60) - 1.0).abs() < 1e-12 && settings.rate_at(110) < 1e-12);
    assert_eq!((settings.average_at(0), settings.average_at(1_000_000)), (0.1, 0.999));
    let shared = objective.timesteps(1, 2, 8, 4);
    assert!(shared[..4].iter().all(|t| *t == shared[0]) && shared[4..].iter().all(|t| *t == shared[4]));
    assert_eq!(shared, objective.timesteps(1, 2, 8, 4));
    assert_ne!(shared, objective.timesteps(1, 3, 8, 4));
}

#[test]
fn a_perceptual_term_needs_a_distance() {
    let objective = objective(ImageTerms { perceptual: 0.1, ..ImageTerms::NONE });
    let clean = Noise::new(1, "clean", 0).normal_tensor((1, 12, 4, 4), &Device::Cpu).unwrap();
    let value = |distance: Option<super::objective::Perceptual<'_>>| {
        objective.value(&clean, &clean, &[300], &SpaceToDepth(2), distance, |x, _| Ok(x.clone()))
    };
    assert!(value(None).unwrap_err().to_string().contains("perceptual"));
    let distance = |a: &Tensor, b: &Tensor| Ok((a - b)?.abs()?.flatten_from(1)?.mean(1)?);
    assert!(value(Some(&distance)).is_ok());
}
