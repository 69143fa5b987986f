//! Every stage on the device against its twin on the CPU, and the whole against the CPU's rasteriser. Without a device all tests
//! are reported as ignored, with the reason; with DIAMOND_REQUIRE_GPU=1 its absence is a failure.
mod compare;
mod components;
mod reconstruction;
mod relight;
mod scenes;
mod step_parts;
mod steps;

use compare::{Difference, relative_l2};
use diamond_gpu::{
    COMPONENTS, Device, DeviceChoice, GpuError, HostState, RasterScene, Rasterizer, STAGES, STEP_PARTS, Side, Sources,
    adapters,
};
use diamond_splat::{Cutoff, Gaussians, Raster, RasterPull, rasterize};
use libtest_mimic::{Arguments, Failed, Trial};
use std::process::ExitCode;
use std::sync::{Arc, OnceLock};

/// Asks that a missing device is a failure and not a reason to ignore.
const REQUIRED: &str = "DIAMOND_REQUIRE_GPU";

/// The tests' device: the best there is, software too.
fn device() -> Result<&'static Arc<Device>, String> {
    static DEVICE: OnceLock<Result<Arc<Device>, String>> = OnceLock::new();
    DEVICE.get_or_init(|| open(Sources::default()).map(Arc::new)).as_ref().map_err(Clone::clone)
}

fn open(sources: Sources) -> Result<Device, String> {
    let device = Device::open_with(DeviceChoice::Gpu(None), sources).map_err(|error| error.to_string())?;
    device.ok_or_else(|| GpuError::NoAdapter.to_string())
}

fn main() -> ExitCode {
    let mut arguments = Arguments::from_args();
    let found = adapters();
    let reason = found.is_empty().then_some("no GPU driver");
    if reason.is_some() {
        if std::env::var_os(REQUIRED).is_some_and(|value| value == "1") {
            eprintln!("{REQUIRED}=1: {}", GpuError::NoAdapter);
            return ExitCode::FAILURE;
        }
        // Nothing can run them.
        (arguments.ignored, arguments.include_ignored) = (false, false);
        println!("parity: {}", GpuError::NoAdapter);
    } else {
        println!("parity: on {} ({})", found[0].name, found[0].driver);
    }
    let trials = tests().into_iter().map(|(name, test)| {
        let trial = Trial::test(name, move || test(device()?).map_err(Failed::from));
        trial.with_ignored_flag(reason.is_some()).with_kind(reason.unwrap_or_default())
    });
    libtest_mimic::run(&arguments, trials.collect()).exit_code()
}

type Test = Box<dyn FnOnce(&'static Arc<Device>) -> Result<(), String> + Send>;

fn tests() -> Vec<(String, Test)> {
    let mut tests: Vec<(String, Test)> = Vec::new();
    for (name, scene) in scenes::all() {
        let other = scene.clone();
        tests.push((format!("stages, {name}"), Box::new(move |device| stages(device, name, scene))));
        tests.push((format!("whole, {name}"), Box::new(move |device| whole(device, name, &other))));
    }
    tests.push(("stages, large".into(), Box::new(|device| stages(device, "large", scenes::large()))));
    tests.push(("whole, large".into(), Box::new(|device| whole(device, "large", &scenes::large()))));
    tests.push(("whole, in pieces".into(), Box::new(|device| whole(device, "in pieces", &scenes::in_pieces()))));
    tests.push(("any stage may be the first on the device".into(), Box::new(switch)));
    tests.push(("two runs give the same bits".into(), Box::new(same_bits)));
    let test: Test = Box::new(reconstruction::agrees);
    tests.push(("a small reconstruction agrees with the CPU's".into(), test));
    tests.push(("bad input is an error".into(), Box::new(bad_input)));
    for row in COMPONENTS {
        tests.push((
            format!("component, {}", row.name),
            Box::new(move |device| {
                let worst = components::component(device, row.name)?;
                println!("parity: {}: {worst:.1e}", row.name);
                Ok(())
            }),
        ));
        tests.push((format!("planted, {}", row.name), Box::new(move |_| planted_component(row.name))));
    }
    for scenario in &steps::SCENARIOS {
        let test: Test = Box::new(move |device| steps::whole(device, scenario));
        tests.push((format!("step, {}", scenario.name), test));
    }
    let test: Test = Box::new(steps::same_bits);
    tests.push(("step, the same bits".into(), test));
    tests.push(("parts of a step".into(), Box::new(parts)));
    let test: Test = Box::new(relight::agrees);
    tests.push(("relit, many lights".into(), test));
    for name in ["pack_transport", "join_transport"] {
        tests.push((format!("planted, {name}"), Box::new(move |_| planted_relit(name))));
    }
    for row in STEP_PARTS {
        tests.push((format!("planted, {}", row.name), Box::new(move |_| planted_part(row.name))));
    }
    for row in STAGES {
        tests.push((format!("planted, {}", row.name), Box::new(move |_| planted(row.name))));
    }
    tests
}

fn stages(device: &'static Arc<Device>, name: &str, scene: RasterScene) -> Result<(), String> {
    let state = HostState::new(scene, device.max_binding()).map_err(|error| error.to_string())?;
    let worst = compare::stages(&state, Side::Gpu(device))
        .map_err(|Difference { stage, what }| format!("{name}: stage {stage}: {what}"))?;
    let worst: Vec<String> = worst.iter().map(|(stage, error)| format!("{stage} {error:.1e}")).collect();
    println!("parity: {name}: {}", worst.join(", "));
    Ok(())
}

/// Relative errors of a picture and its gradient.
fn errors(a: &(Raster, RasterPull), b: &(Raster, RasterPull)) -> Vec<(&'static str, bool, f64)> {
    let flat = |v: &RasterPull| {
        let g = &v.gaussians;
        [
            g.means.iter().flat_map(|v| v.to_array()).collect::<Vec<f32>>(),
            g.scales.iter().flat_map(|v| v.to_array()).collect(),
            g.rotations.iter().flat_map(|v| v.to_array()).collect(),
            g.opacities.clone(),
            g.factors.iter().flat_map(|l| l.0).collect(),
            v.screen.iter().flat_map(|v| v.to_array()).collect(),
            v.features.clone(),
        ]
    };
    let (pull_a, pull_b) = (flat(&a.1), flat(&b.1));
    let names = ["d means", "d scales", "d rotations", "d opacities", "d factors", "d screen", "d features"];
    let mut out = vec![
        ("features", false, relative_l2(a.0.features.data(), b.0.features.data())),
        ("opacity", false, relative_l2(a.0.opacity.data(), b.0.opacity.data())),
        ("depth", false, relative_l2(a.0.depth.data(), b.0.depth.data())),
    ];
    out.extend(names.iter().zip(pull_a.iter().zip(&pull_b)).map(|(name, (a, b))| (*name, true, relative_l2(a, b))));
    out
}

fn check(name: &str, errors: &[(&'static str, bool, f64)]) -> Result<(), String> {
    let text: Vec<String> = errors.iter().map(|(what, _, error)| format!("{what} {error:.1e}")).collect();
    println!("parity: {name}: {}", text.join(", "));
    match errors.iter().find(|(_, backward, error)| *error > if *backward { 1e-4 } else { 1e-5 }) {
        Some((what, _, error)) => Err(format!("{name}: {what}: relative error {error:.2e}")),
        None => Ok(()),
    }
}

fn on_cpu(scene: &RasterScene) -> Result<(Raster, RasterPull), String> {
    let (raster, pullback) = rasterize(&scene.gaussians, &scene.features, &scene.camera, &scene.config)
        .map_err(|error| error.to_string())?;
    let pull = pullback.pull(&scene.d).map_err(|error| error.to_string())?;
    Ok((raster, pull))
}

fn on_device(rasterizer: &mut Rasterizer, scene: &RasterScene) -> Result<(Raster, RasterPull), GpuError> {
    let (raster, pullback) = rasterizer.rasterize(&scene.gaussians, &scene.features, &scene.camera, &scene.config)?;
    let pull = pullback.pull(&scene.d)?;
    Ok((raster, pull))
}

fn whole(device: &'static Arc<Device>, name: &str, scene: &RasterScene) -> Result<(), String> {
    let mut rasterizer = Rasterizer::new(device.clone()).map_err(|error| error.to_string())?;
    let found = on_device(&mut rasterizer, scene).map_err(|error| error.to_string())?;
    let expected = on_cpu(scene)?;
    if found.0.stats.visible != expected.0.stats.visible {
        return Err(format!("visible: {} and {}", found.0.stats.visible, expected.0.stats.visible));
    }
    check(name, &errors(&found, &expected))
}

/// The first stages on the CPU, the rest on the device, for every number of stages.
fn switch(device: &'static Arc<Device>) -> Result<(), String> {
    let (_, scene) = scenes::all().swap_remove(0);
    let state = HostState::new(scene.clone(), device.max_binding()).map_err(|error| error.to_string())?;
    let expected = on_cpu(&scene)?;
    for on_cpu in 0..=STAGES.len() {
        let mut state = state.clone();
        state.run_all(on_cpu, device).map_err(|error| error.to_string())?;
        let picture = relative_l2(&state.picture(), expected.0.features.data());
        let gradient = relative_l2(&state.d_features(), &expected.1.features);
        if picture > 1e-5 || gradient > 1e-4 {
            return Err(format!("{on_cpu} stages on the CPU: picture {picture:.2e}, gradient {gradient:.2e}"));
        }
    }
    Ok(())
}

fn same_bits(device: &'static Arc<Device>) -> Result<(), String> {
    let scene = scenes::large();
    let mut rasterizer = Rasterizer::new(device.clone()).map_err(|error| error.to_string())?;
    let mut run = || on_device(&mut rasterizer, &scene).map_err(|error| error.to_string());
    let (first, second) = (run()?, run()?);
    if first != second {
        return Err("the second run has other bits".into());
    }
    Ok(())
}

fn bad_input(device: &'static Arc<Device>) -> Result<(), String> {
    let (_, scene) = scenes::all().swap_remove(0);
    let mut rasterizer = Rasterizer::new(device.clone()).map_err(|error| error.to_string())?;
    type Damage = fn(&mut RasterScene);
    let damages: [(&str, Damage); 5] = [
        ("a mean that is no number", |s| s.gaussians.means[3].x = f32::NAN),
        ("a feature that is no number", |s| s.features.data[1] = f32::INFINITY),
        ("too few features", |s| s.features.data.truncate(7)),
        ("a cut-off for tests", |s| s.config.cutoff = Cutoff::Smooth),
        ("a cotangent of another shape", |s| s.d = diamond_splat::RasterGrad::zeros(3, 3, 5)),
    ];
    for (what, damage) in damages {
        let mut scene = scene.clone();
        damage(&mut scene);
        match on_device(&mut rasterizer, &scene) {
            Ok(_) => return Err(format!("{what} was accepted")),
            Err(error) => println!("parity: {what}: {error}"),
        }
    }
    let mut scene = scene;
    scene.gaussians = Gaussians::default();
    scene.features.data.clear();
    on_device(&mut rasterizer, &scene).map(|_| ()).map_err(|error| error.to_string())
}

/// An error planted in one stage's kernels: file, what stands there, what is put there.
fn plants(stage: &str) -> Option<(&'static str, &'static str, &'static str)> {
    Some(match stage {
        "projection" => ("projection.wgsl", "pair_of(frame.principal.x)", "pair_of(frame.principal.x * 1.00001)"),
        "depth_sort" => {
            ("sort.wgsl", "values_out[place] = values_in[i];", "values_out[place] = values_in[i ^ u32(SHIFT == 8u)];")
        }
        "tile_offsets" => ("tile_offsets.wgsl", "tile_counts[depth_order[rank]]", "tile_counts[rank]"),
        "tile_entries" => ("tile_entries.wgsl", "row * frame.tiles.x + column", "row * frame.tiles.x + column + row"),
        // The sort by depth has another count.
        "tile_sort" => ("sort.wgsl", "var place = places[digit];", "var place = places[digit ^ COUNT];"),
        "tile_ranges" => ("tile_ranges.wgsl", "ranges[tile].y = i + 1u;", "ranges[tile].y = i;"),
        "blend" => ("blend.wgsl", "let w = t * a;", "let w = t * a * 1.0001;"),
        "blend_pull" => ("blend_pull.wgsl", "behind = fma(a, gain, behind);", "behind = fma(a, gain, behind * 0.999);"),
        "splat_sum" => ("splat_sum.wgsl", "entry < end;", "entry + 1u < end;"),
        "projection_pull" => ("projection_pull.wgsl", "d_k += d_s[j] * c.s;", "d_k += d_s[j] * c.s * 1.001;"),
        "mlp_forward" => ("product.wgsl", "let x = c[i] + b[", "let x = 1.0001 * c[i] + b["),
        "mlp_pull" => ("product.wgsl", "select(product.slope, 1.0, y > 0.0)", "select(product.slope, 1.0, y > 0.1)"),
        "shade" => ("shade.wgsl", "* seen * weights.x * p.opacity", "* seen * weights.x * p.opacity * 1.001"),
        "shade_pull" => ("shade_pull.wgsl", "d_depth += dot(", "d_depth -= dot("),
        "photometric" => ("photometric.wgsl", "s_bb += w * d_b * d_b;", "s_bb += w * d_b * d_b * 1.001;"),
        "mask_bce" => ("mask_bce.wgsl", "/ (cut * through)", "/ (cut * max(through, 0.01))"),
        "adam_step" => ("adam.wgsl", "const BETA_2: f32 = 0.999;", "const BETA_2: f32 = 0.99901;"),
        "record_view" => ("density_stats.wgsl", "before.y + 1.0", "before.y + 2.0"),
        "activate" => {
            ("activate.wgsl", "sigmoid_of(raw[places.opacity + i])", "sigmoid_of(raw[places.opacity + i] * 1.001)")
        }
        "residual_inputs" => ("residual_inputs.wgsl", "light.xyz, light.w", "light.xyz * 1.001, light.w"),
        "residual_outputs" => ("residual_outputs.wgsl", "part = fma(", "part = 1.001 * fma("),
        "medium_rows" => ("medium_rows.wgsl", "f2.yzw + sent", "f2.yzw + sent * 1.001"),
        "visibility_fit" => ("visibility_fit.wgsl", "var sum = 0.5;", "var sum = 0.5001;"),
        "image_terms" => ("image_terms.wgsl", "select(0.125, 0.25, j == 1u)", "select(0.125, 0.24, j == 1u)"),
        "medium_pull" => ("medium_pull.wgsl", "let d_normal = light.xyz", "let d_normal = 1.01 * light.xyz"),
        "residual_gather" => ("residual_gather.wgsl", "fma(d[c], y[k]", "fma(1.001 * d[c], y[k]"),
        "residual_scatter" => ("residual_scatter.wgsl", "d_inputs[at + 42u + k]", "d_inputs[at + 41u + k]"),
        "activate_pull" => ("activate_pull.wgsl", "d_raw[q + 3u] += g.form_a.z;", "d_raw[q + 3u] += g.form_a.y;"),
        "visibility_term" => ("visibility_term.wgsl", "f32(samples[n].y)", "min(f32(samples[n].y), 1.0)"),
        "transfer_smoothness" => ("transfer_smoothness.wgsl", "view.weight * 2.0", "view.weight"),
        "sampled_inputs" => ("sampled_inputs.wgsl", "-s.viewer, dot", "s.viewer, dot"),
        "sampled_pull" => ("sampled_pull.wgsl", "fma(transfer[at + k]", "fma(0.99 * transfer[at + k]"),
        "clamp_scales" => ("clamp_scales.wgsl", "limits.high, v >", "limits.high + 0.001, v >"),
        "pack_transport" => ("pack_transport.wgsl", "packed[at + 1u] = residual.y", "packed[at + 1u] = residual.z"),
        "join_transport" => ("join_transport.wgsl", "5u * slot[0]", "5u * min(slot[0], 1u)"),
        "reduce" => ("reduce.wgsl", "if lane < half {", "if lane < half - 1u {"),
        _ => return None,
    })
}

/// The first component of the file that is found wrong is the one where the error is.
fn planted_component(name: &'static str) -> Result<(), String> {
    let (file, from, to) = plants(name).ok_or("no error is planted in this component")?;
    let sources = Sources::default().with_edit(file, from, to).ok_or("there is nothing to replace")?;
    let device = open(sources)?;
    let mut suspects = COMPONENTS.iter().filter(|row| file.starts_with(row.file));
    match suspects.find(|row| components::component(&device, row.name).is_err()) {
        None => Err(format!("an error in {name} was not found")),
        Some(row) if row.name == name => Ok(()),
        Some(row) => Err(format!("an error in {name} was taken for one in {}", row.name)),
    }
}

fn parts(device: &'static Arc<Device>) -> Result<(), String> {
    let worst = step_parts::parts(device).map_err(|(name, what)| format!("{name}: {what}"))?;
    let worst: Vec<String> = worst.iter().map(|(name, error)| format!("{name} {error:.1e}")).collect();
    println!("parity: parts of a step: {}", worst.join(", "));
    Ok(())
}

/// Pictures under many lights are found wrong.
fn planted_relit(name: &'static str) -> Result<(), String> {
    let (file, from, to) = plants(name).ok_or("no error is planted")?;
    let sources = Sources::default().with_edit(file, from, to).ok_or("there is nothing to replace")?;
    match relight::agrees(&Arc::new(open(sources)?)) {
        Ok(()) => Err(format!("an error in {name} was not found")),
        Err(what) if what.contains("relative error") => Ok(()),
        Err(what) => Err(what),
    }
}

/// The first part of a step that is found wrong is the one where the error is.
fn planted_part(name: &'static str) -> Result<(), String> {
    let (file, from, to) = plants(name).ok_or("no error is planted in this part")?;
    let sources = Sources::default().with_edit(file, from, to).ok_or("there is nothing to replace")?;
    match step_parts::parts(&Arc::new(open(sources)?)) {
        Ok(_) => Err(format!("an error in {name} was not found")),
        Err((found, _)) if found == name => Ok(()),
        Err((found, what)) => Err(format!("an error in {name} was taken for one in {found}: {what}")),
    }
}

/// The harness finds the error, and in the stage where it is.
fn planted(stage: &'static str) -> Result<(), String> {
    let (file, from, to) = plants(stage).ok_or("no error is planted in this stage")?;
    let sources = Sources::default().with_edit(file, from, to).ok_or("there is nothing to replace")?;
    let device = open(sources)?;
    let (_, scene) = scenes::all().swap_remove(0);
    let state = HostState::new(scene, device.max_binding()).map_err(|error| error.to_string())?;
    match compare::stages(&state, Side::Gpu(&device)) {
        Ok(_) => Err(format!("an error in {stage} was not found")),
        Err(found) if found.stage == stage => Ok(()),
        Err(found) => Err(format!("an error in {stage} was taken for one in {}: {}", found.stage, found.what)),
    }
}
