//! Walks from places that are seen, for every albedo and every lamp: what a fit to photographs reads.
//!
//! Where [`crate::ExitWalks`] keep the surfel at which a walk comes out, and lose the direction in which light enters, these keep how lamps can be
//! connected with the walk exactly:
//!
//! - *index-matched*: some of its scatterings, with the direction in which the walk arrived. A lamp's light comes to a scattering straight, through
//!   e^(−σ_t·length) of medium, and is scattered by the phase function. Scatterings that lie deep, to which little can come, are kept
//!   with a small probability and count the more.
//! - *refracting*: where it meets the surface from inside, and from which direction. Light that enters there goes against the walk, in a direction that
//!   no walk has exactly; a kernel stands in its place that is exact for what is linear in the direction.
//!
//! A walk starts along the given ray, so that radiance is exact for that direction too; or in all directions, for radiosity. After n
//! scatterings a connection brings αⁿ of its light, so radiance is Σ_b α^(n_b)·h_b ([`RadianceMoments`]) with h linear in light and independent
//! of α. A start that is transmitted without a scattering goes on to whatever is behind; unscattered light of lamps is not part of the result.
//!
//! ```
//! use diamond_pathtrace::{Boundary, Geometry, Light, ViewWalkOptions, ViewWalks, WalkStart};
//! use glam::Vec3;
//! let geometry = Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 };
//! let start = WalkStart { position: Vec3::Z, normal: Vec3::Z, direction: Some(Vec3::Z) };
//! let options = ViewWalkOptions { walks: 1000, ..Default::default() };
//! let walks = ViewWalks::trace(&geometry, 10.0, 0.0, Boundary::IndexMatched, &[start], &options, &|_| ())?;
//! let lamps = [Light::directional(Vec3::Z, Vec3::ONE), Light::directional(Vec3::NEG_Z, Vec3::ONE)];
//! let moments = walks.moments(&lamps)?;
//! let radiance = moments.radiance(0.9);
//! assert!(radiance[0] > 0.1 && radiance[1] < 0.1 * radiance[0]);
//! # Ok::<(), diamond_pathtrace::PathtraceError>(())
//! ```
mod connect;
mod entering_kernel;
mod record;

use crate::bulk::points::SurfacePoints;
use crate::bulk::refracting::Cone;
use crate::error::check;
use crate::exit_walks::moments::Bins;
use crate::medium::MAX_MEAN_COSINE;
use crate::{Boundary, Geometry, PathtraceError};
use glam::Vec3;
use rayon::prelude::*;
use record::{Connection, Recorder};
use std::sync::atomic::{AtomicUsize, Ordering};

/// How walks are made. Time goes with `walks`, noise with one over its root.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewWalkOptions {
    /// Walks from each start, 1 … 2²⁰.
    pub walks: u32,
    /// Scatterings after which a walk is cut off, 1 … 65 535.
    pub max_events: u32,
    /// Expected connections of a scattering to which all light could come, above 0 and at most 1. Index-matched only.
    pub connections: f32,
    /// Width of each lamp's map in texels, 0 … 2048; 0 traces every shadow ray. Index-matched meshes only.
    pub visibility: u32,
    /// Places at which light enters, about, 16 … 10⁶. Refracting boundaries only.
    pub entrances: u32,
    /// Walks of different seeds are independent.
    pub seed: u64,
}

impl Default for ViewWalkOptions {
    fn default() -> Self {
        Self { walks: 256, max_events: 65_535, connections: 0.5, visibility: 256, entrances: 6000, seed: 0 }
    }
}

impl ViewWalkOptions {
    /// `Err` where a number is outside its range.
    pub fn validate(&self) -> Result<(), PathtraceError> {
        let whole = |what: &str, value: u32, expected: &'static str, range: std::ops::RangeInclusive<u32>| {
            if range.contains(&value) {
                return Ok(());
            }
            Err(PathtraceError::Value { what: what.into(), expected, found: format!("{value}") })
        };
        whole("walks from each start", self.walks, "1 … 2²⁰", 1..=1 << 20)?;
        whole("events of a walk", self.max_events, "1 … 65 535", 1..=65_535)?;
        whole("width of light maps", self.visibility, "0 … 2048", 0..=2048)?;
        whole("entrances of light", self.entrances, "16 … 10⁶", 16..=1_000_000)?;
        check("connections of a scattering", self.connections, "a number > 0 and ≤ 1", |v| v > 0.0 && v <= 1.0)
    }
}

/// Where walks start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WalkStart {
    /// A place of the surface, world.
    pub position: Vec3,
    /// Outward unit normal there.
    pub normal: Vec3,
    /// Unit direction towards the eye; `None` for the mean over all, cosine-weighted (radiosity over π).
    pub direction: Option<Vec3>,
}

/// Walks of one σ_t, g and boundary, kept as connections of 10 bytes.
#[derive(Debug)]
pub struct ViewWalks<'a> {
    geometry: &'a Geometry,
    sigma_t: f32,
    g: f32,
    options: ViewWalkOptions,
    /// Of a boundary that refracts: what passes it, and the places where light enters.
    entrances: Option<(Box<Cone>, SurfacePoints)>,
    /// Start of each start's connections, and the end of the last's.
    starts: Vec<usize>,
    connections: Vec<Connection>,
    bins: Bins,
    /// Fraction of walks that were cut off.
    cut: f64,
}

/// Radiance L = Σ_b α^(n_b)·h_b of every start under every lamp, for a lamp of colour 1.
#[derive(Debug, Clone, PartialEq)]
pub struct RadianceMoments {
    /// Exponents n_b, ascending: the mean number of scatterings in each bin.
    pub exponents: Vec<f32>,
    /// h: starts × lamps × bins.
    pub values: Vec<f32>,
}

impl RadianceMoments {
    /// L at an albedo 0 … 1: starts × lamps. To be multiplied by the lamp's colour. For starts without a direction radiosity is π·L.
    /// `[eq:view-walks]`
    pub fn radiance(&self, albedo: f32) -> Vec<f32> {
        let powers: Vec<f32> = self.exponents.iter().map(|n| albedo.clamp(0.0, 1.0).powf(*n)).collect();
        let sum = |h: &[f32]| h.iter().zip(&powers).map(|(h, p)| h * p).sum();
        self.values.chunks_exact(powers.len().max(1)).map(sum).collect()
    }
}

impl<'a> ViewWalks<'a> {
    /// Walks from every start through the medium inside `geometry`. `sigma_t` > 0 per scene unit and `g` are those of a gray medium.
    /// `progress` is told the fraction that is done, from any thread. Same bits for any number of threads.
    ///
    /// Errors: invalid numbers, shapes or starts; shapes without end.
    pub fn trace(
        geometry: &'a Geometry,
        sigma_t: f32,
        g: f32,
        boundary: Boundary,
        starts: &[WalkStart],
        options: &ViewWalkOptions,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Result<Self, PathtraceError> {
        options.validate()?;
        geometry.validate()?;
        boundary.validate()?;
        check("sigma_t of walks", sigma_t, "a number > 0 and ≤ 10⁹ (per scene unit)", |v| v > 0.0 && v <= 1e9)?;
        check("g of walks", g, "a number from −0.999 to 0.999", |v| v.abs() <= MAX_MEAN_COSINE)?;
        let unit = |v: Vec3| (v.length_squared() - 1.0).abs() < 1e-3;
        let sound = |s: &WalkStart| s.position.is_finite() && unit(s.normal) && s.direction.is_none_or(unit);
        if let Some(k) = starts.iter().position(|s| !sound(s)) {
            return Err(PathtraceError::Shape {
                what: "starts of walks",
                expected: "finite positions, unit normals and directions".into(),
                found: format!("{:?} at index {k}", starts[k]),
            });
        }
        let (low, high) = geometry.bounds();
        if !(low.is_finite() && high.is_finite()) {
            return Err(PathtraceError::Mesh {
                problem: format!("it reaches from {low} to {high}"),
                advice: "walks towards an eye need an object of finite size",
            });
        }
        let entrances = match Cone::new(boundary) {
            None => None,
            Some(cone) => {
                let points = SurfacePoints::new(geometry, options.entrances as usize, options.seed)?;
                Some((Box::new(cone), points))
            }
        };
        let recorder = Recorder::new(geometry, sigma_t, g, boundary, *options, entrances.as_ref().map(|e| &e.1));
        let done = AtomicUsize::new(0);
        let rows: Vec<(Vec<Connection>, u32)> = starts
            .par_iter()
            .enumerate()
            .with_max_len(8)
            .map(|(k, start)| {
                let row = recorder.walks_from(start, k as u64);
                let n = done.fetch_add(1, Ordering::Relaxed) + 1;
                if n.is_multiple_of(64) || n == starts.len() {
                    progress(n as f32 / starts.len() as f32);
                }
                row
            })
            .collect();
        let mut ends = vec![0];
        let mut connections = Vec::with_capacity(rows.iter().map(|row| row.0.len()).sum());
        let (mut histogram, mut cut) = (Vec::new(), 0.0);
        for (row, truncated) in rows {
            for connection in &row {
                let n = usize::from(connection.scatterings);
                if n >= histogram.len() {
                    histogram.resize(n + 1, 0.0);
                }
                histogram[n] += 1.0;
            }
            connections.extend(row);
            ends.push(connections.len());
            cut += f64::from(truncated);
        }
        cut /= (f64::from(options.walks) * starts.len() as f64).max(1.0);
        let bins = Bins::new(&histogram);
        Ok(Self { geometry, sigma_t, g, options: *options, entrances, starts: ends, connections, bins, cut })
    }

    /// Number of starts.
    pub fn starts(&self) -> usize {
        self.starts.len() - 1
    }

    /// Bytes of memory.
    pub fn bytes(&self) -> usize {
        std::mem::size_of::<Connection>() * self.connections.len() + 8 * self.starts.len()
    }

    /// Most of the light that walks which were cut off could have brought at this albedo, as a fraction: theirs times α^max_events.
    pub fn lost_by_cutting(&self, albedo: f32) -> f64 {
        self.cut * f64::from(albedo.clamp(0.0, 1.0)).powi(self.options.max_events as i32)
    }
}

#[cfg(test)]
mod tests;
