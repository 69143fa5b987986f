//! A whole run: from a capture to model, figures and report, with checkpoints on the way.
use crate::RelighterOnSurface;
use crate::capture_check::{check_images, open_capture};
use crate::evaluation::evaluate_with;
use crate::output_file::write_json;
use crate::peak_memory::PeakAfter;
use crate::render_run::holds_results;
use crate::run_record::RunRecord;
use crate::{
    AtOnce, Metrics, Plan, SssError, StoredCamera, StoredLight, TrainingLog, peak_bytes, shape_scores, write_report,
};
use diamond_augment::Lack;
use diamond_dataset::{Capture, Selection, SelectionManifest};
use diamond_gpu::{Device, DeviceChoice, DeviceStepper, Rasterizer};
use diamond_reconstruct::{
    ByteSize, CaptureFacts, Config, InitialSource, InstructionChoice, Needs, ReconstructError, Reconstruction,
    StepReport,
};
use diamond_splat::remove_leftovers;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// What to reconstruct, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct ReconstructOptions {
    /// The capture.
    pub capture: PathBuf,
    /// The run's folder.
    pub output: PathBuf,
    /// Preset, or path of a TOML file.
    pub preset: String,
    /// Length of the run; the configuration's where absent.
    pub steps: Option<u64>,
    /// Seed; the configuration's where absent.
    pub seed: Option<u64>,
    /// Threads; all where absent. The result does not depend on it.
    pub threads: Option<usize>,
    /// Instruction set; the configuration's where absent.
    pub instruction_set: Option<InstructionChoice>,
    /// What the process may take in memory at its peak; the configuration's where absent.
    pub memory_limit: Option<ByteSize>,
    /// Training views.
    pub views: Selection,
    /// Training lights.
    pub lights: Selection,
    /// A [`SelectionManifest`] that says which images are learned from and held out, before `views` and `lights`.
    pub selection: Option<PathBuf>,
    /// Points (PLY) or splats (any format) to start from, in place of the capture's.
    pub initial: Option<PathBuf>,
    /// Where training steps are made.
    pub device: DeviceChoice,
    /// Continue from the checkpoint.
    pub resume: bool,
    /// Replace the results of an earlier run.
    pub force: bool,
    /// The command line, for the report.
    pub command: String,
}

impl ReconstructOptions {
    /// The default preset on all images.
    pub fn new(capture: impl Into<PathBuf>, output: impl Into<PathBuf>) -> Self {
        Self {
            capture: capture.into(),
            output: output.into(),
            preset: "resolved".into(),
            steps: None,
            seed: None,
            threads: None,
            instruction_set: None,
            memory_limit: None,
            views: Selection::All,
            lights: Selection::All,
            selection: None,
            initial: None,
            device: DeviceChoice::Cpu,
            resume: false,
            force: false,
            command: String::new(),
        }
    }

    /// The configuration with the options laid over it.
    pub fn config(&self) -> Result<Config, SssError> {
        let mut config = Config::load(&self.preset)?;
        config.steps = self.steps.unwrap_or(config.steps);
        config.seed = self.seed.unwrap_or(config.seed);
        config.instruction_set = self.instruction_set.unwrap_or(config.instruction_set);
        config.memory_limit = self.memory_limit.or(config.memory_limit);
        if self.initial.is_some() {
            config.initial.source = InitialSource::Points;
        }
        config.validate(&self.preset)?;
        Ok(config)
    }
}

/// What happens during a run.
#[derive(Debug, Clone)]
pub enum Event<'a> {
    /// Something worth knowing.
    Note(String),
    /// The steps begin.
    Started {
        /// Steps done in earlier sessions.
        done: u64,
        /// All steps.
        steps: u64,
        /// Images to learn from.
        images: usize,
    },
    /// Pictures that nobody took are being made.
    Made {
        /// Pictures done.
        done: usize,
        /// All pictures.
        all: usize,
    },
    /// A step is done.
    Step {
        /// What it did.
        report: &'a StepReport,
        /// PSNR of the training images over about the last 100 steps, dB.
        psnr: f64,
    },
    /// A checkpoint is on disk.
    Checkpoint {
        /// Steps done.
        step: u64,
    },
    /// A held-out image was evaluated.
    Evaluated {
        /// Images done.
        done: usize,
        /// All images.
        all: usize,
    },
}

/// What a run has come to.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Figures on the held-out images; without such images every figure is absent, with the reason.
    pub metrics: Option<Metrics>,
    /// Seconds of all sessions.
    pub seconds: f64,
    /// Gaussians of the model.
    pub gaussians: usize,
}

/// Costs of the sessions so far, kept with the checkpoint.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
struct Costs {
    seconds: f64,
    peak_bytes: Option<u64>,
    profile: Vec<(String, f64)>,
    #[serde(default)]
    counters: Vec<(String, u64)>,
}

const COSTS_FILE: &str = "costs.json";

/// Folder in the run's in which pictures that nobody took are kept.
const MADE_PICTURES: &str = "made";

/// Files and folders that a run writes; `--force` removes these and nothing else.
const RESULTS: [&str; 19] = [
    "model.ply",
    "medium.toml",
    "surface.ply",
    "config.toml",
    "scene.toml",
    "exposure.toml",
    "network.safetensors",
    "metrics.json",
    "metrics.csv",
    "report.html",
    "log.csv",
    "profile.json",
    "run.json",
    "needs.json",
    "selection.json",
    "checkpoint/state.safetensors",
    "checkpoint/costs.json",
    "images",
    MADE_PICTURES,
];

/// The relighter of a configuration, if it asks for one.
fn relighter_of(config: &Config) -> Result<Option<RelighterOnSurface>, SssError> {
    if !config.augmentation.asks_relighter() {
        return Ok(None);
    }
    match &config.augmentation.relighter {
        Some(path) => RelighterOnSurface::load(path).map(Some),
        None => Err(SssError::Usage(
            "augmentation.source asks for a relighter: name the file of one that `diamond train` has written as augmentation.relighter"
                .into(),
        )),
    }
}

fn clear(folder: &Path) -> Result<(), SssError> {
    for name in RESULTS {
        let path = folder.join(name);
        let removed = if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
        match removed {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                return Err(SssError::io(&path, "remove the earlier result")(e));
            }
            _ => {}
        }
    }
    Ok(())
}

/// Whether results can be put into `folder`, found out before hours are spent: what is there must be a folder that can
/// be written to, or there must be a place for one.
fn check_output_folder(folder: &Path) -> Result<(), SssError> {
    let nearest = folder.ancestors().find(|p| p.as_os_str().is_empty() || p.exists());
    if let Some(file) = nearest.filter(|p| !p.as_os_str().is_empty() && !p.is_dir()) {
        let file = file.display();
        return Err(SssError::Usage(format!(
            "{}: cannot hold the results since {file} is a file and no folder; name another folder with -o",
            folder.display()
        )));
    }
    if folder.is_dir() {
        let probe = folder.join(format!(".probe.{}.0.tmp", std::process::id()));
        std::fs::File::create(&probe).map_err(SssError::io(folder, "write into the folder"))?;
        std::fs::remove_file(&probe).map_err(SssError::io(&probe, "remove"))?;
    }
    Ok(())
}

/// Reconstructs. `events` is told what happens; when `interrupted` becomes true the step is finished, a checkpoint
/// written, and [`SssError::Interrupted`] returned. The same bits come out whatever the number of threads.
pub fn reconstruct(
    options: &ReconstructOptions,
    events: &mut (dyn FnMut(Event<'_>) + Send),
    interrupted: &AtomicBool,
) -> Result<Outcome, SssError> {
    let Some(threads) = options.threads else { return run(options, events, interrupted) };
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads.max(1))
        .build()
        .map_err(|e| SssError::Usage(format!("{threads} threads cannot be started: {e}")))?;
    pool.install(|| run(options, events, interrupted))
}

fn run(
    options: &ReconstructOptions,
    events: &mut (dyn FnMut(Event<'_>) + Send),
    interrupted: &AtomicBool,
) -> Result<Outcome, SssError> {
    let begun = Instant::now();
    let mut config = options.config()?;
    // Before anything is written: a device that is not there is a wrong option.
    let device = Device::open(options.device).map_err(|e| SssError::Usage(e.to_string()))?.map(Arc::new);
    let instruction_set = config.instruction_set.apply().map_err(|e| SssError::Usage(e.to_string()))?;
    let folder = options.output.as_path();
    let checkpoint = folder.join("checkpoint");
    if options.resume && options.force {
        return Err(SssError::Usage("--resume and --force contradict each other; choose one".into()));
    }
    if holds_results(folder) && !options.resume && !options.force {
        return Err(SssError::Exists(folder.to_owned()));
    }
    check_output_folder(folder)?;
    let whole = open_capture(&options.capture, &config)?;
    whole.notes.iter().for_each(|note| events(Event::Note(note.clone())));
    // Before anything is decoded: from here on a file whose content changes is refused when it is read.
    let capture_hash = whole.hash()?;
    let chosen = match &options.selection {
        Some(path) => whole.with_manifest(&SelectionManifest::read(path)?)?,
        None => whole.clone(),
    };
    let mut capture = chosen.select(&options.views, &options.lights)?;
    if let Some(path) = &options.initial {
        capture.points = Some(path.clone());
    }
    let mut limited = None;
    if config.memory_limit.is_some() {
        let facts = CaptureFacts::of(&capture)?;
        let needs = Needs::decide(&config, &facts);
        let plan = Plan::new(&config, facts, needs)?;
        events(Event::Note(plan.memory.to_string().trim_end().to_owned()));
        plan.memory.apply(&mut config);
        limited = Some(plan);
    }
    let at_once = limited.as_ref().map_or_else(|| AtOnce::of(&config), |plan| plan.memory.at_once.clone());
    whole.limit_cache(at_once.photographs as usize);
    diamond_splat::keep_buffers(at_once.buffers as usize);
    check_images(&whole, at_once.decode_in_parallel)?;
    let mut peak_after = PeakAfter::default();
    peak_after.note("opening");
    std::fs::create_dir_all(folder).map_err(SssError::io(folder, "create the folder"))?;
    for folder in [folder.to_owned(), checkpoint.clone(), folder.join("images"), folder.join(MADE_PICTURES)] {
        for path in remove_leftovers(&folder) {
            events(Event::Note(format!("{}: left by a process that was killed, removed", path.display())));
        }
    }
    if options.force {
        clear(folder)?;
    }
    let relighter = relighter_of(&config)?;
    let resumed = options.resume && Reconstruction::has_checkpoint(&checkpoint);
    let mut costs = Costs::default();
    let mut training = if resumed {
        costs = crate::output_file::read_json(&checkpoint.join(COSTS_FILE), "costs").unwrap_or_default();
        Reconstruction::resume(capture.clone(), &config, &checkpoint)?
    } else {
        if options.resume {
            events(Event::Note(format!("{}: no checkpoint, starting anew", checkpoint.display())));
        }
        Reconstruction::new(capture.clone(), &config)?
    };
    if let Some(relighter) = relighter {
        training = training.with_relighter(Box::new(relighter));
    }
    training.keep_pictures_in(&folder.join(MADE_PICTURES));
    if let Some(device) = device {
        let name = device.adapter().name.clone();
        training.blend_by(Box::new(Rasterizer::new(device.clone()).map_err(device_error)?));
        let stepper = DeviceStepper::new(device).map_err(device_error)?;
        events(Event::Note(match training.step_by(Box::new(stepper)) {
            None => format!("training steps are made on {name}"),
            Some(lacking) => {
                format!("training steps are made on the CPU, their pictures on {name}, which lacks {lacking}")
            }
        }));
    }
    peak_after.note("first Gaussians");
    let mut log = match resumed {
        true => TrainingLog::read_until(&folder.join("log.csv"), config.steps, training.steps_done()),
        false => TrainingLog::new(config.steps),
    };
    let mut record = record_of(options, &config, &capture, capture_hash.clone());
    record.instruction_set = instruction_set.to_string();
    record.write(folder)?;
    let selection = capture.manifest(&format!("views {}, lights {}", options.views, options.lights), 0)?;
    write_json(&folder.join("selection.json"), &selection)?;
    events(Event::Note(format!("first Gaussians: {}", training.initial_origin)));
    let plan = match limited {
        Some(plan) => plan,
        None => Plan::new(&config, training.facts().clone(), training.needs().clone())?,
    }
    .with_lack(Lack::of(&capture, &config.augmentation.wanted()));
    write_json(&folder.join("needs.json"), &plan.to_json()?)?;
    events(Event::Note(plan.summary()));
    events(Event::Started { done: training.steps_done(), steps: config.steps, images: training.pair_count() });
    let earlier = costs.clone();
    let spent = |training: &Reconstruction| Costs {
        seconds: earlier.seconds + begun.elapsed().as_secs_f64(),
        peak_bytes: peak_bytes().max(earlier.peak_bytes),
        profile: add_sums(&earlier.profile, &training.profile()),
        counters: add_sums(&earlier.counters, &training.counters()),
    };
    let save = |training: &mut Reconstruction, log: &TrainingLog| -> Result<(), SssError> {
        log.write(&folder.join("log.csv"))?;
        training.save_checkpoint(&checkpoint)?;
        write_json(&checkpoint.join(COSTS_FILE), &spent(training))
    };
    while !training.finished() {
        let made = training.make_pictures(&mut |done, all| events(Event::Made { done, all }));
        let report = match made.and_then(|()| training.step()) {
            Ok(report) => report,
            Err(e @ ReconstructError::Capture(_)) => {
                // The state is that of the last whole step. What failed is reading, and that is what is to be reported.
                log.flush();
                if save(&mut training, &log).is_ok() {
                    events(Event::Checkpoint { step: training.steps_done() });
                    events(Event::Note(format!(
                        "{} steps are kept in {}: put the file back as it was and run the same command with --resume",
                        training.steps_done(),
                        checkpoint.display()
                    )));
                }
                return Err(e.into());
            }
            Err(e) => return Err(e.into()),
        };
        training.take_notes().into_iter().for_each(|note| events(Event::Note(note)));
        log.push(&report);
        events(Event::Step { report: &report, psnr: log.running_psnr().unwrap_or(0.0) });
        let stop = interrupted.load(Ordering::SeqCst);
        if training.finished() {
            peak_after.note("steps");
        }
        if training.checkpoint_due() || training.finished() || stop {
            log.flush();
            save(&mut training, &log)?;
            events(Event::Checkpoint { step: training.steps_done() });
        }
        if stop && !training.finished() {
            return Err(SssError::Interrupted { step: training.steps_done(), folder: folder.to_owned() });
        }
    }
    peak_after.note("checkpoint");
    training.model()?.save(folder)?;
    let now = spent(&training);
    write_profile(folder, config.steps, &now, &peak_after)?;
    let model = training.model()?;
    let scores = evaluate_with(model, &at_once, &capture, |done, all, _| {
        events(Event::Evaluated { done, all });
        match interrupted.load(Ordering::SeqCst) {
            true => Err(SssError::Interrupted { step: config.steps, folder: folder.to_owned() }),
            false => Ok(()),
        }
    })?;
    let shape = shape_scores(model, &at_once, &capture, &whole)?;
    peak_after.note("evaluation");
    let seconds = earlier.seconds + begun.elapsed().as_secs_f64();
    let peak = peak_bytes().max(earlier.peak_bytes);
    record.seconds = Some(seconds);
    record.peak_bytes = peak;
    record.write(folder)?;
    let metrics = Metrics {
        scores,
        shape,
        capture_hash,
        seconds: Some(seconds),
        peak_bytes: peak,
        seed: config.seed,
        preset: options.preset.clone(),
        steps: config.steps,
        gaussians: model.len(),
        gain: crate::HeldOutGain::of(model),
        trained_on: None,
    };
    metrics.write(folder)?;
    write_report(folder, model, &capture, &metrics, &record, &log, &at_once)?;
    peak_after.note("report");
    write_profile(folder, config.steps, &Costs { peak_bytes: peak_bytes().max(now.peak_bytes), ..now }, &peak_after)?;
    if let (Some(limit), Some(peak)) = (plan.memory.limit, peak_bytes())
        && peak > limit
    {
        events(Event::Note(format!(
            "the memory limit of {} was exceeded: the peak was {}, {} were planned (see `peak_bytes_after` in \
             profile.json); the results are not affected. Lower density.max_gaussians or the limit",
            ByteSize(limit),
            ByteSize(peak).rounded(),
            ByteSize(plan.memory.peak).rounded()
        )));
    }
    Ok(Outcome { gaussians: model.len(), metrics: Some(metrics), seconds })
}

fn record_of(options: &ReconstructOptions, config: &Config, capture: &Capture, capture_hash: String) -> RunRecord {
    RunRecord {
        version: env!("CARGO_PKG_VERSION").into(),
        command: options.command.clone(),
        capture: capture.root.clone(),
        capture_hash,
        views: options.views.to_string(),
        lights: options.lights.to_string(),
        preset: options.preset.clone(),
        steps: config.steps,
        seed: config.seed,
        threads: rayon::current_num_threads(),
        instruction_set: String::new(),
        training_images: capture.train.iter().map(|v| v.shots.len()).sum(),
        up: RunRecord::up_of(capture).into(),
        cameras: capture.train.iter().map(|v| StoredCamera::of(&v.name, &v.camera)).collect(),
        rig: RunRecord::rig_of(capture).iter().map(StoredLight::of).collect(),
        seconds: None,
        peak_bytes: None,
    }
}

fn add_sums<T: Copy + std::ops::AddAssign>(earlier: &[(String, T)], now: &[(&'static str, T)]) -> Vec<(String, T)> {
    let mut out = earlier.to_vec();
    for (name, value) in now {
        match out.iter_mut().find(|(n, _)| n == name) {
            Some((_, sum)) => *sum += *value,
            None => out.push(((*name).to_owned(), *value)),
        }
    }
    out
}

fn write_profile(folder: &Path, steps: u64, costs: &Costs, peak_after: &PeakAfter) -> Result<(), SssError> {
    let in_steps: f64 = costs.profile.iter().map(|(_, s)| s).sum();
    let parts: serde_json::Map<String, serde_json::Value> =
        costs.profile.iter().map(|(name, s)| (name.clone(), (*s).into())).collect();
    let counters: serde_json::Map<String, serde_json::Value> =
        costs.counters.iter().map(|(name, n)| (name.clone(), (*n).into())).collect();
    let value = serde_json::json!({
        "seconds": parts,
        "counters": counters,
        "seconds_in_steps": in_steps,
        "seconds_total": costs.seconds,
        "steps": steps,
        "steps_per_second": if in_steps > 0.0 { Some(steps as f64 / in_steps) } else { None },
        "peak_bytes": costs.peak_bytes,
        "peak_bytes_after": peak_after,
    });
    write_json(&folder.join("profile.json"), &value)
}

pub(crate) fn device_error(error: diamond_gpu::GpuError) -> SssError {
    SssError::Reconstruct(ReconstructError::Device { detail: error.to_string() })
}
