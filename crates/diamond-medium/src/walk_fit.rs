//! A medium of random walks from photographs: a search over σ_t, and closed forms inside.
//!
//! Walks of one σ_t serve every albedo ([`ExitWalks::moments`]), and the mean cosine of scattering enters nearly by similarity alone, so it is 0 here and what is
//! found is the reduced σ_t and albedo. For each σ_t of a coarse list, each of two boundaries, and each albedo of a list, the error is a quadratic in a
//! gain that all channels share (photographs seldom say what a full scale of radiance is); the smallest over all of them is refined once in σ_t. The coat
//! is that of the profile, which is fitted first.
use crate::fit::{Columns, Evidence, FitOptions, fit_profile_and_coats, irradiance, lights_of, normals_of, slope};
use crate::medium::{Medium, Transport};
use crate::{FitPhotograph, MediumError, Surface};
use diamond_light::{Falloff, OlatLight};
use diamond_pathtrace::{Boundary, ExitWalkOptions, ExitWalks};
use rayon::prelude::*;

/// Extinctions that are tried, per radius of the object.
const SIGMA_T: [f32; 6] = [2.5, 5.0, 10.0, 20.0, 40.0, 80.0];
/// Indices of refraction that are tried.
const IORS: [f32; 2] = [1.0, 1.5];
/// Factors on the best extinction that are tried next.
const REFINED: [f32; 2] = [0.707, 1.414];
/// Absorptions 1 − α that are tried: from the first, each half an octave below the one before.
const MOST_ABSORPTION: f32 = 0.7;
const ABSORPTIONS: usize = 24;
/// Gains that are tried: from the first, each so many times the one before.
const LEAST_GAIN: f32 = 0.3;
const GAIN_STEP: f32 = 1.1;
const GAINS: usize = 26;
/// Walks from each surfel while searching.
const SEARCH_WALKS: u32 = 48;
/// Scatterings after which a walk is cut off while searching.
const SEARCH_EVENTS: u32 = 4000;

/// The boundary of an index of refraction.
pub(crate) fn boundary(ior: f32) -> Boundary {
    if ior == 1.0 { Boundary::IndexMatched } else { Boundary::Smooth { eta: ior } }
}

/// Outer cosines of surfels toward lights, 0 where the light is behind: surfels × lights.
pub(crate) fn cosines(surface: &Surface, lights: &[OlatLight]) -> Vec<f32> {
    let each = surface
        .patches()
        .iter()
        .flat_map(|p| lights.iter().map(|l| p.normal.dot(l.incidence(p.position, Falloff::None).direction).max(0.0)));
    each.collect()
}

fn albedo(step: usize) -> f32 {
    1.0 - MOST_ABSORPTION * libm::exp2f(-0.5 * step as f32)
}

/// Errors of one σ_t and boundary: for each channel and albedo the coefficients of e0 − 2·e1·gain + e2·gain².
struct Candidate {
    sigma_t: f32,
    ior: f32,
    sums: Vec<[f64; 2]>,
}

/// Fits a medium of random walks and a coat to photographs.
pub fn fit_walk(surface: &Surface, photographs: &[FitPhotograph], options: &FitOptions) -> Result<Medium, MediumError> {
    let (profile, coats) = fit_profile_and_coats(surface, photographs, options)?;
    let (lights, index) = lights_of(photographs);
    let entering = irradiance(surface, surface.positions(), &normals_of(surface), &lights, options.falloff)?;
    let cosines = cosines(surface, &lights);
    let radius = surface.radius();
    let look = |sigma_t: f32, ior: f32| -> Result<(Candidate, ExitWalks), MediumError> {
        let search = ExitWalkOptions { walks: SEARCH_WALKS, max_events: SEARCH_EVENTS, seed: 1 };
        let walks =
            ExitWalks::trace(surface.geometry(), sigma_t, 0.0, boundary(ior), surface.patches(), &search, &|_| ())?;
        let sums = sums_of(photographs, options.unit, &walks, &coats, (&lights, &index), (&entering, &cosines))?;
        Ok((Candidate { sigma_t, ior, sums }, walks))
    };
    let mut tried = Vec::new();
    for ior in IORS {
        for sigma in SIGMA_T {
            tried.push(look(sigma / radius, ior)?.0);
        }
    }
    let (gain, best) = choose(&tried);
    let ior = tried[best[0].0].ior;
    tried.retain(|t| t.ior == ior);
    let mut more: Vec<f32> = Vec::new();
    let (_, best_of_ior) = choose(&tried);
    for (k, _) in best_of_ior {
        for factor in REFINED {
            let sigma = tried[k].sigma_t * factor;
            if !more.iter().chain(tried.iter().map(|t| &t.sigma_t)).any(|s| (s / sigma - 1.0).abs() < 0.1) {
                more.push(sigma);
            }
        }
    }
    for sigma in more {
        tried.push(look(sigma, ior)?.0);
    }
    let _ = gain;
    let (gain, best) = choose(&tried);
    let sigma_t = best.map(|(k, _)| tried[k].sigma_t);
    let transport = Transport::Walk { sigma_t, albedo: best.map(|(_, a)| albedo(a)), g: 0.0, ior, gain: [gain; 3] };
    Ok(Medium { transport, quality: None, described: profile.described, ..profile })
}

/// The gain of least error, and for each channel the candidate and the number of the albedo.
fn choose(tried: &[Candidate]) -> (f32, [(usize, usize); 3]) {
    let mut best = (f64::INFINITY, 1.0, [(0, 0); 3]);
    for ior in IORS {
        for step in 0..GAINS {
            let gain = f64::from(LEAST_GAIN * libm::powf(GAIN_STEP, step as f32));
            let (mut total, mut places) = (0.0, [(0, 0); 3]);
            for (c, place) in places.iter_mut().enumerate() {
                let mut least = f64::INFINITY;
                for (k, candidate) in tried.iter().enumerate().filter(|(_, t)| t.ior == ior) {
                    for a in 0..ABSORPTIONS {
                        let [e1, e2] = candidate.sums[c * ABSORPTIONS + a];
                        let error = gain * (e2 * gain - 2.0 * e1);
                        if error < least {
                            (least, *place) = (error, (k, a));
                        }
                    }
                }
                total += least;
            }
            if total < best.0 {
                best = (total, gain as f32, places);
            }
        }
    }
    (best.1, best.2)
}

/// Σ w·r·v and Σ w·v² for each channel and albedo, with what is seen r, what is predicted v, and the weight of the displayed difference w.
fn sums_of(
    photographs: &[FitPhotograph],
    unit: f32,
    walks: &ExitWalks,
    coats: &[f32],
    (lights, index): (&[OlatLight], &[usize]),
    (entering, cosines): (&[f32], &[f32]),
) -> Result<Vec<[f64; 2]>, MediumError> {
    let moments = walks.moments(entering, cosines)?;
    let bins = moments.exponents.len();
    let exit = |mu: f32| moments.exit_factors(mu);
    let columns = Columns { count: bins, values: &moments.values, exit: &exit };
    let evidence = Evidence::new(photographs, &columns, index, lights.len(), unit)?;
    let powers: Vec<Vec<f32>> =
        (0..ABSORPTIONS).map(|a| moments.exponents.iter().map(|n| libm::powf(albedo(a), *n)).collect()).collect();
    let parts: Vec<Vec<[f64; 2]>> = evidence
        .rows
        .par_iter()
        .map(|rows| {
            let mut sums = vec![[0.0f64; 2]; 3 * ABSORPTIONS];
            for (n, pixel) in rows.photograph.pixels.iter().enumerate() {
                let row = &rows.values[n * evidence.width()..(n + 1) * evidence.width()];
                let coat: f32 = row[evidence.shared..].iter().zip(coats).map(|(v, s)| v * s).sum();
                let grey: Vec<f32> =
                    powers.iter().map(|p| row[..bins].iter().zip(p).map(|(v, p)| v * p).sum()).collect();
                for c in 0..3 {
                    let (tint, known, b) = (pixel.tint[c], pixel.known[c], pixel.radiance[c]);
                    if b >= crate::fit::FULL {
                        continue;
                    }
                    let rest = b - known - rows.intensity[c] * coat;
                    let weight = f64::from(slope(b, b)).powi(2);
                    for (a, v) in grey.iter().enumerate() {
                        let v = f64::from(tint * rows.intensity[c] * v);
                        let sum = &mut sums[c * ABSORPTIONS + a];
                        sum[0] += weight * f64::from(rest) * v;
                        sum[1] += weight * v * v;
                    }
                }
            }
            sums
        })
        .collect();
    let mut all = vec![[0.0f64; 2]; 3 * ABSORPTIONS];
    for part in parts {
        all.iter_mut().zip(part).for_each(|(a, p)| (0..2).for_each(|k| a[k] += p[k]));
    }
    Ok(all)
}
