//! Pictures of a whole rig of lights at once: transport is solved once for the object, and each view is then cheap.
//!
//! [`Bulk::solve`] lets walks from points of the surface gather the light of all lamps, in a form that depends on which boundary the object has:
//!
//! - *index-matched*: what is scattered twice or more leaves the object as a smooth function of place and direction, divided by the
//!   fraction that the visible stretch scatters at all. Pictures add what is scattered once, from look-ups in a map of each light.
//! - *refracting*: all light under the surface, linear in the inner direction; pictures send it through the boundary.
//!
//! [`Bulk::render`] makes the pictures of all lamps from one camera: places between points by moving least squares, a coat and
//! the outer reflection of a rough boundary with their shadows by rays. [`measure_bulk`] says how far that is from [`crate::render_reference`].
//!
//! It is a model: places are a spacing apart, directions a few functions. The errors are smooth and are measured, not bounded.
//! Results have the same bits for any number of threads.
//!
//! ```
//! use diamond_camera::{Camera, Intrinsics, Pose};
//! use diamond_pathtrace::{Bulk, BulkOptions, Geometry, Light, Material, Medium, Scene};
//! use glam::Vec3;
//! let scene = Scene {
//!     geometry: Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 },
//!     material: Material::index_matched(Medium::gray(8.0, 0.9, 0.0)),
//!     lights: vec![Light::directional(Vec3::Z, Vec3::ONE), Light::directional(Vec3::X, Vec3::ONE)],
//! };
//! let bulk = Bulk::solve(&scene, &BulkOptions { points: 50, walks: 16, ..Default::default() }, &|_| ())?;
//! let pose = Pose::look_at(Vec3::new(0.0, 0.0, 4.0), Vec3::ZERO, Vec3::Y);
//! let view = bulk.render(&Camera { intrinsics: Intrinsics::from_fov_x(0.6, 8, 8), pose }, 0)?;
//! assert!(view.lights[0].pixel(4, 4)[0] > view.lights[1].pixel(4, 4)[0]);
//! # Ok::<(), diamond_pathtrace::PathtraceError>(())
//! ```
pub(crate) mod directions;
pub(crate) mod lamps;
pub(crate) mod light_map;
mod matched;
mod measure;
pub(crate) mod points;
pub(crate) mod refracting;
mod render;

pub use measure::{BulkError, ReferencePair, measure_bulk, reference_pairs};
pub use render::BulkView;

use crate::error::check;
use crate::{Frame, PathtraceError, Scene};
use lamps::Lamps;
use light_map::LightMaps;
use matched::MatchedWalks;
use points::SurfacePoints;
use rayon::prelude::*;
use refracting::{Cone, RefractingWalks};
use std::sync::atomic::{AtomicUsize, Ordering};

/// How a bulk solution is made. Time goes with `points · walks`, noise with one over its root.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BulkOptions {
    /// Points on the surface, about; 16 … 10⁶.
    pub points: u32,
    /// Walks from each point, 1 … 2²⁰.
    pub walks: u32,
    /// Width of each light's map in texels, 0 … 2048; 0 traces every shadow ray. Index-matched meshes only.
    pub visibility: u32,
    /// Expected connections of a scattering from which all light could come, > 0; deeper ones get less. Index-matched only.
    pub connections: f32,
    /// Camera rays per pixel are the square of this, 1 … 64.
    pub samples_per_axis: u32,
    /// Solutions of different seeds are independent.
    pub seed: u64,
    /// Scatterings after which a walk is cut off.
    pub max_events: u32,
}

impl Default for BulkOptions {
    fn default() -> Self {
        Self {
            points: 3000,
            walks: 16384,
            visibility: 256,
            connections: 0.3,
            samples_per_axis: 4,
            seed: 0,
            max_events: 10_000_000,
        }
    }
}

impl BulkOptions {
    /// `Err` where a number is outside its range.
    pub fn validate(&self) -> Result<(), PathtraceError> {
        let whole = |what: &'static str, value: u32, expected: &'static str, range: std::ops::RangeInclusive<u32>| {
            if range.contains(&value) {
                return Ok(());
            }
            Err(PathtraceError::Value { what: what.into(), expected, found: format!("{value}") })
        };
        whole("points of a bulk solution", self.points, "16 … 10⁶", 16..=1_000_000)?;
        whole("walks of a bulk solution", self.walks, "1 … 2²⁰", 1..=1 << 20)?;
        whole("width of light maps", self.visibility, "0 … 2048", 0..=2048)?;
        whole("samples per axis of a pixel", self.samples_per_axis, "1 … 64", 1..=64)?;
        whole("events of a walk", self.max_events, "at least 1", 1..=u32::MAX)?;
        check("connections of a scattering", self.connections, "a number > 0", |v| v > 0.0)
    }
}

/// In which form light is stored.
#[derive(Debug)]
enum Stored {
    /// See [`matched`].
    Scattered,
    /// See [`refracting`].
    UnderSurface(Box<Cone>),
}

/// Light transport of a scene, solved for all its lamps.
#[derive(Debug)]
pub struct Bulk<'a> {
    scene: &'a Scene,
    options: BulkOptions,
    lamps: Lamps,
    maps: LightMaps<'a>,
    points: SurfacePoints,
    stored: Stored,
    /// For each point, each function of the direction, each channel, each light.
    coefficients: Vec<f32>,
}

impl<'a> Bulk<'a> {
    /// Solves for the light that leaves the object. `progress` is told the fraction that is done, from any thread.
    ///
    /// Errors: invalid scenes or options; lamps that are neither points nor directions, or stand inside the object; shapes without
    /// end.
    pub fn solve(
        scene: &'a Scene,
        options: &BulkOptions,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Result<Self, PathtraceError> {
        options.validate()?;
        scene.geometry.validate()?;
        scene.material.validate()?;
        scene.lights.iter().try_for_each(crate::Light::validate)?;
        let lamps = Lamps::new(&scene.lights)?;
        lamps.check_outside(&scene.geometry)?;
        let points = SurfacePoints::new(&scene.geometry, options.points as usize, options.seed)?;
        let cone = Cone::new(scene.material.boundary);
        let side = if cone.is_some() { 0 } else { options.visibility };
        let maps = LightMaps::new(&scene.geometry, &lamps, side);
        let (geometry, medium, options) = (&scene.geometry, scene.material.medium, *options);
        let done = AtomicUsize::new(0);
        let total = points.points().len();
        let told = |row: Vec<f32>| {
            let n = done.fetch_add(1, Ordering::Relaxed) + 1;
            if n.is_multiple_of(64) || n == total {
                progress(n as f32 / total as f32);
            }
            row
        };
        let each = points.points().par_iter().enumerate().with_max_len(4);
        let rows: Vec<Vec<f32>> = match &cone {
            None => {
                let walks = MatchedWalks { geometry, medium, lamps: &lamps, maps: &maps, options };
                each.map(|(k, point)| told(walks.gather(point, k))).collect()
            }
            Some(cone) => {
                let walks = RefractingWalks::new(geometry, medium, &lamps, &points, cone, options);
                each.map(|(k, point)| told(walks.gather(point, k))).collect()
            }
        };
        let coefficients = match cone {
            None => smoothed::<{ directions::HEMISPHERE }>(&points, rows),
            Some(_) => smoothed::<{ directions::CONE }>(&points, rows),
        };
        let stored = cone.map_or(Stored::Scattered, |cone| Stored::UnderSurface(Box::new(cone)));
        Ok(Self { scene, options, lamps, maps, points, stored, coefficients })
    }

    /// Number of points on the surface.
    pub fn points(&self) -> usize {
        self.points.points().len()
    }

    /// Distance between neighbouring points, scene units.
    pub fn spacing(&self) -> f32 {
        self.points.spacing
    }

    /// Bytes of memory of the solution.
    pub fn bytes(&self) -> usize {
        4 * self.coefficients.len() + self.maps.bytes()
    }

    /// Which form was chosen, and why.
    pub fn form(&self) -> &'static str {
        match self.stored {
            Stored::Scattered => {
                "index-matched: multiple scattering from the surface points, single scattering for each picture (its direction is \
                 not smooth)"
            }
            Stored::UnderSurface(_) => "refracting: all light under the surface, linear over the cone that is seen",
        }
    }
}

/// How often the dependence on direction is averaged with that of the points around.
const ROUNDS: usize = 2;

/// The coefficients in one list. Their mean over directions is left as it is; how they depend on direction varies less from place to place,
/// and is averaged over the neighbourhood: a coarser grid for what is noisier.
fn smoothed<const N: usize>(points: &SurfacePoints, mut rows: Vec<Vec<f32>>) -> Vec<f32> {
    for _ in 0..ROUNDS {
        rows = (0..rows.len())
            .into_par_iter()
            .map(|k| {
                let width = rows[k].len() / N;
                let to = Frame::new(points.points()[k].smooth_normal);
                let mut row = vec![0.0f32; N * width];
                row[..width].copy_from_slice(&rows[k][..width]);
                for (j, weight) in points.neighbours(k) {
                    let from = Frame::new(points.points()[j as usize].smooth_normal);
                    let matrix = directions::turned::<N>(from, to);
                    for a in 1..N {
                        for b in 1..N {
                            let w = weight * matrix[a][b];
                            if w != 0.0 {
                                let source = &rows[j as usize][b * width..(b + 1) * width];
                                row[a * width..(a + 1) * width].iter_mut().zip(source).for_each(|(r, s)| *r += w * s);
                            }
                        }
                    }
                }
                row
            })
            .collect();
    }
    rows.concat()
}
