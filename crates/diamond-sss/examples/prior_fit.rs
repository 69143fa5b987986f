//! The physical prior on known or carved geometry: a radial profile and a coat, fitted to a few photographs without any learning.
//!
//!     cargo run --release -p diamond-sss --example prior_fit -- CAPTURE MESH|hull [KEY=VALUE…]
//!
//! `MESH` is an OBJ or PLY file in the capture's frame (`up=y` turns y upward into z upward); `hull` carves the masks of the training views. Keys: `fits` (regimes, comma between: `1x1,3x3,full-one`),
//! `hull` (regime whose masks carve; default all views), `hull_resolution`, `surfels`, `widths`, `narrowest` (in mean distances of surfels), `widest` (in
//! radii of the object), `balance=plain|conserving`, `samples` (per axis of a pixel), `weighting=display|linear`, `entry=full|fresnel`, `exposure` (factor of the photographs, so that
//! reflectances are true ones), `coat=1|0`,
//! `local=1|0` (light that leaves where it enters), `seed`, `out` (folder for pictures: photograph, prior, five times the difference).
//!
//! Unknowns: per channel a weight ≥ 0 for each Gaussian and for local light, and a scale ≥ 0 of a GGX coat (F0 0.04) at three roughnesses. Rows are weighted by the
//! slope of the sRGB curve between photograph and prediction, three rounds. PSNR as `diamond evaluate` computes it, mean over images.
use diamond_camera::Camera;
use diamond_dataset::{Capture, OpenOptions, Regime, Shot, View, to_display};
use diamond_image::{Image, Transfer};
use diamond_light::{Falloff, OlatLight};
use diamond_metrics::psnr;
use diamond_pathtrace::{Facing, Geometry, Mesh, NO_PRIMITIVE, RepairOptions, polygonise, read_obj, read_ply};
use diamond_shading::{
    Balance, BrdfModel, Entry, Material, NormalEquations, NormalizedDiffusion, RadialProfile, SolveOptions,
    SurfelLighting, SurfelTransport, Surfels,
};
use diamond_sss::encode_png_rgb;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

type Failure = Box<dyn std::error::Error>;

/// Roughnesses at which the coat is offered.
const COATS: [f32; 3] = [0.2, 0.35, 0.6];

struct Settings(BTreeMap<String, String>);

impl Settings {
    fn number(&self, key: &str, default: f32) -> Result<f32, Failure> {
        self.0.get(key).map_or(Ok(default), |text| text.parse().map_err(|_| format!("{key}={text}: no number").into()))
    }

    fn text(&self, key: &str, default: &str) -> String {
        self.0.get(key).cloned().unwrap_or_else(|| default.to_owned())
    }
}

/// The outline's signed distance, in scene units at the point's depth, of the view that is farthest outside.
fn hull(capture: &Capture, resolution: u32) -> Result<Mesh, Failure> {
    let mut views = Vec::new();
    for view in &capture.train {
        let observation = capture.observation(&view.shots[0])?;
        let mask = observation.mask.as_ref().ok_or(format!("{}: no mask", view.name))?;
        views.push((view.camera, mask.outline_distance()));
    }
    let scene = capture.scene();
    // All cameras see all of the ball that they frame, and nobody carves what is beyond.
    let reach = Vec3::splat(scene.framed_radius);
    let distance = |p: Vec3| {
        let beyond = p.distance(scene.centre) - scene.framed_radius;
        views.iter().fold(beyond, |most, (camera, outline)| {
            let Some((pixel, z)) = camera.project(p) else { return most };
            let size = Vec2::new(outline.width() as f32, outline.height() as f32);
            if !(pixel.cmpge(Vec2::ZERO).all() && pixel.cmple(size).all()) {
                return most;
            }
            let mut d = [0.0];
            outline.sample(pixel.x, pixel.y, &mut d);
            most.max(d[0] * z / camera.intrinsics.fx)
        })
    };
    // A coarse one first, to know where the grid should be.
    let (low, high) = polygonise(distance, scene.centre - reach, scene.centre + reach, 48)?.bounds();
    let margin = Vec3::splat(reach.x / 24.0);
    Ok(polygonise(distance, low - margin, high + margin, resolution)?.with_smooth_normals())
}

/// What is needed to predict images: geometry, transport, and settings.
struct Prior {
    geometry: Geometry,
    transport: SurfelTransport,
    normals: Vec<Vec3>,
    falloff: Falloff,
    entry: Entry,
    samples: u32,
    coats: usize,
    local: bool,
    exposure: f32,
}

/// One image: for each pixel that shows the object its features, and the photograph.
struct Features {
    pixels: Vec<usize>,
    /// pixels × (widths + local + coats): radiance per unit of each unknown under white light.
    values: Vec<f32>,
    intensity: Vec3,
    radiance: Image,
    display: Vec<u8>,
    name: String,
}

impl Prior {
    fn shared(&self) -> usize {
        self.transport.widths().len() + usize::from(self.local)
    }

    fn columns(&self) -> usize {
        self.shared() + self.coats
    }

    fn unknowns(&self) -> usize {
        3 * self.shared() + self.coats
    }

    fn visibility(&self, positions: &[Vec3], normals: &[Vec3], lights: &[OlatLight]) -> Vec<f32> {
        let each = positions.par_iter().zip(normals).flat_map_iter(|(p, n)| {
            lights.iter().map(move |light| {
                let arriving = light.incidence(*p, self.falloff);
                let faces = n.dot(arriving.direction) > 0.0;
                let from = *p + *n * 1e-4;
                let hidden =
                    || self.geometry.occluded(from, arriving.direction, arriving.distance, Facing::Any, NO_PRIMITIVE);
                f32::from(u8::from(faces && !hidden()))
            })
        });
        each.collect()
    }

    /// Scalar irradiance under lights of unit intensity: positions × lights.
    fn irradiance(&self, positions: &[Vec3], normals: &[Vec3], lights: &[OlatLight]) -> Result<Vec<f32>, Failure> {
        let visibility = self.visibility(positions, normals, lights);
        let lighting = SurfelLighting {
            positions,
            normals,
            visibility: &visibility,
            lights,
            falloff: self.falloff,
            entry: self.entry,
        };
        Ok(lighting.irradiance()?.into_iter().step_by(3).collect())
    }

    /// Features of some shots of a view.
    fn features(&self, capture: &Capture, view: &View, shots: &[&Shot]) -> Result<Vec<Features>, Failure> {
        let lights: Vec<OlatLight> = shots.iter().map(|s| s.light.of_unit_intensity()).collect();
        let samples = seen(&self.geometry, &view.camera, self.samples);
        let positions: Vec<Vec3> = samples.iter().map(|s| s.position).collect();
        let normals: Vec<Vec3> = samples.iter().map(|s| s.normal).collect();
        let surfels = &self.transport.surfels().positions;
        let entering = self.irradiance(surfels, &self.normals, &lights)?;
        let basis = self.transport.receivers(&positions)?.basis(&entering)?;
        let visibility = self.visibility(&positions, &normals, &lights);
        let here = self.irradiance(&positions, &normals, &lights)?;
        let mut pixels: Vec<usize> = samples.iter().map(|s| s.pixel).collect();
        pixels.dedup();
        let (l, width) = (lights.len(), self.columns());
        let share = 1.0 / (self.samples * self.samples) as f32;
        let mut out = Vec::new();
        for (i, shot) in shots.iter().enumerate() {
            let mut values = vec![0.0f32; pixels.len() * width];
            let mut row = 0;
            for (n, sample) in samples.iter().enumerate() {
                row += usize::from(pixels[row] != sample.pixel);
                let to = &mut values[row * width..(row + 1) * width];
                let exit = share / std::f32::consts::PI;
                basis.iter().enumerate().for_each(|(k, b)| to[k] += exit * b[n * l + i]);
                if self.local {
                    to[basis.len()] += exit * here[n * l + i];
                }
                let arriving = lights[i].incidence(sample.position, self.falloff);
                let lit = arriving.irradiance * visibility[n * l + i];
                for (k, roughness) in COATS.iter().take(self.coats).enumerate() {
                    let coat = Material { base_color: Vec3::ZERO, roughness: *roughness, metalness: 0.0 };
                    let towards = -sample.direction;
                    let light = BrdfModel::default().reflect(&coat, sample.shading, towards, arriving.direction, lit);
                    to[self.shared() + k] += share * light.x;
                }
            }
            let observation = capture.observation(shot)?;
            out.push(Features {
                pixels: pixels.clone(),
                values,
                intensity: shot.light.intensity() * self.exposure,
                radiance: observation.radiance.clone(),
                display: observation.display.clone(),
                name: shot.name.clone(),
            });
        }
        Ok(out)
    }

    /// Radiance of one channel from a row of features.
    fn predict(&self, row: &[f32], x: &[f64], c: usize) -> f64 {
        let s = self.shared();
        let each = row.iter().enumerate();
        each.map(|(k, v)| f64::from(*v) * if k < s { x[c * s + k] } else { x[2 * s + k] }).sum()
    }

    fn accumulate(&self, equations: &mut NormalEquations, image: &Features, x: Option<&[f64]>, display: bool) {
        let (s, width) = (self.shared(), self.columns());
        let mut row = vec![0.0; self.unknowns()];
        for (pixel, values) in image.pixels.iter().zip(image.values.chunks_exact(width)) {
            for c in 0..3 {
                let b = image.radiance.data()[3 * pixel + c];
                // Film that is full says only that there was at least as much.
                if b >= 1.0 {
                    continue;
                }
                row.fill(0.0);
                for (k, v) in values.iter().enumerate() {
                    row[if k < s { c * s + k } else { 2 * s + k }] = f64::from(*v * image.intensity[c]);
                }
                let guess = x.map_or(b, |x| (self.predict(values, x, c) as f32 * image.intensity[c]).clamp(0.0, 1.0));
                let slope = if display { slope(b, guess) } else { 1.0 };
                equations.add(&row, f64::from(b), f64::from(slope * slope));
            }
        }
    }

    fn picture(&self, image: &Features, x: &[f64]) -> Image {
        let mut out = Image::new(image.radiance.width(), image.radiance.height(), 3);
        for (pixel, row) in image.pixels.iter().zip(image.values.chunks_exact(self.columns())) {
            for c in 0..3 {
                out.data_mut()[3 * pixel + c] = self.predict(row, x, c) as f32 * image.intensity[c];
            }
        }
        out
    }
}

/// Slope of the sRGB curve between two values.
fn slope(a: f32, b: f32) -> f32 {
    if (a - b).abs() < 1e-3 {
        return Transfer::Srgb.encode_pull(0.5 * (a + b), 1.0);
    }
    (Transfer::Srgb.encode(a) - Transfer::Srgb.encode(b)) / (a - b)
}

/// A place that a camera ray meets.
struct Sample {
    pixel: usize,
    position: Vec3,
    normal: Vec3,
    shading: Vec3,
    direction: Vec3,
}

fn seen(geometry: &Geometry, camera: &Camera, per_axis: u32) -> Vec<Sample> {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let rays = 0..(width * height * per_axis * per_axis) as usize;
    let each = rays.into_par_iter().filter_map(|i| {
        let (pixel, k) = (i as u32 / (per_axis * per_axis), i as u32 % (per_axis * per_axis));
        let offset = (Vec2::new((k % per_axis) as f32, (k / per_axis) as f32) + 0.5) / per_axis as f32;
        let ray = camera.ray(Vec2::new((pixel % width) as f32, (pixel / width) as f32) + offset);
        let hit = geometry.closest_hit(ray.origin, ray.direction, f32::INFINITY, Facing::Entering, NO_PRIMITIVE)?;
        let shading = geometry.shading_normal(&hit);
        let (position, normal) = (hit.position, hit.normal);
        Some(Sample { pixel: pixel as usize, position, normal, shading, direction: ray.direction })
    });
    each.collect()
}

/// Mean PSNR under seen and unseen lights; NaN where there are none.
fn score(prior: &Prior, test: &[(Features, OlatLight)], fitted: &Capture, x: &[f64]) -> Result<[f64; 2], Failure> {
    let (mut sums, mut counts) = ([0.0; 2], [0usize; 2]);
    for (image, light) in test {
        let bytes = |b: &[u8]| b.iter().map(|b| f32::from(*b) / 255.0).collect::<Vec<f32>>();
        let (w, h) = (image.radiance.width(), image.radiance.height());
        let render = Image::from_vec(w, h, 3, bytes(&to_display(&prior.picture(image, x))))?;
        let truth = Image::from_vec(w, h, 3, bytes(&image.display))?;
        let k = usize::from(!fitted.is_seen_light(light));
        sums[k] += psnr(&render, &truth, 1.0)?;
        counts[k] += 1;
    }
    Ok([sums[0] / counts[0] as f64, sums[1] / counts[1] as f64])
}

/// The two-parameter profile that fits the same equations best, the rest as in `x`: a search in albedo and mean free path per channel.
fn physical(prior: &Prior, equations: &NormalEquations, x: &[f64]) -> Result<(Vec<f64>, NormalizedDiffusion), Failure> {
    let (s, widths) = (prior.shared(), prior.transport.widths());
    let mut best = x.to_vec();
    let mut found = NormalizedDiffusion { albedo: Vec3::ZERO, mean_free_path: Vec3::ONE };
    for c in 0..3 {
        let mut at = (f64::INFINITY, 0.0, 0.0);
        let (mut low, mut high) = ([0.02f32, (0.3 * widths[0]).ln()], [1.0f32, widths[widths.len() - 1].ln()]);
        for _ in 0..4 {
            for i in 0..=12 {
                for j in 0..=12 {
                    let a = low[0] + (high[0] - low[0]) * i as f32 / 12.0;
                    let l = (low[1] + (high[1] - low[1]) * j as f32 / 12.0).exp();
                    let one = NormalizedDiffusion { albedo: Vec3::splat(a), mean_free_path: Vec3::splat(l) };
                    let profile = one.on_widths(widths)?;
                    let mut trial = best.clone();
                    trial[c * s..(c + 1) * s].fill(0.0);
                    profile.weights.iter().enumerate().for_each(|(k, w)| trial[c * s + k] = f64::from(w.x));
                    let error = equations.error(&trial);
                    if error < at.0 {
                        at = (error, a, l);
                    }
                }
            }
            let half = [0.17 * (high[0] - low[0]), 0.17 * (high[1] - low[1])];
            low = [(at.1 - half[0]).max(0.01), at.2.ln() - half[1]];
            high = [(at.1 + half[0]).min(1.0), at.2.ln() + half[1]];
        }
        found.albedo[c] = at.1;
        found.mean_free_path[c] = at.2;
        let one = NormalizedDiffusion { albedo: Vec3::splat(at.1), mean_free_path: Vec3::splat(at.2) };
        best[c * s..(c + 1) * s].fill(0.0);
        one.on_widths(widths)?.weights.iter().enumerate().for_each(|(k, w)| best[c * s + k] = f64::from(w.x));
    }
    Ok((best, found))
}

fn strip(prior: &Prior, image: &Features, x: &[f64]) -> Result<Vec<u8>, Failure> {
    let (w, h) = (image.radiance.width(), image.radiance.height());
    let render = to_display(&prior.picture(image, x));
    let mut out = Vec::with_capacity(9 * w * h);
    for y in 0..h {
        let row = 3 * w * y..3 * w * (y + 1);
        let (truth, ours) = (&image.display[row.clone()], &render[row]);
        let error =
            truth.iter().zip(ours).map(|(t, o)| (128 + 5 * (i32::from(*o) - i32::from(*t))).clamp(0, 255) as u8);
        out.extend(truth.iter().copied().chain(ours.iter().copied()).chain(error));
    }
    Ok(encode_png_rgb(&out, 3 * w, h)?)
}

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [folder, shape, rest @ ..] = arguments.as_slice() else {
        return Err("usage: prior_fit CAPTURE MESH|hull [KEY=VALUE…]".into());
    };
    let pairs = rest.iter().map(|a| a.split_once('=').ok_or(format!("{a}: write KEY=VALUE")));
    let pairs = pairs.map(|p| p.map(|(k, v)| (k.to_owned(), v.to_owned()))).collect::<Result<_, _>>()?;
    let settings = Settings(pairs);
    let seed = settings.number("seed", 0.0)? as u64;
    let capture = Capture::open(folder.as_ref(), &OpenOptions::default())?;
    let start = Instant::now();
    let mesh = match shape.as_str() {
        "hull" => {
            let carved = settings.text("hull", "full-full").parse::<Regime>()?.apply(&capture, seed)?;
            hull(&carved, settings.number("hull_resolution", 96.0)? as u32)?
        }
        file if file.ends_with(".ply") => read_ply(Path::new(file))?,
        file => read_obj(Path::new(file))?,
    };
    let mut mesh = mesh;
    if settings.text("up", "z") == "y" {
        mesh.positions.iter_mut().for_each(|p| *p = Vec3::new(p.x, -p.z, p.y));
        mesh.normals = None;
    }
    let (mesh, _) = mesh.repair(&RepairOptions::default())?;
    let mesh = if mesh.normals.is_some() { mesh } else { mesh.with_smooth_normals() };
    let area: f32 = mesh.patches(f32::MAX)?.iter().map(|p| p.area).sum();
    let patches = mesh.patches(area / settings.number("surfels", 20_000.0)?)?;
    let (low, high) = mesh.bounds();
    let radius = 0.5 * (high - low).max_element();
    println!("{} triangles, {} surfels, {:.2} s", mesh.triangles.len(), patches.len(), start.elapsed().as_secs_f32());
    let spacing = (area / patches.len() as f32).sqrt();
    let widths = RadialProfile::geometric_widths(
        settings.number("narrowest", 1.0)? * spacing,
        settings.number("widest", 1.0)? * radius,
        settings.number("widths", 14.0)? as usize,
    );
    let balance = match settings.text("balance", "plain").as_str() {
        "conserving" => Balance::Conserving,
        _ => Balance::Plain,
    };
    let surfels = Surfels {
        positions: patches.iter().map(|p| p.position).collect(),
        areas: patches.iter().map(|p| p.area).collect(),
    };
    let start = Instant::now();
    let transport = SurfelTransport::new(surfels, widths, balance)?;
    println!("transport prepared: {:.3} s", start.elapsed().as_secs_f32());
    let first = capture.train[0].shots[0].light;
    let reference = match first {
        OlatLight::Point { position, .. } => position.distance(capture.scene().centre),
        OlatLight::Directional { .. } => 1.0,
    };
    let prior = Prior {
        geometry: Geometry::from_mesh(mesh)?,
        transport,
        normals: patches.iter().map(|p| p.normal).collect(),
        falloff: Falloff::InverseSquare { reference },
        entry: if settings.text("entry", "full") == "fresnel" { Entry::Fresnel { f0: 0.04 } } else { Entry::Full },
        samples: settings.number("samples", 2.0)? as u32,
        coats: if settings.number("coat", 1.0)? > 0.0 { COATS.len() } else { 0 },
        local: settings.number("local", 1.0)? > 0.0,
        exposure: settings.number("exposure", 1.0)?,
    };
    let start = Instant::now();
    let mut test = Vec::new();
    for view in &capture.test {
        let shots: Vec<&Shot> = view.shots.iter().collect();
        let features = prior.features(&capture, view, &shots)?;
        test.extend(features.into_iter().zip(shots.iter().map(|s| s.light)));
    }
    println!("{} test images: {:.2} s", test.len(), start.elapsed().as_secs_f32());
    let (mut both, mut any) = (0usize, 0usize);
    for (image, _) in &test {
        let shown = |pixel: usize| image.display[3 * pixel..3 * pixel + 3].iter().any(|v| *v > 8);
        let inside = image.pixels.iter().filter(|p| shown(**p)).count();
        both += inside;
        any += image.pixels.len() + (0..image.display.len() / 3).filter(|p| shown(*p)).count() - inside;
    }
    println!("lit pixels that the shape explains (intersection over union): {:.3}", both as f64 / any.max(1) as f64);
    for name in settings.text("fits", "1x1,3x3,full-one").split(',') {
        let start = Instant::now();
        let fitted = name.parse::<Regime>()?.apply(&capture, seed)?;
        let mut images = Vec::new();
        for view in &fitted.train {
            images.extend(prior.features(&fitted, view, &view.shots.iter().collect::<Vec<_>>())?);
        }
        let features = start.elapsed().as_secs_f32();
        let display = settings.text("weighting", "display") == "display";
        let (mut x, mut equations) = (None::<Vec<f64>>, NormalEquations::new(prior.unknowns()));
        for _ in 0..if display { 3 } else { 1 } {
            equations = NormalEquations::new(prior.unknowns());
            images.iter().for_each(|image| prior.accumulate(&mut equations, image, x.as_deref(), display));
            x = Some(equations.solve(&SolveOptions { ridge: f64::from(settings.number("ridge", 1e-6)?) }));
        }
        let x = x.unwrap_or_default();
        let [seen, unseen] = score(&prior, &test, &fitted, &x)?;
        println!(
            "{name}: {} images, features {features:.2} s, all {:.2} s\n  free profile     {seen:.2} / {unseen:.2} dB (seen / unseen lights)",
            images.len(),
            start.elapsed().as_secs_f32()
        );
        let s = prior.shared();
        let sum = |c: usize| x[c * s..(c + 1) * s].iter().sum::<f64>();
        println!("  reflectance {:.3} {:.3} {:.3}, coat {:.3?}", sum(0), sum(1), sum(2), &x[3 * s..]);
        for c in 0..3 {
            println!("  weights {:.4?}", &x[c * s..(c + 1) * s]);
        }
        let (two, parameters) = physical(&prior, &equations, &x)?;
        let [seen, unseen] = score(&prior, &test, &fitted, &two)?;
        println!("  two parameters   {seen:.2} / {unseen:.2} dB, {parameters:.3?}");
        if let Some(out) = settings.0.get("out") {
            std::fs::create_dir_all(out)?;
            for (image, _) in test.iter().step_by(7).take(10) {
                std::fs::write(format!("{out}/{name}_{}.png", image.name), strip(&prior, image, &x)?)?;
            }
        }
    }
    Ok(())
}
