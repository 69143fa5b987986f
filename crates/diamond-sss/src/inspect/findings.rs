//! What there is in a capture, measured once for the text and the picture.
use diamond_camera::Intrinsics;
use diamond_dataset::{Capture, Observation, Scene, Shot, Split, View, light_direction};
use diamond_light::OlatLight;
use glam::Vec3;

/// At most so many images are decoded, spread evenly: enough for statistics, a few seconds at 800².
const MAX_EXAMINED: usize = 512;

/// Bins of the exposure histogram, over display values 0 to 255.
pub(super) const BINS: usize = 64;

/// One image in the coverage matrix.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Cell {
    /// There is no such image.
    Missing,
    /// There is one; it was not looked at.
    Present,
    /// It cannot be loaded.
    Broken,
    /// Mean display value of the object in it, `[0, 1]`.
    Level(f32),
}

/// Views × lights of a split.
#[derive(Debug, Default)]
pub(super) struct Matrix {
    pub(super) columns: usize,
    pub(super) rows: Vec<Vec<Cell>>,
}

impl Matrix {
    /// How many of the cells hold an image, and how many cells there are.
    pub(super) fn filled(&self) -> (usize, usize) {
        let cells = self.rows.iter().flatten();
        (cells.clone().filter(|c| **c != Cell::Missing).count(), cells.count())
    }
}

/// Smallest and largest of some values; `None` of none.
pub(super) type Range = Option<(f32, f32)>;

fn range(values: impl IntoIterator<Item = f32>) -> Range {
    values.into_iter().fold(None, |r, v| r.map_or(Some((v, v)), |(a, b): (f32, f32)| Some((a.min(v), b.max(v)))))
}

/// Brightness of the object in the images examined, as display sRGB.
#[derive(Debug)]
pub(super) struct Exposure {
    /// Object pixels by the mean of their three display values.
    pub(super) histogram: [u64; BINS],
    /// Object pixels examined.
    pub(super) pixels: u64,
    /// Of these, pixels with a channel at 255.
    pub(super) clipped: u64,
    /// Of these, pixels with all channels at 2 or below.
    pub(super) black: u64,
}

impl Exposure {
    /// `(clipped, black)` as fractions of the object's pixels.
    pub(super) fn fractions(&self) -> (f64, f64) {
        let n = self.pixels.max(1) as f64;
        (self.clipped as f64 / n, self.black as f64 / n)
    }
}

/// The widest gap between directions: the direction farthest from all of them, and how far it is.
#[derive(Debug, Clone, Copy)]
pub(super) struct Gap {
    /// Degrees from the nearest.
    pub(super) degrees: f32,
    /// Unit direction from the centre of the scene.
    pub(super) direction: Vec3,
}

/// Everything that text and picture say.
pub(super) struct Findings {
    pub(super) scene: Scene,
    /// The world axis that is nearest to the mean of the cameras' up.
    pub(super) up: Vec3,
    /// Largest distance of an optical axis from the centre, scene units.
    pub(super) axis_miss: f32,
    /// Distances of the training cameras from the centre.
    pub(super) camera_distance: Range,
    /// Horizontal fields of view of all cameras, degrees.
    pub(super) fov_x: Range,
    /// Different intrinsics of all views, and how many views have them.
    pub(super) intrinsics: Vec<(Intrinsics, usize)>,
    pub(super) camera_gap: Option<Gap>,
    pub(super) light_gap: Option<Gap>,
    /// Distances of point lights from the centre, training split.
    pub(super) light_distance: Range,
    pub(super) directional_lights: usize,
    /// Whether any light has an intensity other than 1.
    pub(super) intensities_given: bool,
    /// Held-out images under a light that is also in training, and under one that is not.
    pub(super) seen_unseen: (usize, usize),
    pub(super) synthetic: usize,
    pub(super) train: Matrix,
    pub(super) test: Matrix,
    pub(super) exposure: Exposure,
    /// Images examined, and images in all.
    pub(super) examined: (usize, usize),
    /// Examined images that have a mask.
    pub(super) masked: usize,
    /// Mean coverage of the images that have a mask.
    pub(super) coverage: Option<f32>,
    /// What could not be loaded, and why.
    pub(super) failures: Vec<String>,
}

impl Findings {
    pub(super) fn of(capture: &Capture) -> Self {
        let scene = capture.scene();
        let all = || capture.train.iter().chain(&capture.test);
        let train_shots = || capture.train.iter().flat_map(|view| &view.shots);
        let to_camera = |view: &View| view.camera.pose.centre() - scene.centre;
        let mut out = Findings {
            scene,
            up: up_axis(capture),
            axis_miss: capture.train.iter().map(|view| axis_distance(view, scene.centre)).fold(0.0, f32::max),
            camera_distance: range(capture.train.iter().map(|view| to_camera(view).length())),
            fov_x: range(all().map(|view| fov_x_degrees(&view.camera.intrinsics))),
            intrinsics: Vec::new(),
            camera_gap: gap(capture.train.iter().filter_map(|view| to_camera(view).try_normalize())),
            light_gap: gap(train_shots().map(|shot| light_direction(&shot.light, scene.centre))),
            light_distance: range(train_shots().filter_map(|shot| match shot.light {
                OlatLight::Point { position, .. } => Some(position.distance(scene.centre)),
                OlatLight::Directional { .. } => None,
            })),
            directional_lights: train_shots().filter(|s| matches!(s.light, OlatLight::Directional { .. })).count(),
            intensities_given: train_shots().any(|shot| match shot.light {
                OlatLight::Point { intensity: i, .. } | OlatLight::Directional { irradiance: i, .. } => i != Vec3::ONE,
            }),
            seen_unseen: (0, 0),
            synthetic: train_shots().filter(|s| s.provenance != diamond_dataset::Provenance::Photograph).count(),
            train: Matrix::default(),
            test: Matrix::default(),
            exposure: Exposure { histogram: [0; BINS], pixels: 0, clipped: 0, black: 0 },
            examined: (0, all().map(|view| view.shots.len()).sum()),
            masked: 0,
            coverage: None,
            failures: Vec::new(),
        };
        for view in all() {
            let k = view.camera.intrinsics;
            match out.intrinsics.iter_mut().find(|(known, _)| *known == k) {
                Some((_, count)) => *count += 1,
                None => out.intrinsics.push((k, 1)),
            }
        }
        for shot in capture.test.iter().flat_map(|view| &view.shots) {
            match capture.is_seen_light(&shot.light) {
                true => out.seen_unseen.0 += 1,
                false => out.seen_unseen.1 += 1,
            }
        }
        out.examine(capture);
        out
    }

    /// Decodes images and fills matrices, exposure and masks.
    fn examine(&mut self, capture: &Capture) {
        let total = self.examined.1;
        let stride = total.div_ceil(MAX_EXAMINED).max(1);
        let (mut index, mut coverage) = (0, 0.0f64);
        for split in [Split::Train, Split::Test] {
            let rig = capture.shared_rig(split);
            let mut matrix = Matrix { columns: columns(capture.views(split), rig.as_deref()), rows: Vec::new() };
            for view in capture.views(split) {
                let mut row = vec![Cell::Missing; matrix.columns];
                for shot in &view.shots {
                    let cell = match index % stride {
                        0 => match capture.observation(shot) {
                            Ok(observation) => {
                                self.examined.0 += 1;
                                if let Some(mask) = &observation.mask {
                                    self.masked += 1;
                                    coverage += f64::from(mask.area()) / mask.as_image().pixels().max(1) as f64;
                                }
                                Cell::Level(self.exposure.add(&observation))
                            }
                            Err(error) => {
                                self.failures.push(error.to_string());
                                Cell::Broken
                            }
                        },
                        _ => Cell::Present,
                    };
                    if let Some(slot) = row.get_mut(column(shot, rig.as_deref())) {
                        *slot = cell;
                    }
                    index += 1;
                }
                matrix.rows.push(row);
            }
            match split {
                Split::Train => self.train = matrix,
                Split::Test => self.test = matrix,
            }
        }
        self.coverage = (self.masked > 0).then(|| (coverage / self.masked as f64) as f32);
    }
}

impl Exposure {
    /// Counts the object's pixels of an image; returns their mean display value in `[0, 1]`.
    fn add(&mut self, observation: &Observation) -> f32 {
        let (mut sum, mut count) = (0u64, 0u64);
        for (i, rgb) in observation.display.chunks_exact(3).enumerate() {
            if observation.mask.as_ref().is_some_and(|mask| mask.data().get(i).is_none_or(|c| *c <= 0.5)) {
                continue;
            }
            let mean = rgb.iter().map(|&v| u64::from(v)).sum::<u64>() / 3;
            self.histogram[mean as usize * BINS / 256] += 1;
            self.clipped += u64::from(rgb.contains(&255));
            self.black += u64::from(rgb.iter().all(|&v| v <= 2));
            sum += mean;
            count += 1;
        }
        self.pixels += count;
        sum as f32 / (count.max(1) as f32 * 255.0)
    }
}

/// Columns of the matrix: the lights of the rig, or the places in a frame.
fn columns(views: &[View], rig: Option<&[OlatLight]>) -> usize {
    let places = views.iter().flat_map(|view| &view.shots).map(|shot| shot.light_index + 1).max().unwrap_or(0);
    rig.map_or(places, <[OlatLight]>::len)
}

fn column(shot: &Shot, rig: Option<&[OlatLight]>) -> usize {
    let same = |a: &OlatLight, b: &OlatLight| match (a, b) {
        (OlatLight::Point { position: a, .. }, OlatLight::Point { position: b, .. }) => a == b,
        (OlatLight::Directional { direction: a, .. }, OlatLight::Directional { direction: b, .. }) => a == b,
        _ => false,
    };
    rig.and_then(|rig| rig.iter().position(|light| same(light, &shot.light))).unwrap_or(shot.light_index)
}

/// Horizontal field of view, degrees.
pub(super) fn fov_x_degrees(k: &Intrinsics) -> f32 {
    let (left, right) = ((k.cx / k.fx).atan(), ((k.width as f32 - k.cx) / k.fx).atan());
    (left + right).to_degrees()
}

/// Distance of the optical axis of a view from a point.
fn axis_distance(view: &View, point: Vec3) -> f32 {
    let p = view.camera.pose.transform_point(point);
    p.x.hypot(p.y)
}

/// The signed world axis nearest to the mean of the cameras' up.
fn up_axis(capture: &Capture) -> Vec3 {
    let mean: Vec3 = capture.train.iter().chain(&capture.test).map(|view| -view.camera.pose.rotation.row(1)).sum();
    let axes = [Vec3::Z, Vec3::Y, Vec3::X, Vec3::NEG_Z, Vec3::NEG_Y, Vec3::NEG_X];
    axes.into_iter().fold(Vec3::Z, |best, axis| if axis.dot(mean) > best.dot(mean) + 1e-4 { axis } else { best })
}

/// The widest gap between directions; `None` of none.
fn gap(directions: impl Iterator<Item = Vec3>) -> Option<Gap> {
    let mut known: Vec<Vec3> = Vec::new();
    for d in directions {
        if !known.contains(&d) {
            known.push(d);
        }
    }
    // Points of a Fibonacci lattice: about four degrees apart.
    const POINTS: usize = 2000;
    let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
    let lattice = (0..POINTS).map(|i| {
        let z = 1.0 - (2 * i + 1) as f32 / POINTS as f32;
        let (r, a) = ((1.0 - z * z).sqrt(), golden * i as f32);
        Vec3::new(r * a.cos(), r * a.sin(), z)
    });
    let nearest = |d: Vec3| known.iter().map(|k| k.dot(d)).fold(f32::NEG_INFINITY, f32::max);
    let (direction, cosine) =
        lattice.map(|d| (d, nearest(d))).fold((Vec3::Z, 2.0), |best, (d, c)| if c < best.1 { (d, c) } else { best });
    let degrees = cosine.clamp(-1.0, 1.0).acos().to_degrees();
    (!known.is_empty()).then_some(Gap { degrees, direction })
}
