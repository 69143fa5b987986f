//! What is not computed would not have changed anything: each kind of skipping against the same step with everything
//! computed, and the counters that show that the work was not done.
use diamond_dataset::{Capture, OpenOptions, Selection};
use diamond_light::OlatLight;
use diamond_reconstruct::{
    Attribute, CaptureFacts, Config, DensityStrategy, MetalVariant, Model, Needs, Reconstruction, RenderNeeds,
    Renderer, SubsurfaceModel, TensorFile,
};
use glam::Vec3;

fn capture() -> Capture {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/spot-small");
    Capture::open(folder.as_ref(), &OpenOptions::default())
        .and_then(|c| c.select(&Selection::Count(3), &Selection::Count(2)))
        .expect("the embedded capture opens")
}

fn short(preset: &str) -> Config {
    let mut config = Config::preset(preset).expect("a preset");
    config.steps = 40;
    config.subsurface.model = SubsurfaceModel::Mlp;
    config.initial.count = 500;
    config.density.strategy = DensityStrategy::None;
    config.visibility.every_steps = 5;
    config
}

fn state(run: &mut Reconstruction, name: &str) -> TensorFile {
    let dir = std::env::temp_dir().join(format!("diamond-skipping-{name}-{}", std::process::id()));
    let path = run.save_checkpoint(&dir).expect("a checkpoint");
    let file = TensorFile::read(&path).expect("readable");
    std::fs::remove_dir_all(dir).expect("removed");
    file
}

fn counter(run: &Reconstruction, name: &str) -> u64 {
    run.counters().iter().find(|(known, _)| *known == name).map_or(0, |(_, n)| *n)
}

/// The gradients of the first step, which Adam's first moments are a tenth of, relative to the largest of their kind.
fn worst_gradient(a: &TensorFile, b: &TensorFile) -> (f32, String) {
    let mut worst = (0.0, String::new());
    for (name, (_, x)) in a.tensors.iter().filter(|(name, _)| name.ends_with("first_moment")) {
        let (_, y) = &b.tensors[name];
        let largest = y.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        for (x, y) in x.iter().zip(y) {
            let error = (x - y).abs() / largest.max(1e-12);
            if error > worst.0 {
                worst = (error, name.clone());
            }
        }
    }
    worst
}

/// Skipping everything that a configuration does not need leaves terms and gradients of a step as they are, up to
/// rounding: relative to the largest of its kind 2e-5, terms 1e-5.
#[test]
fn a_step_agrees_with_everything_computed() {
    let mut cases: Vec<(String, Config)> =
        diamond_reconstruct::PRESETS.iter().map(|p| ((*p).to_owned(), short(p))).collect();
    let mut change = |name: &str, f: &dyn Fn(&mut Config)| {
        let mut config = short("resolved");
        f(&mut config);
        cases.push((name.to_owned(), config));
    };
    change("learned roughness", &|c| c.shading.roughness_unfreeze = 0.0);
    change("no metal", &|c| c.shading.metal = MetalVariant::No);
    change("no subsurface", &|c| (c.residual.network, c.residual.transfer) = (false, false));
    change("no shadows", &|c| c.shading.surface_visibility = false);
    change("with a medium", &|c| {
        c.subsurface.model = SubsurfaceModel::ProfileMlp;
        (c.subsurface.surfels, c.subsurface.seeds, c.subsurface.resolution, c.subsurface.widths) = (500, 800, 28, 6);
    });
    change("no SSIM", &|c| c.loss.ssim = 0.0);
    change("l2 and enhancement in linear", &|c| {
        (c.loss.l2, c.loss.enhancement, c.loss.space) = (0.5, 0.1, diamond_reconstruct::StoredTransfer::Linear);
    });
    for (name, config) in cases {
        let mut skipping = Reconstruction::new(capture(), &config).expect("starts");
        let mut everything = Reconstruction::with_needs(capture(), &config, Needs::everything()).expect("starts");
        let (a, b) = (skipping.step().expect("a step"), everything.step().expect("a step"));
        for term in &a.terms {
            let other = b.terms.iter().find(|t| t.name == term.name).expect("computed");
            let error = (term.value - other.value).abs() / other.value.abs().max(1e-6);
            assert!(error <= 1e-5, "{name}: {} {} {}", term.name, term.value, other.value);
        }
        assert!((a.psnr - b.psnr).abs() < 1e-3, "{name}: PSNR {} {}", a.psnr, b.psnr);
        let (mut of_skipping, of_everything) = (state(&mut skipping, "a"), state(&mut everything, "b"));
        if config.shading.metal == MetalVariant::No {
            // Metalness has no gradient, by decision.
            of_skipping.tensors.remove("gaussians.metalness.first_moment");
        }
        if name == "no subsurface" {
            // The other run smooths a map that nothing shows.
            of_skipping.tensors.remove("gaussians.subsurfaceness.first_moment");
        }
        let (worst, what) = worst_gradient(&of_skipping, &of_everything);
        assert!(worst <= 2e-5, "{name}: {what} differs by {worst}");
        println!("{name}: worst gradient {worst:.1e} ({what})");
        let less = |name: &str, of: &str| assert!(counter(&skipping, name) < counter(&skipping, of), "{name}");
        less("pixels shaded", "pixels");
        less("channels rasterised", "channels");
        assert_eq!(counter(&everything, "pixels shaded"), counter(&everything, "pixels"));
        assert_eq!(counter(&everything, "channels rasterised"), counter(&everything, "channels"));
        assert_eq!(counter(&everything, "network rows backward"), counter(&everything, "network rows forward"));
    }
}

/// The comparison can fail: another weight is noticed.
#[test]
fn the_comparison_notices_a_difference() {
    let config = short("resolved");
    let mut other = config.clone();
    other.loss.mask = 0.11;
    let mut runs = [&config, &other].map(|c| Reconstruction::new(capture(), c).expect("starts"));
    runs.iter_mut().for_each(|run| assert!(run.step().is_ok()));
    let [a, b] = &mut runs;
    assert!(worst_gradient(&state(a, "c"), &state(b, "d")).0 > 1e-3);
}

/// Each term of weight 0 is neither computed nor listed, each other one is; channels go with what reads them.
#[test]
fn counters_show_what_was_not_done() {
    let run = |change: &dyn Fn(&mut Config), steps: usize| {
        let mut config = short("resolved");
        config.visibility.moved = 0.0;
        change(&mut config);
        let mut run = Reconstruction::new(capture(), &config).expect("starts");
        (0..steps).for_each(|_| assert!(run.step().is_ok()));
        run
    };
    let all = run(&|_| {}, 10);
    for term in ["l1", "dssim", "mask", "normal", "smooth_base_color", "smooth_metalness", "visibility"] {
        assert_eq!(counter(&all, term), 10, "{term}");
    }
    // Roughness is frozen for a sixth of the run: 6.7 of 40 steps.
    assert_eq!(counter(&all, "smooth_roughness"), 3);
    assert_eq!(counter(&all, "channels rasterised"), 7 * 12 + 3 * 13);
    for absent in ["l2", "enhancement", "incident", "lpips"] {
        assert_eq!(counter(&all, absent), 0, "{absent}");
    }
    assert!(counter(&all, "visibility traced") < counter(&all, "visibility look-ups"));

    let bare = run(
        &|c| {
            (c.loss.ssim, c.loss.mask, c.loss.normal, c.loss.visibility) = (0.0, 0.0, 0.0, 0.0);
            (c.loss.smooth_base_color, c.loss.smooth_metalness, c.loss.smooth_roughness) = (0.0, 0.0, 0.0);
            c.loss.smooth_subsurfaceness = 0.0;
            (c.residual.network, c.residual.transfer, c.shading.surface_visibility) = (false, false, false);
            c.shading.metal = MetalVariant::No;
        },
        4,
    );
    for term in ["dssim", "mask", "normal", "smooth_base_color", "smooth_metalness", "visibility"] {
        assert_eq!(counter(&bare, term), 0, "{term}");
    }
    // Base colour and normal are left.
    assert_eq!(counter(&bare, "channels rasterised"), 4 * 6);
    for nothing in ["network rows forward", "network rows backward", "visibility rows", "visibility traced"] {
        assert_eq!(counter(&bare, nothing), 0, "{nothing}");
    }
    assert!(counter(&bare, "Adam values left out") > 0);
}

/// Kept visibility costs nothing that matters: few traces, and the run ends where one that traces anew ends.
#[test]
fn unmoved_visibility_is_kept_within_tolerance() {
    let run = |moved: f32| {
        let mut config = short("resolved");
        config.steps = 120;
        config.rates.mean_final = 1e-7;
        config.rates.mean_decay = 0.3;
        config.rates.attribute_final = 1e-3;
        config.visibility.moved = moved;
        let mut run = Reconstruction::new(capture(), &config).expect("starts");
        let psnr: Vec<f32> = (0..120).map(|_| run.step().expect("a step").psnr).collect();
        (run, psnr[108..].iter().sum::<f32>() / 12.0)
    };
    let (kept, a) = run(0.3);
    let (anew, b) = run(0.0);
    assert!(counter(&kept, "visibility kept, nothing moved") > 0);
    assert!(counter(&kept, "visibility traced") < counter(&anew, "visibility traced"));
    assert_eq!(counter(&anew, "visibility kept, nothing moved"), 0);
    assert!((a - b).abs() < 0.1, "{a} dB with kept visibility, {b} dB without");
    println!("traced {} of {}", counter(&kept, "visibility traced"), counter(&anew, "visibility traced"));
}

/// A black capture without anything to see is shaded and compared whole, and stays finite.
#[test]
fn decisions_say_why() {
    let config = Config::preset("resolved").expect("a preset");
    let needs = Needs::decide(&config, &CaptureFacts::of(&capture()).expect("facts"));
    let text = needs.to_string();
    for expected in ["enhancement", "loss.enhancement = 0", "incident_channel", "not learned", "empty_pixels"] {
        assert!(text.contains(expected), "{expected} in {text}");
    }
    assert!(needs.rows().iter().all(|row| !row.decision.reason.is_empty() && !row.saves.is_empty()));
    let facts = CaptureFacts { looked_at: 8, ..Default::default() };
    let needs = Needs::decide(&config, &facts);
    assert!(needs.mask.needed && needs.mask.reason.contains("none of 8 images"));
}

/// Gaussians that hide behind others are left out of the residual's backward pass, and the gradient stays the same.
#[test]
fn hidden_gaussians_are_not_pulled() {
    let mut config = short("resolved");
    (config.initial.count, config.initial.opacity) = (6000, 0.99);
    let mut skipping = Reconstruction::new(capture(), &config).expect("starts");
    let mut everything = Reconstruction::with_needs(capture(), &config, Needs::everything()).expect("starts");
    assert!(skipping.step().is_ok() && everything.step().is_ok());
    let (forward, backward) = (counter(&skipping, "network rows forward"), counter(&skipping, "network rows backward"));
    assert!(backward < forward, "{backward} of {forward}");
    let (worst, what) = worst_gradient(&state(&mut skipping, "e"), &state(&mut everything, "f"));
    assert!(worst <= 2e-5, "{what} differs by {worst}");
    println!("{backward} of {forward} rows pulled, worst gradient {worst:.1e}");
}

/// Visibility that is kept from one view to the next does not change a bit, nor does room for a few of the lights only.
#[test]
fn views_share_the_visibility_of_lights() {
    views_share(SubsurfaceModel::Mlp, 4);
    // Three channels from the medium beside visibility.
    views_share(SubsurfaceModel::ProfileMlp, 16);
}

fn views_share(subsurface: SubsurfaceModel, bytes: usize) {
    let mut config = short("resolved");
    config.initial.count = 800;
    config.subsurface.model = subsurface;
    (config.subsurface.seeds, config.subsurface.surfels, config.subsurface.resolution) = (800, 500, 28);
    let mut run = Reconstruction::new(capture(), &config).expect("starts");
    (0..3).for_each(|_| assert!(run.step().is_ok()));
    let model = run.model().expect("a model").clone();
    assert!(model.config.visibility.traced);
    let cameras: Vec<_> = run.capture().train.iter().take(3).map(|view| view.camera).collect();
    let lights: Vec<OlatLight> = run.capture().train[0].shots.iter().map(|shot| shot.light).collect();
    assert_eq!(model.medium.is_some(), subsurface.has_medium());
    let bytes_of_one = bytes * model.parameters.len();
    for bytes in [usize::MAX, 2 * bytes_of_one + 1] {
        let keeping = Renderer::new(&model).with_kept_visibility(bytes);
        for camera in &cameras {
            let expected = Renderer::new(&model).radiance(camera, &lights).expect("renders");
            assert!(keeping.radiance(camera, &lights).expect("renders") == expected, "pictures differ");
            // One by one, in groups of another size.
            let keeping = Renderer::new(&model).with_kept_visibility(bytes).with_lights_together(3);
            let mut seen = 0;
            let see = |k: usize, image: &diamond_image::Image| -> Result<(), diamond_reconstruct::ReconstructError> {
                assert!(k == seen && *image == expected[k], "picture {k} differs");
                seen += 1;
                Ok(())
            };
            keeping.each_radiance(camera, &lights, see).expect("renders");
            assert_eq!(seen, lights.len());
        }
    }
}

/// Pictures agree with those of a renderer that leaves nothing out: bit for bit, but for parts that are nil.
#[test]
fn rendering_agrees_with_everything_rendered() {
    let mut config = short("resolved");
    (config.initial.count, config.initial.opacity) = (1500, 0.99);
    let mut run = Reconstruction::new(capture(), &config).expect("starts");
    (0..20).for_each(|_| assert!(run.step().is_ok()));
    let view = run.capture().train[0].clone();
    let lights: Vec<OlatLight> = (0..9)
        .map(|i| {
            let angle = i as f32 * 0.7;
            OlatLight::Point { position: Vec3::new(4.0 * angle.cos(), 4.0 * angle.sin(), 2.0), intensity: Vec3::ONE }
        })
        .collect();
    let mut model = run.model().expect("a model").clone();
    let everything = |model: &Model| {
        Renderer::with_needs(model, RenderNeeds::everything()).radiance(&view.camera, &lights).expect("renders")
    };
    let renderer = Renderer::new(&model);
    let pictures = renderer.radiance(&view.camera, &lights).expect("renders");
    assert!(pictures == everything(&model), "pictures differ");
    // One light alone, a few, and the pictures with all maps: the same bits.
    assert!(renderer.radiance(&view.camera, &lights[5..6]).expect("renders")[0] == pictures[5]);
    let maps = renderer.renderings(&view.camera, &lights[..2]).expect("renders");
    assert!(maps[1].radiance == pictures[1] && maps[1].maps.visibility.data().iter().any(|v| *v > 0.0));
    let work = renderer.work(&view.camera).expect("a view");
    assert!(work.rows < work.visible && work.shaded < work.pixels, "{work:?}");
    assert_eq!((work.fixed_channels, work.light_channels), (9, 4));
    let all = Renderer::with_needs(&model, RenderNeeds::everything()).work(&view.camera).expect("a view");
    assert_eq!((all.rows, all.shaded), (work.visible, work.pixels));

    // Nothing metallic, nothing subsurface: left out, and no value changes by more than about NIL.
    let nil = diamond_reconstruct::logit(0.5 * diamond_reconstruct::NIL);
    for attribute in [Attribute::Metalness, Attribute::Subsurfaceness] {
        model.parameters.values_mut(attribute).fill(nil);
    }
    let renderer = Renderer::new(&model);
    assert!(!renderer.needs().metal.needed && !renderer.needs().subsurface.needed);
    let pictures = renderer.radiance(&view.camera, &lights).expect("renders");
    let work = renderer.work(&view.camera).expect("a view");
    assert_eq!((work.fixed_channels, work.light_channels), (7, 1));
    let brightest = pictures.iter().flat_map(|p| p.data()).fold(1.0f32, |m, v| m.max(*v));
    for (a, b) in pictures.iter().zip(everything(&model)) {
        let worst = a.data().iter().zip(b.data()).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(worst <= diamond_reconstruct::NIL * brightest, "nil parts change a value by {worst}");
    }
}
