//! Pictures by each level of the physical prior.
use super::scenes::{ALBEDO, Case, Film, LAMPS, SIDE, Truth};
use diamond_pathtrace::{
    Bulk, BulkOptions, ExitWalkOptions, ExitWalks, Geometry, Patch, Scene, ViewWalkOptions, ViewWalks, WalkStart,
};
use diamond_shading::{
    Balance, NormalEquations, NormalizedDiffusion, RadialProfile, SolveOptions, SurfelTransport, Surfels,
};
use glam::Vec3;
use std::f32::consts::FRAC_1_PI;

const LIGHTS: usize = LAMPS.len();
const PIXELS: usize = (SIDE * SIDE) as usize;

/// A picture for each lamp, SIDE² × 3.
pub type Pictures = Vec<Vec<f32>>;

/// Interleaves what was developed per channel as pixels × lamps.
fn pictures(channels: &[Vec<f32>; 3]) -> Pictures {
    let value = |l: usize, i: usize, c: usize| channels[c][i * LIGHTS + l];
    (0..LIGHTS).map(|l| (0..PIXELS).flat_map(|i| (0..3).map(move |c| value(l, i, c))).collect()).collect()
}

/// Level 2 as a matrix from patches to patches, with the true medium.
pub fn operator(case: &Case, film: &Film, walks: u32) -> Result<Pictures, String> {
    let error = |e: diamond_pathtrace::PathtraceError| e.to_string();
    let material = case.scene.material;
    let (sigma_t, g) = (material.medium.sigma_t.x, material.medium.g);
    let options = ExitWalkOptions { walks, ..Default::default() };
    let geometry = &case.scene.geometry;
    let walks = ExitWalks::trace(geometry, sigma_t, g, material.boundary, &case.patches, &options, &|_| ());
    let walks = walks.map_err(error)?;
    let (irradiance, cosines) = case.light();
    let mut channels = [const { Vec::new() }; 3];
    for (c, channel) in channels.iter_mut().enumerate() {
        let operator = walks.collapse(ALBEDO[c]).map_err(error)?;
        let m = operator.radiosity(&irradiance, &cosines).map_err(error)?;
        *channel = film.develop(&m, LIGHTS, |mu| operator.angular.at(mu) * FRAC_1_PI);
    }
    Ok(pictures(&channels))
}

/// Level 2 from the patches, with lamps connected exactly; only the exit is as if directions and places had nothing to do with each other.
pub fn surfels(case: &Case, film: &Film, walks: u32) -> Result<Pictures, String> {
    let error = |e: diamond_pathtrace::PathtraceError| e.to_string();
    let material = case.scene.material;
    let (sigma_t, g, boundary) = (material.medium.sigma_t.x, material.medium.g, material.boundary);
    let start = |p: &Patch| WalkStart { position: p.position, normal: p.normal, direction: None };
    let starts: Vec<WalkStart> = case.patches.iter().map(start).collect();
    let options = ViewWalkOptions { walks, ..Default::default() };
    let geometry = &case.scene.geometry;
    let view = ViewWalks::trace(geometry, sigma_t, g, boundary, &starts, &options, &|_| ()).map_err(error)?;
    let few = ExitWalkOptions { walks: 16, ..Default::default() };
    let exits = ExitWalks::trace(geometry, sigma_t, g, boundary, &case.patches, &few, &|_| ()).map_err(error)?;
    let moments = view.moments(&case.scene.lights).map_err(error)?;
    let mut channels = [const { Vec::new() }; 3];
    for (c, channel) in channels.iter_mut().enumerate() {
        let angular = exits.angular(ALBEDO[c]).map_err(error)?;
        *channel = film.develop(&moments.radiance(ALBEDO[c]), LIGHTS, |mu| 3.0 * angular.at(mu));
    }
    Ok(pictures(&channels))
}

/// Level 2 along the camera's rays, of which each pixel has sixteen: a fraction of the walks for each.
pub fn rays(case: &Case, film: &Film, walks: u32, visibility: u32) -> Result<Pictures, String> {
    let error = |e: diamond_pathtrace::PathtraceError| e.to_string();
    let material = case.scene.material;
    let (starts, pixels) = film.starts();
    let options = ViewWalkOptions { walks: (walks / 4).max(1), visibility, ..Default::default() };
    let (sigma_t, g) = (material.medium.sigma_t.x, material.medium.g);
    let view = ViewWalks::trace(&case.scene.geometry, sigma_t, g, material.boundary, &starts, &options, &|_| ());
    let moments = view.map_err(error)?.moments(&case.scene.lights).map_err(error)?;
    let channels = ALBEDO.to_array().map(|albedo| {
        let mut channel = vec![0.0f32; PIXELS * LIGHTS];
        for (row, (pixel, share)) in moments.radiance(albedo).chunks_exact(LIGHTS).zip(&pixels) {
            channel[pixel * LIGHTS..][..LIGHTS].iter_mut().zip(row).for_each(|(sum, v)| *sum += 3.0 * share * v);
        }
        channel
    });
    Ok(pictures(&channels))
}

/// Reflectance of a half-space of the case's medium and boundary in diffuse light.
fn half_space_reflectance(case: &Case) -> Result<Vec3, String> {
    let geometry = Geometry::Slab { bottom: f32::NEG_INFINITY, top: 0.0 };
    let patch = Patch { position: Vec3::ZERO, normal: Vec3::Z, area: 1.0 };
    let options = ExitWalkOptions { walks: 20_000, max_events: 2000, seed: 9 };
    let (medium, boundary) = (case.scene.material.medium, case.scene.material.boundary);
    let walks = ExitWalks::trace(&geometry, 1.0, medium.g, boundary, &[patch], &options, &|_| ());
    let walks = walks.map_err(|e| e.to_string())?;
    Ok(Vec3::from(ALBEDO.to_array().map(|a| walks.diffuse_albedo(a) as f32)))
}

/// Level 1: which profile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Profile {
    /// Normalised diffusion of the true medium.
    True,
    /// The widths that fit the reference best.
    Fitted,
}

/// Level 1 with so many widths.
pub fn profile(case: &Case, film: &Film, truth: &Truth, which: Profile, widths: usize) -> Result<Pictures, String> {
    let error = |e: diamond_shading::ShadingError| e.to_string();
    let area: f32 = case.patches.iter().map(|p| p.area).sum();
    let surfels = Surfels {
        positions: case.patches.iter().map(|p| p.position).collect(),
        areas: case.patches.iter().map(|p| p.area).collect(),
    };
    let widths = RadialProfile::geometric_widths((area / case.patches.len() as f32).sqrt(), 1.0, widths);
    let positions = surfels.positions.clone();
    let transport = SurfelTransport::new(surfels, widths.clone(), Balance::Plain).map_err(error)?;
    let receivers = transport.receivers(&positions).map_err(error)?;
    let (irradiance, _) = case.light();
    if which == Profile::True {
        let (medium, a) = (case.scene.material.medium, half_space_reflectance(case)?);
        let reduced = medium.sigma_t * (Vec3::ONE - ALBEDO * medium.g);
        let profile =
            NormalizedDiffusion { albedo: a, mean_free_path: reduced.recip() }.on_widths(&widths).map_err(error)?;
        let rgb: Vec<f32> = irradiance.iter().flat_map(|e| [*e; 3]).collect();
        let (m, _) = receivers.exitance(&profile, &rgb).map_err(error)?;
        let picture = film.develop(&m, 3 * LIGHTS, |_| FRAC_1_PI);
        let value =
            |l: usize| picture.chunks_exact(3 * LIGHTS).flat_map(|row| row[3 * l..3 * l + 3].to_vec()).collect();
        return Ok((0..LIGHTS).map(value).collect());
    }
    // One picture of each width, and of light that leaves where it enters.
    let mut basis = receivers.basis(&irradiance).map_err(error)?;
    basis.push(irradiance.clone());
    let features: Vec<Vec<f32>> = basis.iter().map(|m| film.develop(m, LIGHTS, |_| FRAC_1_PI)).collect();
    let mut channels = [const { Vec::new() }; 3];
    for (c, channel) in channels.iter_mut().enumerate() {
        let mut equations = NormalEquations::new(features.len());
        for i in 0..PIXELS {
            for l in 0..LIGHTS {
                let row: Vec<f64> = features.iter().map(|f| f64::from(f[i * LIGHTS + l])).collect();
                equations.add(&row, f64::from(truth.means[l].data()[3 * i + c]), 1.0);
            }
        }
        let x = equations.solve(&SolveOptions::default());
        *channel = vec![0.0; PIXELS * LIGHTS];
        for (feature, w) in features.iter().zip(&x) {
            channel.iter_mut().zip(feature).for_each(|(sum, f)| *sum += *w as f32 * f);
        }
    }
    Ok(pictures(&channels))
}

/// The bulk renderer, without what the boundary reflects on its outer side.
pub fn bulk(case: &Case, walks: u32) -> Result<Pictures, String> {
    let options = BulkOptions { points: 2000, walks, ..Default::default() };
    let render = |scene: &Scene, options: &BulkOptions| -> Result<Pictures, String> {
        let error = |e: diamond_pathtrace::PathtraceError| e.to_string();
        let solved = Bulk::solve(scene, options, &|_| ()).map_err(error)?;
        let view = solved.render(&case.camera, 0).map_err(error)?;
        Ok(view.lights.iter().map(|l| l.data().to_vec()).collect())
    };
    let mut pictures = render(&case.scene, &options)?;
    if case.refracts() {
        let mut black = case.scene.clone();
        black.material.medium.albedo = Vec3::ZERO;
        let surface = render(&black, &options)?;
        for (picture, surface) in pictures.iter_mut().zip(&surface) {
            picture.iter_mut().zip(surface).for_each(|(p, s)| *p -= s);
        }
    }
    Ok(pictures)
}
