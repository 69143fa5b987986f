//! What is held in each moment of a run, part by part.
//!
//! The numbers of bytes per Gaussian, per pixel and per light are sums over the arrays that live then, in the order in
//! which the code makes them; docs/decisions/0021-memory-limit.md compares the sums with measurements. Where the content
//! of the photographs decides, which is not known beforehand, a constant below says what is assumed.
use super::AtOnce;
use diamond_reconstruct::{
    Attribute, CaptureFacts, Config, ExposureMode, IncidentVariant, InitialSource, Layout, Needs, StepPlan,
};
use serde::Serialize;

/// The program, its threads and tables.
const PROGRAM: f64 = 11.0 * MIB;
/// Frames of the capture's files, names and cameras of an image: read, selected and kept.
const PER_IMAGE: f64 = 4096.0;
/// Photographs that are decoded at the same time at the start.
const DECODERS: f64 = 4.0;
/// A photograph from file to radiance, per pixel: its bytes, decoded samples, radiance, mask, display.
const DECODING: f64 = 35.0;
/// A photograph as a step sees it: radiance 12, mask 4, display 3.
const OBSERVATION: f64 = 19.0;
/// The mask of a view, and its sums for the visual hull.
const HULL_MASK: f64 = 8.0;
/// Standard deviation of a Gaussian over the distance of its neighbours.
const OVERLAP: f64 = 1.0;
/// Width of a footprint over its standard deviation.
const FOOTPRINT: f64 = 5.0;
/// The rasteriser's regions, pixels.
const REGION: [f64; 2] = [64.0, 32.0];
/// Threads that the rasteriser's own copies of regions are counted for.
const THREADS: f64 = 8.0;
/// Block lists of the rasteriser, per pixel of the content.
const LISTS: f64 = 12.0;
/// The Gaussians prepared for visibility, and as two lights at once see them.
const LIGHT_GRID: f64 = 330.0;
/// A Gaussian's weights in a block of 4 × 4 pixels.
const KEPT_WEIGHT: f64 = 68.0;
/// The light-independent half of the shader, and opacity and depth, per pixel.
const PREPARED: f64 = 85.0;
/// The objective's pictures, per pixel of the content: encoded pictures, windows, their cotangents.
const OBJECTIVE: f64 = 100.0;
/// Both pictures, SSIM and FLIP (in double precision) of one comparison, per pixel.
const COMPARISON: f64 = 220.0;
/// The page's text over the pictures in it: half as long as PNG, a third longer as text, and three copies while the page is
/// put together.
const PAGE: f64 = 0.5 * 4.0 / 3.0 * 3.0;
/// Arrays beyond this come from the system anew (glibc's largest threshold), and only what is written to counts.
const FRESH: f64 = 32.0 * MIB;
/// Share of what the steps needed and gave back that later parts cannot use again: measured with glibc.
const NOT_REUSED: f64 = 0.4;
/// The rectangle of a render over that of the photograph.
const MARGIN: f64 = 1.2;
/// A surfel with its share of the mesh (some 1.6 triangles), of its tree for rays and of the grid that finds it.
const SURFEL: f64 = 2400.0;
/// More surfels than were asked for, at most (cells of a grid that the surface meets).
const MORE_SURFELS: f64 = 1.25;
/// A Gaussian's surfels and their weights.
const ATTACHED: f64 = 48.0;
/// A cell of the grid from which the surface is taken: its value, its weight, the inside that is flooded.
const CARVED: f64 = 16.0;
/// Points of the surface that the views show, and the tree that finds them.
const SHAPE_POINTS: f64 = 200_000.0 * 56.0;
/// A pixel that a medium is fitted to, beside its columns: what is seen there, its surfels, and while it is found its place.
const FITTED_PIXEL: f64 = 192.0;
/// What the process takes while a surface and a medium are found, over their arrays: measured with glibc (128², 256²).
const FIT_SPREAD: f64 = 1.2;
/// Pixels and photographs that a medium is fitted to, at most.
const FITTED: [f64; 2] = [40_000.0, 64.0];
/// Lights of which what leaves the surfels is kept.
const LEAVING_LIGHTS: f64 = 256.0;
const MIB: f64 = 1048576.0;
/// Lights of which visibility is kept.
const VISIBILITY_LIGHTS: usize = 512;

/// Something that is held.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Part {
    /// What.
    pub name: &'static str,
    /// Bytes.
    pub bytes: u64,
}

/// A moment of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Moment {
    /// Its name in `profile.json`.
    pub name: &'static str,
    /// What is held then, in the order of the run.
    pub parts: Vec<Part>,
}

impl Moment {
    fn new(name: &'static str, parts: &[(&'static str, f64)]) -> Self {
        let part = |&(name, bytes): &(&'static str, f64)| Part { name, bytes: bytes.max(0.0) as u64 };
        Self { name, parts: parts.iter().map(part).filter(|p| p.bytes > 0).collect() }
    }

    /// Bytes of all parts.
    pub fn bytes(&self) -> u64 {
        self.parts.iter().map(|p| p.bytes).sum()
    }
}

/// Slots per Gaussian: regions that its footprint meets, on average, where `n` Gaussians cover `content` pixels, half of
/// them on the side that is seen.
fn slots_per_gaussian(n: f64, content: f64, pixels: f64) -> f64 {
    let side = FOOTPRINT * OVERLAP * (2.0 * content / n.max(1.0)).sqrt();
    let regions = (pixels / (REGION[0] * REGION[1])).ceil();
    ((1.0 + side / REGION[0]) * (1.0 + side / REGION[1])).min(regions.max(1.0))
}

/// (Gaussian, block of 4 × 4 pixels) pairs that are seen, where `n` Gaussians cover `content` pixels, half of them on the
/// side that is seen; measured 1.1 to 1.4 times the blocks of their footprints (4290 Gaussians, 128² to 800²).
fn entries(n: f64, content: f64) -> f64 {
    let side = FOOTPRINT * OVERLAP * (2.0 * content / n.max(1.0)).sqrt();
    1.4 * n * ((side + 4.0) / 4.0).powi(2)
}

/// What is held in each moment of a run with `gaussians` Gaussians.
pub fn moments(
    config: &Config,
    facts: &CaptureFacts,
    needs: &Needs,
    at_once: &AtOnce,
    gaussians: usize,
) -> Vec<Moment> {
    let n = gaussians as f64;
    let of = |condition: bool, value: f64| if condition { value } else { 0.0 };
    let pixels = facts.pixels() as f64;
    let content = (MARGIN * facts.content.unwrap_or(1.0)).clamp(0.05, 1.0) * pixels;
    let residual = &config.residual;
    // Numbers of a Gaussian, and those of them that are learned row by row.
    let layout = Layout::of(config);
    let values: f64 = Attribute::ALL.iter().map(|&a| layout.width(a) as f64).sum();
    let row_values = (residual.codes + residual.transfer_width()) as f64;
    let inputs = of(residual.network, (42 + residual.codes) as f64);
    let first_layer = of(residual.network, residual.hidden.first().map_or(0.0, |&w| w as f64));
    let last = needs.at(&StepPlan::new(config, config.steps.saturating_sub(1)));
    let channels = last.layout.count() as f64;
    let per_light = 4.0 + of(config.shading.incident == IncidentVariant::Learned, 1.0);
    let fixed = 9.0;
    let stride = |channels: f64| ((channels + 1.0) / 16.0).ceil() * 16.0;
    let slots = slots_per_gaussian(n, content, pixels);
    let regions = (pixels / (REGION[0] * REGION[1])).ceil().max(1.0);
    // The share of the picture whose regions hold something, and an array over the whole picture of which that is filled.
    let filled = (MARGIN * content / pixels.max(1.0)).min(1.0);
    let array = |bytes: f64| if bytes > FRESH { filled * bytes } else { bytes };

    let files = facts.files.max(facts.images + facts.test_images) as f64;
    let program = ("program and lists of the capture", PROGRAM + PER_IMAGE * files);
    let photographs = ("photographs", (files * facts.stored_bytes as f64).min(at_once.photographs as f64));
    let decoders = if at_once.decode_in_parallel { DECODERS } else { 1.0 };
    let mut all = vec![Moment::new("opening", &[program, photographs, ("decoding", decoders * DECODING * pixels)])];

    let hull = facts.masks > 0
        && match config.initial.source {
            InitialSource::Auto => !facts.points,
            InitialSource::Hull => true,
            InitialSource::Points | InitialSource::Uniform => false,
        };
    let learned_light = config.shading.incident == IncidentVariant::Learned;
    let bright = of(!learned_light, 1.5 * 4.0 * content * facts.images.min(64) as f64);
    let hull_bytes = HULL_MASK * pixels * facts.views as f64 + (config.initial.hull_resolution as f64).powi(3);
    let survey = [
        program,
        photographs,
        ("one photograph", DECODING * pixels),
        // One after the other.
        ("visual hull and brightness", of(hull, hull_bytes).max(bright)),
    ];
    all.push(Moment::new("first Gaussians", &survey));

    let traced = config.visibility.traced && needs.traced_visibility.needed;
    let gains = match config.exposure.mode {
        ExposureMode::PerImage => 64.0 * facts.images as f64,
        _ => 0.0,
    };
    let parameters = ("Gaussians: values and two moments", n * (12.0 * values + 12.0) + gains);
    let kept_lights = facts.lights.min(VISIBILITY_LIGHTS) as f64;
    let visibility = ("visibility", of(traced, n * (4.0 * kept_lights + 44.0 + LIGHT_GRID)));
    let kept = at_once.buffers as f64;
    // Surface, medium, and what leaves under the lights so far; and while it is fitted, each width's share of it twice.
    let (surface, lights) = (&config.subsurface, facts.lights as f64);
    let surfels = MORE_SURFELS * surface.surfels as f64;
    let widths = surface.widths as f64;
    let held = surfels * (SURFEL + 4.0 * widths + 12.0 * lights.min(LEAVING_LIGHTS)) + ATTACHED * n;
    let medium = ("medium", of(needs.medium.needed, held));
    let carving = CARVED * f64::from(surface.resolution).powi(3) + SHAPE_POINTS.min(56.0 * pixels * facts.views as f64);
    let columns = 8.0 * widths * surfels * lights.min(FITTED[1]) + FITTED[0] * (FITTED_PIXEL + 4.0 * (widths + 4.0));
    let fitting = of(needs.medium.needed, OBSERVATION * pixels + FIT_SPREAD * (carving + columns));

    // A step: where the rasteriser runs backward, and where the residual does.
    let activated = n * (80.0 + 44.0);
    let rows = n * (80.0 + 4.0 * row_values + 20.0 + 28.0 + 4.0 * inputs);
    let projection = n * (80.0 + 72.0 * slots);
    let scratch = (THREADS / regions).min(1.0) * n * slots * (80.0 + 4.0 * stride(channels));
    let line = 4.0 * (8.0 + stride(channels));
    let backward = n * slots * line;
    let region_data = 4.0 * (channels + 2.0) * pixels * filled;
    let pulled = n * (52.0 + 4.0 * channels);
    let features = n * 4.0 * channels;
    let images = 2.0 * array(pixels * 4.0 * (channels + 2.0)) + pixels * OBSERVATION * f64::from(config.accumulate);
    let shaded = content * (56.0 + 8.0 + 96.0 + 96.0 + 64.0 + LISTS + OBJECTIVE);
    let slot_pool = (n * slots * 64.0).min(kept);
    let common = [program, photographs, parameters, visibility, medium];
    let out = n * (36.0 + 4.0 * row_values);
    let backward_of_rasteriser = [
        ("rasteriser", projection + scratch + backward.max(region_data) + pulled + slot_pool + features),
        ("activations and gradients", activated),
        ("network and its rows", rows),
    ];
    let backward_of_residual = [
        ("rasteriser", projection + scratch + backward.max(region_data).min(kept) + pulled + slot_pool + features),
        ("activations and gradients", activated + out),
        ("network and its rows", rows + n * (32.0 + 4.0 * 3.0 * inputs)),
    ];
    let adam = [
        ("rasteriser", scratch + backward.max(region_data).min(kept) + slot_pool),
        ("activations and gradients", n * (80.0 + 80.0 + 4.0 * (row_values + 16.0) + 4.0 * values)),
    ];
    let pictures = ("pictures of a step", images + shaded);
    // Where views are compared: a projection of the other one, its reverse, its share of the gradient, and maps of both.
    let scale = f64::from(config.consistency.target_scale).powi(2);
    let other = projection + n * slots * 4.0 * (8.0 + stride(0.0)) + n * 52.0 + pixels * (24.0 + 40.0 * scale);
    let other = ("the other view", of(needs.silhouette_consistency.needed || needs.depth_consistency.needed, other));
    let before_the_first = [("fit of the medium", fitting), ("activations and gradients", n * 80.0)];
    let left_by_fit = ("not used again since the fit", NOT_REUSED * fitting);
    let largest = [&backward_of_rasteriser[..], &backward_of_residual[..], &adam[..]]
        .into_iter()
        .map(|now| [&common[..], &[pictures, other, left_by_fit], now].concat())
        .chain([[&common[..], &before_the_first].concat()])
        .map(|parts| Moment::new("steps", &parts))
        .max_by_key(Moment::bytes);
    let transient =
        largest.as_ref().map_or(0.0, |m| m.bytes() as f64) - common.iter().map(|(_, bytes)| bytes).sum::<f64>();
    let left = ("not used again since the steps", NOT_REUSED * transient);
    all.extend(largest);

    // A checkpoint: a copy of everything that it holds, then a tensor at a time.
    let pooled = ("rasteriser", (backward.max(region_data)).min(kept) + slot_pool + scratch);
    let copy = n * (12.0 * values + 12.0 + of(traced, 4.0 * kept_lights + 44.0));
    let tensor = 4.0 * n * (residual.transfer_width() as f64).max(16.0);
    all.push(Moment::new("checkpoint", &[&common[..], &[left, pooled, ("copy for the file", copy + tensor)]].concat()));

    // A view under its lights.
    let view = |name: &'static str, lights: usize, pixels: f64, content: f64, compared: f64, page: f64| {
        let together = lights.min(at_once.lights) as f64;
        let pictures = (at_once.pictures_together(pixels as u64) as f64).min(together);
        // The second time by blocks of sixteen, for many lights.
        let rows = n * (92.0 + 8.0 * row_values + 4.0 * inputs + 4.0 * first_layer);
        let group = n * pictures * (4.0 * per_light + 4.0);
        let scratch = (THREADS / regions).min(1.0) * n * slots * (80.0 + 4.0 * stride(0.0));
        let kept_visibility = of(traced, (4.0 * n * kept_lights).min(at_once.visibility as f64));
        let parts = [
            left,
            ("renderer", n * (80.0 + of(config.visibility.traced, LIGHT_GRID)) + rows + kept_visibility),
            ("its pictures", array(12.0 * pixels) * pictures),
            ("page", page),
        ];
        // They are compared when they are rendered.
        let rendering = [
            ("rasteriser", projection.max(n * (4.0 * fixed + 16.0)) + scratch + slot_pool),
            ("who is seen where", KEPT_WEIGHT * entries(n, content) + PREPARED * content),
            ("channels of its lights", group),
        ];
        let comparison = [("one comparison", compared * pixels)];
        let bytes = |parts: &[(&str, f64)]| parts.iter().map(|p| p.1).sum::<f64>();
        let now = if bytes(&rendering) > bytes(&comparison) { &rendering[..] } else { &comparison[..] };
        Moment::new(name, &[&common[..], &parts, now].concat())
    };
    if facts.test_images > 0 {
        all.push(view("evaluation", facts.most_test_lights, pixels, content, OBSERVATION + COMPARISON, 0.0));
    }
    let control_pixels = pixels.min(384.0 * 384.0);
    let control_content = content * control_pixels / pixels.max(1.0);
    // What is black takes nothing: pictures under 24 lights, three of six comparisons, eleven maps.
    let page = (24.0 * 3.0 * control_content + (6.0 * 9.0 + 11.0 * 2.0) * content) * PAGE;
    let report = view("report", facts.lights.min(24), control_pixels, control_content, 0.0, page);
    let shown = view("report", facts.most_test_lights.clamp(1, 6), pixels, content, OBSERVATION + COMPARISON, page);
    all.push(if shown.bytes() > report.bytes() { shown } else { report });
    all
}
