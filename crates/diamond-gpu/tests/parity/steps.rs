//! Whole training steps on the device against the CPU's, and each of their parts against the CPU's own function, fed with what the device has.
use crate::compare::relative_l2;
use crate::scenes::uniform;
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_gpu::{Device, DeviceStepper, Store};
use diamond_image::{Image, Mask};
use diamond_light::{Falloff, OlatLight};
use diamond_medium::{Coat, Medium, Surface, Transport};
use diamond_pathtrace::Mesh;
use diamond_reconstruct::{
    CaptureFacts, Config, CpuEngine, Engine, InitialPoints, MediumTerm, Model, Needs, Scene, StepNeeds, StepOutcome,
    StepPlan, StepReport, StepTask, Stepper, TensorFile, TrainingPair,
};
use diamond_splat::density::DensityStats;
use glam::Vec3;
use rand_pcg::Pcg64Mcg;
use rand_pcg::rand_core::SeedableRng;
use std::cell::RefCell;
use std::path::Path;
use std::rc::Rc;
use std::sync::Arc;

/// A model and a batch.
pub struct Scenario {
    pub name: &'static str,
    /// Laid over a preset.
    pub settings: &'static str,
    pub medium: bool,
    pub images: usize,
    /// Of a thousand.
    pub step: u64,
    /// Added to the logarithms of standard deviations.
    pub growth: f32,
}

/// Gaussians of every scenario.
const GAUSSIANS: usize = 300;
pub const SIZE: [usize; 2] = [45, 37];

pub const MLP: Scenario = Scenario {
    name: "network and transfer vectors",
    settings: "[subsurface]\nmodel = \"mlp\"\n[residual]\ntransfer_smoothness = 0.0\n[splat]\nmax_scale = 0.04\n[visibility]\nsamples = 200",
    medium: false,
    images: 1,
    step: 301,
    growth: 0.0,
};
pub const MEDIUM: Scenario = Scenario {
    name: "medium",
    settings: "[subsurface]\nseeds = 0\n[residual]\ntransfer_smoothness = 0.0\nnormal_gradient = false",
    medium: true,
    images: 1,
    step: 301,
    growth: 0.0,
};
pub const FITTED: Scenario = Scenario {
    name: "fitted visibility",
    settings: "[subsurface]\nmodel = \"mlp\"\n[visibility]\ntraced = false\n[residual]\nnetwork = false",
    medium: false,
    images: 1,
    step: 301,
    growth: 0.0,
};

/// Those that are compared as a whole.
pub const SCENARIOS: [Scenario; 7] = [
    MLP,
    MEDIUM,
    FITTED,
    // So large that the first lists of tiles are too short.
    Scenario {
        name: "two images",
        settings: "[subsurface]\nmodel = \"mlp\"",
        medium: false,
        images: 2,
        step: 302,
        growth: 1.2,
    },
    Scenario {
        name: "medium, a picture that nobody took",
        settings: "[subsurface]\nseeds = 0",
        medium: true,
        images: 3,
        step: 20,
        growth: 0.0,
    },
    Scenario {
        name: "predecessor",
        settings: "base = \"sss-3dgs\"\n[subsurface]\nmodel = \"mlp\"\n[loss]\nincident = 0.01\nl2 = 0.1\n[splat]\nmax_scale = 0.02\n[residual]\nincident_gradient = true",
        medium: false,
        images: 1,
        step: 60,
        growth: 0.0,
    },
    Scenario {
        name: "surface alone",
        settings: "[subsurface]\nmodel = \"mlp\"\n[residual]\nnetwork = false\ntransfer = false\ncodes = 0\n[shading]\nmetal = \"no\"\n[adam]\nsparse = true\n[loss]\nssim = 0.0",
        medium: false,
        images: 1,
        step: 20,
        growth: 0.0,
    },
];

/// Passes everything on, and can still be asked.
struct Shared {
    stepper: Rc<RefCell<DeviceStepper>>,
    name: String,
}

impl Stepper for Shared {
    fn name(&self) -> &str {
        &self.name
    }
    fn lacks(&self, model: &Model, needs: &StepNeeds, batch: &[TrainingPair<'_>]) -> Option<String> {
        self.stepper.borrow().lacks(model, needs, batch)
    }
    fn load(&mut self, model: &Model, stats: &DensityStats) -> Result<(), String> {
        self.stepper.borrow_mut().load(model, stats)
    }
    fn store(&mut self, model: &mut Model, stats: &mut DensityStats) -> Result<(), String> {
        self.stepper.borrow_mut().store(model, stats)
    }
    fn step(&mut self, task: &StepTask<'_>) -> Result<StepOutcome, String> {
        self.stepper.borrow_mut().step(task)
    }
}

pub fn scene() -> Scene {
    Scene {
        centre: [0.05, -0.02, 0.03],
        radius: 1.0,
        extent: 3.0,
        camera_distance: 3.0,
        light_distance: 2.5,
        light_scale: 2.0,
    }
}

pub fn config(scenario: &Scenario) -> Result<Config, String> {
    let mut config = Config::parse(scenario.settings, "test").map_err(|e| e.to_string())?;
    config.steps = 1000;
    Ok(config)
}

fn points() -> InitialPoints {
    let rng = &mut Pcg64Mcg::seed_from_u64(31);
    let mut points = InitialPoints::default();
    while points.positions.len() < GAUSSIANS {
        let p = Vec3::from_array(std::array::from_fn(|_| uniform(rng, -0.8, 0.8)));
        if (0.3..0.8).contains(&p.length()) {
            points.positions.push(p);
            points.normals.push(p.normalize());
        }
    }
    points
}

/// A medium inside a sphere.
pub fn medium() -> Medium {
    let transport = Transport::Profile {
        widths: vec![0.2, 0.5],
        weights: vec![[0.3, 0.2, 0.1], [0.4, 0.1, 0.2]],
        local: [0.2, 0.3, 0.4],
    };
    Medium { unit: 1.0, transport, coat: Coat { roughness: 0.3, scale: 1.0 }, quality: None, described: None }
}

/// An engine before the first step.
fn engine(scenario: &Scenario) -> Result<CpuEngine, String> {
    let config = config(scenario)?;
    let model = Model::initial(&config, scene(), &points()).map_err(|e| e.to_string())?;
    let falloff = model.scene.falloff(&config);
    let facts = CaptureFacts { views: 3, ..CaptureFacts::default() };
    let mut engine = CpuEngine::with_needs(model, Needs::decide(&config, &facts)).with_views(3);
    if scenario.medium {
        let surface = Surface::new(Mesh::icosphere(Vec3::ZERO, 0.8, 3), 300).map_err(|e| e.to_string())?;
        let p = points();
        let term = MediumTerm::new(surface, medium(), falloff, &p.positions, &p.normals).map_err(|e| e.to_string())?;
        engine.adopt_medium(term).map_err(|e| e.to_string())?;
    }
    Ok(engine)
}

/// Other values than those that a model begins with: materials that are all the same leave the signs of differences to chance.
fn mix(state: &mut TensorFile, growth: f32) {
    let rng = &mut Pcg64Mcg::seed_from_u64(32);
    for (name, (_, values)) in &mut state.tensors {
        let (low, high) = match name.as_str() {
            "gaussians.opacity" => (0.0, 3.0),
            "gaussians.scale" => (growth - 0.4, growth + 0.3),
            "gaussians.rotation" | "gaussians.codes" => (-1.0, 1.0),
            "gaussians.normal" => (-0.3, 0.3),
            "gaussians.base_color" | "gaussians.roughness" | "gaussians.subsurfaceness" => (-1.5, 1.5),
            "gaussians.metalness" => (-1.0, 2.0),
            "gaussians.visibility_sh" | "gaussians.transfer" => (-0.2, 0.2),
            name if name.starts_with("network.") && !name.ends_with("moment") => (-0.1, 0.1),
            _ => continue,
        };
        values.iter_mut().for_each(|v| *v += uniform(rng, low, high));
    }
}

/// The model of a scenario before the step.
pub fn model(scenario: &Scenario) -> Result<Model, String> {
    let text = |e: diamond_reconstruct::ReconstructError| e.to_string();
    let mut engine = engine(scenario)?;
    let mut state = engine.state().map_err(text)?;
    mix(&mut state, scenario.growth);
    engine.restore(Path::new("test"), state).map_err(text)?;
    Ok(engine.model().map_err(text)?.clone())
}

/// What is learned from.
pub struct Shots {
    pub cameras: Vec<Camera>,
    pub lights: Vec<OlatLight>,
    pub photographs: Vec<Image>,
    pub masks: Vec<Option<Mask>>,
    /// Of the last image of several how much is believed.
    pub believed: Image,
}

pub fn shots(n: usize) -> Shots {
    let rng = &mut Pcg64Mcg::seed_from_u64(33);
    let [width, height] = SIZE;
    let believed = Image::from_vec(width, height, 1, (0..width * height).map(|_| uniform(rng, 0.0, 1.0)).collect());
    let believed = believed.expect("a weight for each pixel");
    let mut out =
        Shots { cameras: Vec::new(), lights: Vec::new(), photographs: Vec::new(), masks: Vec::new(), believed };
    for k in 0..n {
        let intrinsics =
            Intrinsics { fx: 48.0, fy: 46.0, cx: 22.1, cy: 18.7, width: width as u32, height: height as u32 };
        let eye = Vec3::new(0.4 - k as f32, -0.5, -2.9);
        out.cameras.push(Camera { intrinsics, pose: Pose::look_at(eye, Vec3::ZERO, Vec3::Y) });
        out.lights.push(match k {
            0 => OlatLight::Point { position: Vec3::new(1.0, -1.5, -2.0), intensity: Vec3::new(1.0, 1.1, 0.9) },
            _ => OlatLight::Directional { direction: Vec3::new(0.0, -0.6, -0.8), irradiance: Vec3::new(0.8, 1.0, 1.2) },
        });
        let (mut picture, mut mask) = (Image::new(width, height, 3), vec![0.0; width * height]);
        for y in 0..height {
            for x in 0..width {
                let r = ((x as f32 - 22.0).powi(2) + (y as f32 - 18.0).powi(2)).sqrt();
                let inside = ((15.0 - r) * 0.5).clamp(0.0, 1.0);
                mask[y * width + x] = inside;
                for c in 0..3 {
                    let wave = 0.4 + 0.3 * libm::sinf(0.35 * x as f32 + c as f32) * libm::cosf(0.3 * y as f32);
                    picture.pixel_mut(x, y)[c] = inside * (wave + uniform(rng, -0.05, 0.05));
                }
            }
        }
        out.photographs.push(picture);
        out.masks.push((k != 1).then(|| Mask::from_vec(width, height, mask).expect("a mask of the picture's size")));
    }
    out
}

impl Shots {
    pub fn pairs(&self) -> Vec<TrainingPair<'_>> {
        (0..self.cameras.len())
            .map(|k| TrainingPair {
                camera: &self.cameras[k],
                light: &self.lights[k],
                radiance: &self.photographs[k],
                mask: self.masks[k].as_ref(),
                weight: if k == 0 { 1.0 } else { 0.7 },
                believed: (k == 2).then_some(&self.believed),
                content: None,
                view: k,
                image: if k == 2 { usize::MAX } else { k },
                neighbour: None,
                guide: None,
            })
            .collect()
    }
}

/// A step on both sides.
pub struct Stepped {
    pub stepper: Rc<RefCell<DeviceStepper>>,
    pub shots: Shots,
    /// Before the step.
    pub before: Model,
    /// What each side reported and came to: the CPU, the device.
    pub reports: [StepReport; 2],
    pub states: [TensorFile; 2],
}

/// Makes a step of a scenario on both sides.
pub fn step(device: &Arc<Device>, scenario: &Scenario) -> Result<Stepped, String> {
    let text = |e: diamond_reconstruct::ReconstructError| e.to_string();
    let stepper = DeviceStepper::new(device.clone()).map_err(|e| e.to_string())?;
    let stepper = Rc::new(RefCell::new(stepper));
    let mut engines = [engine(scenario)?, engine(scenario)?];
    let mut state = engines[0].state().map_err(text)?;
    mix(&mut state, scenario.growth);
    let shots = shots(scenario.images);
    let pairs = shots.pairs();
    let config = config(scenario)?;
    let plan = StepPlan::new(&config, scenario.step);
    let shared = Shared { stepper: stepper.clone(), name: "shared".into() };
    let mut before = None;
    let mut done = Vec::new();
    for (side, engine) in engines.iter_mut().enumerate() {
        engine.restore(Path::new("test"), state.clone()).map_err(text)?;
        before = Some(engine.model().map_err(text)?.clone());
        if side == 1
            && let Some(lacking) =
                engine.step_by(Box::new(Shared { stepper: shared.stepper.clone(), name: shared.name.clone() }), &plan)
        {
            return Err(format!("the stepper lacks {lacking}"));
        }
        let report = engine.training_step(scenario.step, &plan, &pairs).map_err(text)?;
        let counters = engine.counters();
        let there = counters.iter().any(|(name, n)| *name == "steps on the device" && *n == 1);
        if there != (side == 1) {
            return Err(format!("side {side}: the step was made elsewhere: {counters:?}"));
        }
        done.push((report, engine.state().map_err(text)?));
    }
    let (gpu, cpu) = (done.pop(), done.pop());
    let (Some(gpu), Some(cpu), Some(before)) = (gpu, cpu, before) else { return Err("no step".into()) };
    drop(pairs);
    Ok(Stepped { stepper, shots, before, reports: [cpu.0, gpu.0], states: [cpu.1, gpu.1] })
}

/// Terms and gradients of a step agree with the CPU's. After the first step the first moment is a tenth of the gradient.
pub fn whole(device: &Arc<Device>, scenario: &Scenario) -> Result<(), String> {
    let Stepped { stepper, reports: [cpu, gpu], states: [a, b], .. } = step(device, scenario)?;
    let counts = stepper.borrow().read(&[Store::Counts]).map_err(|e| e.to_string())?;
    if scenario.growth > 0.0 && counts[0][2].to_bits() as usize <= 4 * GAUSSIANS {
        return Err("the first lists of tiles were long enough".into());
    }
    let names = |r: &StepReport| r.terms.iter().map(|t| t.name).collect::<Vec<_>>();
    if names(&cpu) != names(&gpu) || cpu.visible != gpu.visible {
        return Err(format!(
            "terms {:?} and {:?}, visible {} and {}",
            names(&cpu),
            names(&gpu),
            cpu.visible,
            gpu.visible
        ));
    }
    let mut worst = (0.0f64, "");
    for (x, y) in cpu.terms.iter().zip(&gpu.terms) {
        // Of a term near 0 only so many digits are worth anything.
        let error = f64::from((x.value - y.value).abs()) / f64::from(x.value.abs()).max(1e-2);
        if error > 1e-4 || x.weight != y.weight {
            return Err(format!("term {}: {} × {} and {} × {}", x.name, x.weight, x.value, y.weight, y.value));
        }
        worst = if error > worst.0 { (error, x.name) } else { worst };
    }
    if (cpu.psnr - gpu.psnr).abs() > 1e-3 {
        return Err(format!("PSNR {} and {}", cpu.psnr, gpu.psnr));
    }
    println!("parity: step, {}: terms {:.1e} ({})", scenario.name, worst.0, worst.1);
    let mut text = Vec::new();
    let mut failed = Vec::new();
    for (name, (_, expected)) in &a.tensors {
        let Some((_, found)) = b.tensors.get(name) else { return Err(format!("no tensor {name}")) };
        if name.starts_with("visibility.") || name.starts_with("medium.") || name.starts_with("reference.") {
            continue;
        }
        let error = relative_l2(found, expected);
        // Adam divides by the gradient's size: values say less than moments.
        let allowed = if name.ends_with("moment") || name.starts_with("density.") { 1e-4 } else { 1e-3 };
        if error > allowed {
            failed.push(format!("{name} {error:.1e}"));
        }
        if name.ends_with("first_moment") {
            text.push(format!("{} {error:.1e}", name.trim_end_matches(".first_moment")));
        }
    }
    println!("parity: step, {}: gradients {}", scenario.name, text.join(", "));
    if failed.is_empty() { Ok(()) } else { Err(format!("relative errors: {}", failed.join(", "))) }
}

/// Two runs of a step give the same bits.
pub fn same_bits(device: &Arc<Device>) -> Result<(), String> {
    let runs = [step(device, &MEDIUM)?, step(device, &MEDIUM)?];
    if runs[0].states[1] != runs[1].states[1] || runs[0].reports[1] != runs[1].reports[1] {
        return Err("the second run has other bits".into());
    }
    Ok(())
}

/// Falloff of the scenarios' lights, as the model has it.
pub fn falloff(model: &Model) -> Falloff {
    model.scene.falloff(&model.config)
}
