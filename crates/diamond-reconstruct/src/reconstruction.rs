//! The run: which pair comes next, when to checkpoint, how to resume.
use crate::augmentation::{MadePicture, MadePictures};
use crate::exposure;
use crate::guided::GuidedSource;
use crate::pairs::PairOrder;
use crate::photometric;
use crate::random::{Purpose, Random};
use crate::region::Region;
use crate::scene::{self, InitialPoints};
use crate::tensor_file::TensorFile;
use crate::turns::{Turn, Turns};
use crate::{
    Blender, CaptureFacts, Config, CpuEngine, Engine, Exposure, FirstExposure, Guide, Model, Needs, Neighbour,
    ReconstructError, Rendering, Scene, StepPlan, StepReport, Stepper, TrainingPair,
};
use diamond_augment::{Frame, Source};
use diamond_camera::Camera;
use diamond_consistency::nearest_views;
use diamond_dataset::{Capture, Observation};
use diamond_light::OlatLight;
use diamond_photometric::PhotometricStereo;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A reconstruction in progress.
pub struct Reconstruction {
    capture: Capture,
    config: Config,
    engine: Box<dyn Engine>,
    needs: Needs,
    facts: CaptureFacts,
    pairs: Vec<(usize, usize)>,
    /// What of each pair's photograph and mask is not empty, once it was looked at.
    contents: Vec<Option<Option<Region>>>,
    order: PairOrder,
    /// Photometric stereo of each training view, where something asks for it.
    stereo: Vec<Option<PhotometricStereo>>,
    /// Of each training view the nearest others, where views are compared.
    neighbours: Vec<Vec<usize>>,
    /// Pictures that nobody took.
    made: MadePictures,
    step: u64,
    /// The step before which a medium was last fitted.
    medium_fitted: Option<u64>,
    /// What is to be told since it was last asked.
    notes: Vec<String>,
    /// Where the first Gaussians came from, for the log.
    pub initial_origin: String,
}

/// Name of the checkpoint's file inside its folder.
const STATE_FILE: &str = "state.safetensors";

impl Reconstruction {
    /// Surveys the capture (its selected training part) and makes the model before the first step.
    ///
    /// The capture is hashed, if it has not been: from here on a file of it that changes is an error of the step that
    /// meets it, and of [`Reconstruction::resume`].
    pub fn new(capture: Capture, config: &Config) -> Result<Self, ReconstructError> {
        capture.hash()?;
        let (scene, points) = scene::survey(&capture, config)?;
        Self::from_points(capture, config, scene, &points, None)
    }

    /// As [`Reconstruction::new`] but with given decisions on what is computed, for instance
    /// [`Needs::everything`], which leaves nothing out.
    pub fn with_needs(capture: Capture, config: &Config, needs: Needs) -> Result<Self, ReconstructError> {
        let (scene, points) = scene::survey(&capture, config)?;
        Self::from_points(capture, config, scene, &points, Some(needs))
    }

    fn from_points(
        capture: Capture,
        config: &Config,
        scene: Scene,
        points: &InitialPoints,
        needs: Option<Needs>,
    ) -> Result<Self, ReconstructError> {
        let facts = CaptureFacts::of(&capture)?;
        let needs = needs.unwrap_or_else(|| Needs::decide(config, &facts));
        let guide = &config.photometric;
        let keeps = guide.supervise > 0.0 && needs.guided_normal.needed || guide.depth && needs.guided_depth.needed;
        // A resumed run has no points here.
        let starts = guide.initial && needs.guided_start.needed && !points.positions.is_empty();
        let mut stereo = match keeps || starts {
            true => photometric::estimates(&capture, &scene, config)?,
            false => Vec::new(),
        };
        let mut points = points.clone();
        if starts {
            let turned = photometric::turn_normals(&mut points, &capture, &stereo, &scene);
            points.origin += &format!("; {turned} normals by photometric stereo");
        }
        if !keeps {
            stereo = Vec::new();
        }
        let points = &points;
        let mut model = Model::initial(config, scene, points)?;
        model.exposure = Exposure::new(config, &capture);
        // A resumed run has no points here, and its light unit in the checkpoint.
        if config.exposure.first == FirstExposure::Mean && !model.is_empty() {
            exposure::match_mean(&mut model, &capture)?;
        }
        let pairs: Vec<(usize, usize)> =
            capture.train.iter().enumerate().flat_map(|(v, view)| (0..view.shots.len()).map(move |s| (v, s))).collect();
        if pairs.is_empty() {
            return Err(ReconstructError::Unusable {
                detail: "the selection holds no image; choose at least one view and one light".into(),
            });
        }
        let order = PairOrder::new(config.seed, pairs.len());
        let neighbours = match needs.silhouette_consistency.needed || needs.depth_consistency.needed {
            true => {
                let cameras: Vec<Camera> = capture.train.iter().map(|v| v.camera).collect();
                nearest_views(&cameras, model.scene.centre(), config.consistency.neighbours)
            }
            false => Vec::new(),
        };
        Ok(Self {
            capture,
            config: config.clone(),
            engine: Box::new(CpuEngine::with_needs(model, needs.clone()).with_views(facts.views)),
            needs,
            facts,
            contents: vec![None; pairs.len()],
            pairs,
            order,
            stereo,
            neighbours,
            made: MadePictures::default(),
            medium_fitted: None,
            step: 0,
            notes: Vec::new(),
            initial_origin: points.origin.clone(),
        })
    }

    /// From now on training pictures are blended by `blender`.
    pub fn blend_by(&mut self, blender: Box<dyn Blender>) {
        self.engine.blend_by(blender);
    }

    /// From now on `stepper` makes the training steps that it can make; the others are made as before. What of the next step it cannot do, as far as that is
    /// known without its images, in words of the configuration.
    pub fn step_by(&mut self, stepper: Box<dyn Stepper>) -> Option<String> {
        self.engine.step_by(stepper, &StepPlan::new(&self.config, self.step))
    }

    /// Continues from the checkpoint in `folder`, bit for bit as if the run had not been interrupted. The configuration
    /// and the capture must be the ones that it was made with.
    pub fn resume(capture: Capture, config: &Config, folder: &Path) -> Result<Self, ReconstructError> {
        let path = folder.join(STATE_FILE);
        let mut file = TensorFile::read(&path)?;
        let fail = |detail: String| ReconstructError::Checkpoint { path: path.clone(), detail };
        let then: String = file.metadata_value(&path, "config")?;
        let same = |then: Config| then.deciding() == config.deciding();
        if !Config::parse(&then, "checkpoint").is_ok_and(same) {
            return Err(fail(
                "it was made with another configuration; resume with the same options, or start anew in another folder"
                    .into(),
            ));
        }
        let then: String = file.metadata_value(&path, "selection")?;
        if then != selection_of(&capture) {
            return Err(fail(
                "it was made with other images; resume with the same capture, --views and --lights".into(),
            ));
        }
        let then: String = file.metadata_value(&path, "capture_files")?;
        if let Some(change) = change_of(&capture, &then)? {
            return Err(fail(format!(
                "the capture has changed since: {change}; put it back as it was, or start anew with the capture as it is"
            )));
        }
        let scene: Scene = toml::from_str(&file.metadata_value::<String>(&path, "scene")?)
            .map_err(|e| fail(format!("metadata `scene`: {}", crate::error::brief(e))))?;
        let step: u64 = file.metadata_value(&path, "step")?;
        let origin: String = file.metadata_value(&path, "initial_origin")?;
        let points = InitialPoints { origin, ..Default::default() };
        let mut run = Self::from_points(capture, config, scene, &points, None)?;
        run.made.restore(&path, &mut file, config.subsurface.surfels)?;
        run.engine.restore(&path, file)?;
        run.step = step;
        Ok(run)
    }

    /// Whether `folder` holds a checkpoint.
    pub fn has_checkpoint(folder: &Path) -> bool {
        folder.join(STATE_FILE).is_file()
    }

    /// Writes a checkpoint into `folder`, replacing the one before only once the new one is whole on disk.
    pub fn save_checkpoint(&mut self, folder: &Path) -> Result<PathBuf, ReconstructError> {
        std::fs::create_dir_all(folder).map_err(|source| ReconstructError::Io {
            path: folder.to_owned(),
            action: "create the folder",
            source,
        })?;
        let mut file = self.engine.state()?;
        let scene = toml::to_string(&self.engine.model()?.scene)
            .map_err(|e| ReconstructError::Config { origin: "scene".into(), detail: e.to_string() })?;
        file.metadata.insert("scene".into(), scene);
        file.metadata.insert("step".into(), self.step.to_string());
        file.metadata.insert("config".into(), self.config.to_toml()?);
        file.metadata.insert("selection".into(), selection_of(&self.capture));
        file.metadata.insert("capture_files".into(), files_of(&self.capture)?);
        file.metadata.insert("initial_origin".into(), self.initial_origin.clone());
        self.made.store(&mut file)?;
        let path = folder.join(STATE_FILE);
        file.write(&path)?;
        Ok(path)
    }

    /// Steps done so far.
    pub fn steps_done(&self) -> u64 {
        self.step
    }

    /// Whether all steps are done.
    pub fn finished(&self) -> bool {
        self.step >= self.config.steps
    }

    /// Whether a checkpoint is due now.
    pub fn checkpoint_due(&self) -> bool {
        self.step > 0 && self.step.is_multiple_of(self.config.checkpoint_steps)
    }

    /// What has happened since this was last asked that a user wants to know: which medium was fitted and how well.
    pub fn take_notes(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notes)
    }

    /// With another source of pictures that nobody took, beside the prior where the configuration names it: to be told before the first step, and
    /// again after [`Reconstruction::resume`]. How many are made and what they count says `[augmentation]`.
    pub fn with_source(mut self, source: Box<dyn Source>) -> Self {
        self.made.sources.push(source);
        self
    }

    /// With what makes the relighter that `augmentation.source = "diffusion"` and `"both"` ask for; to be told as [`Reconstruction::with_source`].
    pub fn with_relighter(mut self, relighter: Box<dyn GuidedSource>) -> Self {
        self.made.relighter = Some(relighter);
        self
    }

    /// Keeps pictures that nobody took in a folder, and reads them from there at each use; in memory unless told otherwise. To be told before they are
    /// made. Results do not depend on it.
    pub fn keep_pictures_in(&mut self, folder: &Path) {
        self.made.folder = Some(folder.to_owned());
    }

    /// Whether the next step begins with making pictures that nobody took.
    pub fn pictures_due(&self) -> bool {
        !self.made.are_made() && self.made.wanted(&self.config) && self.turns().begun(self.position())
    }

    /// Makes the pictures that are due, if they are; the next step would do it otherwise. `progress` is told how many are done, of how many, for each source.
    pub fn make_pictures(&mut self, progress: &mut dyn FnMut(usize, usize)) -> Result<(), ReconstructError> {
        if !self.pictures_due() {
            return Ok(());
        }
        self.fit_due_medium()?;
        let notes = self.made.make(self.engine.model()?, &self.capture, progress)?;
        self.notes.extend(notes);
        Ok(())
    }

    /// Pictures that nobody took, as far as they have been made.
    pub fn made_pictures(&self) -> &[Frame] {
        self.made.frames()
    }

    /// Place of the next step's first image in the run's sequence of images.
    fn position(&self) -> u64 {
        self.step * u64::from(self.config.accumulate)
    }

    /// Whose turn it is, with the pictures that have been made.
    fn turns(&self) -> Turns {
        let c = &self.config;
        Turns::new(&c.augmentation, c.steps, c.accumulate, self.pairs.len(), self.made.count())
    }

    /// Fits the medium that is due before the next step, unless that was done.
    fn fit_due_medium(&mut self) -> Result<(), ReconstructError> {
        let plan = StepPlan::new(&self.config, self.step);
        if !plan.fit_medium || self.medium_fitted == Some(self.step) {
            return Ok(());
        }
        self.medium_fitted = Some(self.step);
        match crate::fit_medium(self.engine.model()?, &self.capture) {
            Ok(medium) => {
                self.notes.extend(medium.describe());
                self.engine.adopt_medium(medium)
            }
            // Without a surface or a fit the run goes on as it is.
            Err(ReconstructError::Unusable { detail }) => {
                self.notes.push(format!("no medium was fitted at step {}: {detail}", self.step));
                Ok(())
            }
            Err(other) => Err(other),
        }
    }

    /// The configuration.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The capture.
    pub fn capture(&self) -> &Capture {
        &self.capture
    }

    /// The number of (view, light) pairs that it learns from.
    pub fn pair_count(&self) -> usize {
        self.pairs.len()
    }

    /// The model as it stands.
    pub fn model(&mut self) -> Result<&Model, ReconstructError> {
        self.engine.model()
    }

    /// Renders one camera under each light.
    pub fn render(&mut self, camera: &Camera, lights: &[OlatLight]) -> Result<Vec<Rendering>, ReconstructError> {
        self.engine.render(camera, lights)
    }

    /// Seconds spent in each part of the steps so far.
    pub fn profile(&self) -> Vec<(&'static str, f64)> {
        self.engine.profile()
    }

    /// How much work the steps so far were, and would have been without leaving anything out.
    pub fn counters(&self) -> Vec<(&'static str, u64)> {
        self.engine.counters()
    }

    /// What is computed and what is not, and why.
    pub fn needs(&self) -> &Needs {
        &self.needs
    }

    /// What is known of the capture.
    pub fn facts(&self) -> &CaptureFacts {
        &self.facts
    }

    /// One training step.
    pub fn step(&mut self) -> Result<StepReport, ReconstructError> {
        self.fit_due_medium()?;
        self.make_pictures(&mut |_, _| ())?;
        let photographs = self.engine.model()?.medium.is_some().then_some(self.pairs.len());
        let plan = StepPlan::of(&self.config, self.step, photographs);
        let turns = self.turns();
        let batch = self.config.accumulate as u64;
        let mut loaded: Vec<Image> = Vec::with_capacity(batch as usize);
        for k in 0..batch {
            let n = match turns.at(self.step * batch + k) {
                Turn::Photograph(n) => n,
                Turn::Made(n) => {
                    loaded.push(Image::Made(Box::new(self.made.at(n)?)));
                    continue;
                }
            };
            let pair = self.order.at(n);
            let (v, s) = self.pairs[pair];
            let observation = self.capture.observation(&self.capture.train[v].shots[s])?;
            let look = || Region::of_photograph(&observation.radiance, observation.mask.as_ref());
            let content = *self.contents[pair].get_or_insert_with(look);
            let neighbour = match self.neighbours.get(v) {
                Some(others) if plan.consistency > 0.0 && !others.is_empty() => {
                    let mut random = Random::new(self.config.seed, Purpose::Consistency, self.step * batch + k);
                    Some((others[random.below(others.len())], random.below(usize::MAX) as u64))
                }
                _ => None,
            };
            let photograph = Photograph { view: v, shot: s, image: pair, content, observation, neighbour };
            loaded.push(Image::Photograph(photograph));
        }
        let step = self.step;
        let Self { capture, config, needs, stereo, engine, .. } = &mut *self;
        let known = Known { capture, config, needs, stereo };
        let pairs: Vec<TrainingPair<'_>> = loaded
            .iter()
            .map(|image| match image {
                Image::Photograph(photograph) => known.pair(photograph, &plan),
                Image::Made(picture) => TrainingPair {
                    camera: &picture.frame.target.camera,
                    light: &picture.frame.target.light,
                    radiance: &picture.pixels.radiance,
                    mask: picture.pixels.mask.as_ref(),
                    weight: known.config.augmentation.weight,
                    believed: Some(&picture.pixels.confidence),
                    content: picture.content,
                    view: picture.frame.target.photograph.0,
                    image: usize::MAX,
                    neighbour: None,
                    guide: None,
                },
            })
            .collect();
        let report = engine.training_step(step, &plan, &pairs)?;
        self.notes.extend(self.engine.take_notes());
        self.step += 1;
        Ok(report)
    }
}

/// What a run knows of its photographs.
struct Known<'a> {
    capture: &'a Capture,
    config: &'a Config,
    needs: &'a Needs,
    stereo: &'a [Option<PhotometricStereo>],
}

impl Known<'_> {
    /// A photograph as the engine sees it.
    fn pair<'a>(&'a self, photograph: &'a Photograph, plan: &StepPlan) -> TrainingPair<'a> {
        let view = &self.capture.train[photograph.view];
        let shot = &view.shots[photograph.shot];
        TrainingPair {
            camera: &view.camera,
            light: &shot.light,
            radiance: &photograph.observation.radiance,
            mask: photograph.observation.mask.as_ref(),
            weight: shot.weight,
            believed: None,
            content: photograph.content,
            view: photograph.view,
            image: photograph.image,
            guide: self.stereo.get(photograph.view).and_then(Option::as_ref).map(|stereo| Guide {
                stereo,
                weight: match self.needs.guided_normal.needed {
                    true => self.config.photometric.supervise * plan.photometric,
                    false => 0.0,
                },
                depth: self.needs.guided_depth.needed && self.config.photometric.depth,
            }),
            neighbour: photograph
                .neighbour
                .map(|(other, seed)| Neighbour { camera: &self.capture.train[other].camera, seed }),
        }
    }
}

/// An image of a step's batch.
enum Image {
    Photograph(Photograph),
    Made(Box<MadePicture>),
}

/// A photograph of a step's batch.
struct Photograph {
    view: usize,
    /// Within the view.
    shot: usize,
    /// Among all images.
    image: usize,
    /// The part of it that is not empty.
    content: Option<Region>,
    observation: Arc<Observation>,
    /// Another view, and a seed.
    neighbour: Option<(usize, u64)>,
}

/// The images that a run learns from, as text.
fn selection_of(capture: &Capture) -> String {
    let names: Vec<&str> = capture.train.iter().flat_map(|v| &v.shots).map(|s| s.name.as_str()).collect();
    names.join(" ")
}

/// The files of the capture, as text: a line each, of a hash and the name.
fn files_of(capture: &Capture) -> Result<String, ReconstructError> {
    let lines: Vec<String> = capture.files()?.iter().map(|f| format!("{} {}", f.short(), f.name)).collect();
    Ok(lines.join("\n"))
}

/// The first file that is not what [`files_of`] said then, and what became of it.
fn change_of(capture: &Capture, then: &str) -> Result<Option<String>, ReconstructError> {
    let now = files_of(capture)?;
    if now == then {
        return Ok(None);
    }
    let split = |text: &str| -> BTreeMap<String, String> {
        text.lines().filter_map(|l| l.split_once(' ')).map(|(hash, name)| (name.to_owned(), hash.to_owned())).collect()
    };
    let (then, now) = (split(then), split(&now));
    let named_by = |name: &str| {
        let mut shots = capture.train.iter().chain(&capture.test).flat_map(|v| &v.shots);
        let shot = shots.find(|s| s.path == capture.root.join(name));
        shot.map_or(String::new(), |s| format!(" ({})", s.named_by))
    };
    for (name, hash) in &then {
        match now.get(name) {
            None => return Ok(Some(format!("{name} is no longer part of it"))),
            Some(other) if other != hash => return Ok(Some(format!("{name}{} has other content", named_by(name)))),
            Some(_) => {}
        }
    }
    let added = now.keys().find(|name| !then.contains_key(*name));
    Ok(Some(added.map_or("the order of its files".into(), |name| format!("{name}{} was added", named_by(name)))))
}
