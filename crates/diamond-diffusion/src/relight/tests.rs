//! A ball under two lights, relit by a very small network.
use super::*;
use crate::nn::{Source, VariablesBuilder};
use crate::train::{TrainSettings, Trainer};
use crate::unet::{ControlConfig, UNetConfig, ViewAttention};
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::Image;
use glam::{Vec2, Vec3};

/// A matte ball of radius 1 at the origin, four units away, under a light.
fn ball(size: u32, light: Vec3) -> RelightView {
    let pose = Pose::look_at(Vec3::NEG_Z * 4.0, Vec3::ZERO, Vec3::NEG_Y);
    let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.7, size, size), pose };
    let n = size as usize;
    let mut view = RelightView {
        camera,
        source: Image::new(n, n, 3),
        coverage: Image::new(n, n, 1),
        depth: Image::new(n, n, 1),
        normals: Image::new(n, n, 3),
        source_light: Some(light),
    };
    for (x, y) in (0..n * n).map(|i| (i % n, i / n)) {
        let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
        let b = ray.origin.dot(ray.direction);
        let under = b * b - ray.origin.length_squared() + 1.0;
        if under > 0.0 {
            let point = ray.origin + ray.direction * (-b - under.sqrt());
            view.depth.pixel_mut(x, y)[0] = camera.pose.transform_point(point).z;
            view.coverage.pixel_mut(x, y)[0] = 1.0;
            view.normals.pixel_mut(x, y).copy_from_slice(&point.normalize().to_array());
            let shade = point.normalize().dot((light - point).normalize()).max(0.0);
            view.source.pixel_mut(x, y).copy_from_slice(&[0.8 * shade + 0.05, 0.6 * shade + 0.05, 0.3 * shade]);
        }
    }
    view
}

fn small() -> RelighterConfig {
    let unet = UNetConfig {
        in_channels: 12,
        out_channels: 12,
        channels: vec![24, 32],
        blocks: 1,
        attention: vec![false, true],
        heads: vec![1, 2],
        context: None,
        linear_projection: true,
        groups: 4,
        rays: false,
        views: ViewAttention::None,
        light: Some(0),
    };
    RelighterConfig { networks: ControlConfig { unet, hints: HINTS, hint_channels: vec![16, 16] }, size: 16 }
}

const LEFT: Vec3 = Vec3::new(-4.0, -1.0, -3.0);
const RIGHT: Vec3 = Vec3::new(4.0, -2.0, -3.0);

/// By hand, at the middle of the ball: normal (0, 0, −1) in the world, toward the viewer (0, 0, 1).
#[test]
fn hints_have_the_values_by_hand() {
    let view = ball(33, LEFT);
    let predicted = |v: f32| Image::filled(33, 33, 3, v);
    let prediction = Prediction { source: predicted(0.1), target: predicted(1.0) };
    let base = Base { prediction, physical: true };
    let planes = hint_planes(&view, RIGHT, &base).unwrap();
    let at = |c: usize| planes[c * 33 * 33 + 16 * 33 + 16];
    let to_light = (RIGHT - Vec3::NEG_Z).normalize();
    assert_eq!(at(3), 1.0);
    assert!(at(4) < -0.1, "nearer than the middle of what is seen: {}", at(4));
    for (c, expected) in [(5, 0.0), (6, 0.0), (7, 1.0), (8, -to_light.z), (9, -(LEFT - Vec3::NEG_Z).normalize().z)] {
        assert!((at(c) - expected).abs() < 1e-3, "plane {c}: {} instead of {expected}", at(c));
    }
    // To the right and up of the viewer (world y is down here), and toward him.
    assert!(at(12) > 0.5 && at(13) > 0.2 && at(14) > 0.2, "{} {} {}", at(12), at(13), at(14));
    assert!((Vec3::new(at(12), at(13), at(14)).length() - 1.0).abs() < 1e-4);
    for (c, light) in [(10, RIGHT), (11, LEFT)] {
        let half = ((light - Vec3::NEG_Z).normalize() + Vec3::NEG_Z).normalize();
        assert!((at(c) - (-half.z).powi(32)).abs() < 1e-3);
    }
    // White as predicted, and what the source is over its own prediction.
    assert!([at(15), at(16), at(17), at(21)].iter().all(|v| (v - 1.0).abs() < 1e-5));
    let red = view.source.pixel(16, 16)[0];
    assert!((at(18) - 2.0 * ((red + 0.02) / 0.12).ln()).abs() < 1e-5);
    // A corner sees nothing: black, no coverage, no shape.
    let corner: Vec<f32> = (0..HINTS).map(|c| planes[c * 33 * 33]).collect();
    assert_eq!(corner[..3], [-1.0; 3]);
    assert!(corner[3..15].iter().all(|v| *v == 0.0));
}

#[test]
fn a_resized_view_keeps_depth_and_normals_of_what_is_there() {
    let (large, small) = (ball(64, LEFT).resized(16, 16).unwrap(), ball(16, LEFT));
    let worst = |a: &Image, b: &Image, near: f32| {
        let inside = (0..256).filter(|i| small.coverage.data()[*i] > 0.0 && large.coverage.data()[*i] > 0.99);
        let channels = a.channels();
        inside
            .flat_map(|i| (0..channels).map(move |c| i * channels + c))
            .all(|i| (a.data()[i] - b.data()[i]).abs() < near)
    };
    assert!(worst(&large.depth, &small.depth, 0.1) && worst(&large.normals, &small.normals, 0.15));
}

#[test]
fn bad_views_are_refused() {
    let view = ball(16, LEFT);
    let base = Base::of(&view, &RelightTarget::lit(RIGHT)).unwrap();
    let refused = |view: &RelightView| hint_planes(view, RIGHT, &base).unwrap_err().to_string();
    assert!(refused(&RelightView { depth: Image::new(8, 16, 1), ..view.clone() }).contains("depth"));
    assert!(refused(&RelightView { coverage: Image::new(16, 16, 1), ..view.clone() }).contains("coverage"));
    let nan = Image::filled(16, 16, 3, f32::NAN);
    assert!(refused(&RelightView { source: nan, ..view.clone() }).contains("pixel (0, 0)"));
    assert!(hint_planes(&view, Vec3::NAN, &base).is_err());
    assert!(RelightBatch::new(&[]).is_err());
    let example =
        RelightExample { view: view.clone(), target: RelightTarget::lit(RIGHT), picture: Image::new(8, 8, 3) };
    assert!(RelightBatch::new(&[example]).is_err());
    let predicted = |source: Image, target: Image| {
        let prediction = Some(Prediction { source, target });
        Base::of(&view, &RelightTarget { light: RIGHT, prediction }).unwrap_err().to_string()
    };
    let (right, nan) = (Image::new(16, 16, 3), Image::filled(16, 16, 3, f32::NAN));
    assert!(predicted(right.clone(), Image::new(8, 8, 3)).contains("prediction"));
    assert!(predicted(nan, right).contains("prediction of the source, pixel (0, 0)"));
    let wrong = |change: fn(&mut RelighterConfig)| {
        let mut config = small();
        change(&mut config);
        config.validate().is_err()
    };
    assert!(wrong(|c| c.size = 18) && wrong(|c| c.networks.hints = 7) && wrong(|c| c.networks.unet.in_channels = 4));
    RelighterConfig::tiny().validate().unwrap();
    RelighterConfig::shipped().validate().unwrap();
}

/// [eq:shading-bases] Shading finds the ball's factors: 0.8, 0.6 and 0.3 times n·l, and 0.05 from everywhere in red and green. Relit, it is the ball under the other light.
#[test]
fn shading_of_a_ball_is_the_ball() {
    let (left, right) = (ball(24, LEFT), ball(24, RIGHT));
    let shaded = shading(&left, RIGHT);
    for (made, truth) in [(&shaded.source, &left.source), (&shaded.target, &right.source)] {
        let worst = made.data().iter().zip(truth.data()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-3, "{worst}");
    }
    let blind = RelightView { source_light: None, ..left.clone() };
    assert_eq!(shading(&blind, RIGHT).target, left.source);
}

/// A view that is turned or mirrored has the hints of the view, turned or mirrored: n·l, highlights and coverage stay with their pixels, and the camera
/// sees what it saw.
#[test]
fn turned_views_have_turned_hints() {
    let view = ball(12, LEFT);
    let plain = Base { prediction: shading(&view, RIGHT), physical: false };
    let planes = hint_planes(&view, RIGHT, &plain).unwrap();
    for which in 0..8 {
        let orientation = orientation::Orientation::new(which);
        let turned = orientation.view(&view);
        let light = orientation.place(RIGHT);
        let base = Base { prediction: shading(&turned, light), physical: false };
        let found = hint_planes(&turned, light, &base).unwrap();
        for c in [0, 3, 4, 7, 8, 9, 10, 11, 14, 15, 18] {
            let plane = Image::from_vec(12, 12, 1, planes[c * 144..][..144].to_vec()).unwrap();
            let expected = orientation.image(&plane);
            let worst = expected.data().iter().zip(&found[c * 144..]).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 2e-3, "orientation {which}, plane {c}: {worst}");
        }
    }
}

/// Trained on two pairs, it turns the light of a third picture's source better than leaving it as it is, at another size than its own.
#[test]
fn a_trained_relighter_turns_the_light() {
    let builder = VariablesBuilder::new(Source::Seed(6));
    let relighter = Relighter::new(&builder.root(), &small()).unwrap();
    let settings = TrainSettings { steps: 250, warm_up: 10, rate: 3e-3, average: 0.95, ..TrainSettings::default() };
    let mut trainer = Trainer::new(builder.finish().0, settings).unwrap();
    let (left, right) = (ball(16, LEFT), ball(16, RIGHT));
    // Shading would explain a ball wholly: nothing is left to learn where something else is predicted badly.
    let flat = |view: &RelightView| Prediction { source: view.source.clone(), target: view.source.clone() };
    let pair = |from: &RelightView, to: &RelightView, light| RelightExample {
        view: from.clone(),
        target: RelightTarget { light, prediction: Some(flat(from)) },
        picture: to.source.clone(),
    };
    let batch = RelightBatch::new(&[pair(&left, &right, RIGHT), pair(&right, &left, LEFT)]).unwrap();
    let mut losses = Vec::new();
    for _ in 0..settings.steps {
        losses.push(trainer.step(|step| relighter.loss(&batch, 1, step)).unwrap().loss);
    }
    let mean = |losses: &[f64]| losses.iter().sum::<f64>() / losses.len() as f64;
    assert!(mean(&losses[230..]) < 0.5 * mean(&losses[..20]), "{} to {}", mean(&losses[..20]), mean(&losses[230..]));
    let (source, target) = (ball(32, LEFT), ball(32, RIGHT));
    let targets = [RelightTarget { light: RIGHT, prediction: Some(flat(&source)) }];
    let relit = relighter.relight(&source, &targets, &RelightOptions::default()).unwrap().remove(0);
    let error = |image: &Image| -> f32 {
        image.data().iter().zip(target.source.data()).map(|(a, b)| (a - b) * (a - b)).sum::<f32>()
    };
    let (ours, copied) = (error(&relit.image), error(&source.source));
    assert!(ours < 0.5 * copied, "{ours} against {copied} of the source as it is");
    assert_eq!(relit.image.shape(), (32, 32, 3));
    assert!(relit.deviation.data().iter().any(|d| *d > 0.0) && relit.deviation.first_non_finite().is_none());
    let again = relighter.relight(&source, &targets, &RelightOptions::default()).unwrap().remove(0);
    assert_eq!(again.image.data(), relit.image.data());
    assert!(relighter.relight(&source, &[], &RelightOptions::default()).is_err());
}

/// A shard of one view of the ball under two lights, the second twice as strong, without one of its tensors.
fn write_shard(folder: &std::path::Path, leave_out: &str) {
    use candle_core::{Device, Tensor};
    let (left, right) = (ball(16, LEFT), ball(16, RIGHT));
    let tensor = |values: Vec<f32>, shape: &[usize]| Tensor::from_vec(values, shape, &Device::Cpu).unwrap();
    let camera = left.camera;
    let rows: Vec<f32> = (0..3)
        .flat_map(|i| [camera.pose.rotation.row(i).to_array().to_vec(), vec![camera.pose.translation[i]]].concat())
        .collect();
    let k = camera.intrinsics;
    let images = [left.source.data(), &right.source.map(|v| 2.0 * v).into_vec()].concat();
    let tensors = [
        ("images", tensor(images, &[1, 2, 16, 16, 3])),
        ("coverage", tensor(left.coverage.data().to_vec(), &[1, 16, 16])),
        ("depth", tensor(left.depth.data().to_vec(), &[1, 16, 16])),
        ("normal", tensor(left.normals.data().to_vec(), &[1, 16, 16, 3])),
        ("intrinsics", tensor(vec![k.fx, k.fy, k.cx, k.cy], &[1, 4])),
        ("world_to_camera", tensor(rows, &[1, 3, 4])),
        ("light_positions", tensor([LEFT.to_array(), RIGHT.to_array()].concat(), &[1, 2, 3])),
        ("light_intensities", tensor(vec![1.0, 1.0, 1.0, 2.0, 2.0, 2.0], &[1, 2, 3])),
    ];
    let kept = tensors.iter().filter(|(name, _)| *name != leave_out).map(|(name, t)| (*name, t));
    crate::write_weights(&folder.join("a.safetensors"), kept, crate::NumberType::F32, "").unwrap();
}

/// Shards as `diamond shards` writes them: read, resized, drawn the same way twice.
#[test]
fn shards_are_read_and_bad_ones_refused() {
    let folder = std::env::temp_dir().join(format!("diamond-relight-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let (left, right) = (ball(16, LEFT), ball(16, RIGHT));
    write_shard(&folder, "");
    let index = r#"{"format": "diamond-shard 1", "shards": [{"file": "a.safetensors", "split": "train"}]}"#;
    std::fs::write(folder.join("index.json"), index).unwrap();
    let examples = RelightExamples::open(&folder, "train", 16).unwrap();
    assert_eq!(examples.len(), 1);
    for i in 0..8 {
        let RelightExample { view, target: RelightTarget { light, .. }, picture: target } =
            examples.example(3, i, Told::Shape).unwrap();
        // Intensities are divided out: the pictures are those of lights of intensity 1.
        let (source, expected) = if light == RIGHT { (&left, &right) } else { (&right, &left) };
        let near = |a: &Image, b: &Image| a.data().iter().zip(b.data()).all(|(a, b)| (a - b).abs() < 1e-5);
        assert!(near(&view.source, &source.source) && near(&target, &expected.source));
        assert_eq!(view.source_light, source.source_light);
        assert!(examples.others(3, i).is_empty());
    }
    assert!(examples.example(3, 0, Told::Medium).unwrap_err().to_string().contains("beside the shards"));
    let bits = |step| examples.batch(3, step, 2).unwrap().ratios.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert_eq!(bits(5), bits(5));
    let refused = |folder: &std::path::Path, split| RelightExamples::open(folder, split, 16).unwrap_err().to_string();
    assert!(refused(&folder, "test").contains("no view of the split test"));
    write_shard(&folder, "depth");
    assert!(refused(&folder, "train").contains("no tensor depth"));
    std::fs::write(folder.join("index.json"), index.replace("a.safetensors", "../a.safetensors")).unwrap();
    assert!(refused(&folder, "train").contains("plain file name"));
    std::fs::write(folder.join("index.json"), "{}").unwrap();
    assert!(refused(&folder, "train").contains("diamond-shard 1"));
    assert!(refused(&folder.join("none"), "train").contains("diamond shards"));
    std::fs::remove_dir_all(&folder).unwrap();
}

/// A run in a folder: interrupted and resumed it writes the bytes of one that was not, and the model loads with its sizes.
#[test]
fn a_run_in_a_folder_resumes_to_the_same_bytes() {
    let root = std::env::temp_dir().join(format!("diamond-relight-run-{}", std::process::id()));
    let shards = root.join("shards");
    std::fs::create_dir_all(&shards).unwrap();
    write_shard(&shards, "");
    let entry = |split: &str| format!(r#"{{"file": "a.safetensors", "split": "{split}"}}"#);
    let index = format!(r#"{{"format": "diamond-shard 1", "shards": [{}, {}]}}"#, entry("train"), entry("test"));
    std::fs::write(shards.join("index.json"), index).unwrap();
    let settings = TrainSettings { steps: 4, warm_up: 1, ..TrainSettings::default() };
    let training =
        RelightTraining { config: small(), settings, batch: 2, save_every: 2, held_out: 2, test_shards: None };
    let (whole, parts) = (root.join("whole"), root.join("parts"));
    let mut seen = Vec::new();
    let (model, measured) =
        train_relighter(&shards, &whole, &training, false, &mut |report| seen.push(report.step)).unwrap();
    assert_eq!(seen, [1, 2, 3, 4]);
    let measured = measured.unwrap();
    assert!(measured.examples == 2 && measured.relit.psnr.is_finite() && measured.copied.psnr > 0.0, "{measured:?}");
    // Stopped in its fourth step, after the checkpoint of the second.
    let stopped = std::panic::catch_unwind(|| {
        train_relighter(&shards, &parts, &training, false, &mut |report| assert!(report.step < 3, "stopped"))
    });
    assert!(stopped.is_err());
    let again = train_relighter(&shards, &parts, &training, false, &mut |_| {}).unwrap_err().to_string();
    assert!(again.contains("--resume"), "{again}");
    train_relighter(&shards, &parts, &training, true, &mut |_| {}).unwrap();
    for file in ["model.safetensors", "checkpoint.safetensors", "curve.csv"] {
        assert_eq!(std::fs::read(whole.join(file)).unwrap(), std::fs::read(parts.join(file)).unwrap(), "{file}");
    }
    assert_eq!(std::fs::read_to_string(whole.join("curve.csv")).unwrap().lines().count(), 5);
    let loaded = Relighter::load(&model).unwrap();
    assert_eq!(loaded.config(), &small());
    assert!((loaded.expected_error(false).unwrap() - measured.relit.display_rmse()).abs() < 1e-6);
    assert_eq!(loaded.expected_error(true), None);
    let wrong = Relighter::load(&whole.join("checkpoint.safetensors")).unwrap_err().to_string();
    assert!(wrong.contains("no relighter"), "{wrong}");
    std::fs::remove_dir_all(&root).unwrap();
}

/// What a medium predicts of a shard comes back with its shard, divided by the light's intensities as the pictures are; a file of another shard is refused.
#[test]
fn predictions_come_with_their_shard() {
    let folder = std::env::temp_dir().join(format!("diamond-relight-prior-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    write_shard(&folder, "");
    let index = r#"{"format": "diamond-shard 1", "shards": [{"file": "a.safetensors", "split": "train"}]}"#;
    std::fs::write(folder.join("index.json"), index).unwrap();
    let left = ball(16, LEFT);
    let pictures = vec![Image::filled(16, 16, 3, 0.25), Image::filled(16, 16, 3, 1.0)];
    let view = PredictedView { depth: left.depth.map(|z| 1.5 * z), normals: left.normals, pictures };
    write_predictions(&folder.join("a.safetensors"), std::slice::from_ref(&view), "a").unwrap();
    let examples = RelightExamples::open(&folder, "train", 16).unwrap();
    assert!(examples.predicted());
    for i in 0..4 {
        let told = examples.example(3, i, Told::Medium).unwrap();
        let prediction = told.target.prediction.unwrap();
        // The second light is twice as strong.
        let (source, target) = if told.target.light == RIGHT { (0.25, 0.5) } else { (0.5, 0.25) };
        assert_eq!((prediction.source.data()[0], prediction.target.data()[0]), (source, target));
        assert!((told.view.depth.pixel(8, 8)[0] - 1.5 * left.depth.pixel(8, 8)[0]).abs() < 1e-2);
        assert!(examples.example(3, i, Told::Shape).unwrap().target.prediction.is_none());
    }
    assert!(examples.batch(1, 1, 6).is_ok());
    let fewer = PredictedView { pictures: view.pictures[..1].to_vec(), ..view };
    write_predictions(&folder.join("a.safetensors"), &[fewer], "a").unwrap();
    let refused = RelightExamples::open(&folder, "train", 16).unwrap_err().to_string();
    assert!(refused.contains("as in the shard"), "{refused}");
    assert!(write_predictions(&folder.join("a.safetensors"), &[], "a").is_err());
    std::fs::remove_dir_all(&folder).unwrap();
}
