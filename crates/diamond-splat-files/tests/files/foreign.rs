//! Files that other programs wrote, against the values that they were given. Origins: the READMEs beside the files.
use crate::clouds::angle;
use diamond_splat_files::{ColorSpace, SplatCloud, SplatFile, SplatFormat, read};
use glam::{DAffine3, DQuat, Quat, Vec3};
use std::path::PathBuf;

fn fixture(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../assets/fixtures/foreign-splats").join(name)
}

fn load(name: &str) -> SplatFile {
    read(fixture(name)).unwrap()
}

/// What plyfile was given: seeded numbers, degree 3, ten splats.
fn source() -> SplatCloud {
    load("plyfile/degree3.ply").cloud
}

/// Worst differences of each splat of `a` from the splat of `b` that is nearest (programs reorder): position, log-scale,
/// opacity, rotation, degree 0, higher degrees.
fn compare(a: &SplatCloud, b: &SplatCloud) -> [f64; 6] {
    assert_eq!(a.degree, b.degree);
    let width = a.coefficients() * 3;
    let mut out = [0.0f64; 6];
    let mut worst = |k: usize, v: f32| out[k] = out[k].max(f64::from(v));
    for i in 0..a.len() {
        let distance = |j: &usize| a.means[i].distance_squared(b.means[*j]);
        let j = (0..b.len()).min_by(|x, y| distance(x).total_cmp(&distance(y))).unwrap();
        worst(0, (a.means[i] - b.means[j]).abs().max_element());
        worst(1, (a.log_scales[i] - b.log_scales[j]).abs().max_element());
        worst(2, (a.opacity(i) - b.opacity(j)).abs());
        worst(3, ellipsoid_angle(a.rotations[i], b.rotations[j]));
        for k in 0..width {
            worst(if k < 3 { 4 } else { 5 }, (a.sh[i * width + k] - b.sh[j * width + k]).abs());
        }
    }
    println!("{}", out.map(|v| format!("{v:.2e}")).join(" "));
    out
}

/// Angle between two orientations of an ellipsoid, radians: half turns about its own axes leave it as it is.
fn ellipsoid_angle(a: Quat, b: Quat) -> f32 {
    let same = [
        Quat::IDENTITY,
        Quat::from_xyzw(1.0, 0.0, 0.0, 0.0),
        Quat::from_xyzw(0.0, 1.0, 0.0, 0.0),
        Quat::from_xyzw(0.0, 0.0, 1.0, 0.0),
    ];
    same.iter().map(|turn| angle(a, b * *turn) as f32).fold(f32::INFINITY, f32::min)
}

fn assert_within(found: [f64; 6], limits: [f64; 6]) {
    assert!(found.iter().zip(limits).all(|(f, l)| *f <= l), "{found:?} above {limits:?}");
}

fn half_turn(mut cloud: SplatCloud, axis: Vec3) -> SplatCloud {
    cloud.transform(DAffine3::from_quat(DQuat::from_axis_angle(axis.as_dvec3(), std::f64::consts::PI)));
    cloud
}

#[test]
fn plyfile_little_endian() {
    let file = load("plyfile/degree3.ply");
    assert_eq!((file.format, file.cloud.len(), file.cloud.degree, file.notes.len()), (SplatFormat::Ply, 10, 3, 0));
    // The first values as plyfile prints them.
    let c = &file.cloud;
    assert_eq!(c.means[0], Vec3::new(0.3752864, 1.1916414, 0.82705706));
    assert_eq!((c.rotations[0].w, c.rotations[0].x), (-0.99354523, 0.04380955));
    assert_eq!((c.sh[0], c.sh[3], c.opacity_logits[0]), (-0.010_005_007, 0.14707875, 2.358759));
    // f_rest_15 is green of the first coefficient above degree 0.
    assert_eq!(c.sh[4], 0.483_104_05);
    assert_eq!(c.normals, None);
}

#[test]
fn plyfile_shuffled_doubles_big_endian_and_text() {
    let file = load("plyfile/degree3_shuffled_double_be.ply");
    assert_eq!(file.cloud, source());
    assert_eq!(file.notes, ["properties not read: segment, confidence", "elements not read: face"]);
    let text = load("plyfile/degree0_ascii.ply");
    let mut expected = source();
    expected.limit_degree(0);
    assert_eq!((text.cloud, text.notes.len()), (expected, 0));
}

#[test]
fn splat_transform_compressed_ply() {
    let file = load("splat-transform/degree3.compressed.ply");
    assert_eq!((file.format, file.notes.len()), (SplatFormat::CompressedPly, 0));
    // The same as the program that wrote it reads.
    let back = load("splat-transform/degree3_compressed_back.ply").cloud;
    assert_within(compare(&file.cloud, &back), [1e-6, 1e-6, 1e-6, 1e-6, 2e-6, 1e-6]);
    // Close to what it was given: the chunk spans 3 units, its scales 4.
    assert_within(compare(&file.cloud, &source()), [1.6e-3, 2.1e-3, 2.1e-3, 2.9e-3, 0.024, 0.017]);
}

#[test]
fn splat_transform_compressed_ply_of_two_chunks() {
    let all = load("splat-transform/many.compressed.ply").cloud;
    assert_eq!((all.len(), all.degree), (300, 0));
    let some = load("splat-transform/many_every29.ply").cloud;
    for j in 0..some.len() {
        let i = 29 * j;
        assert!((all.means[i] - some.means[j]).abs().max_element() < 1e-6);
        assert!((all.log_scales[i] - some.log_scales[j]).abs().max_element() < 1e-6);
        assert!(angle(all.rotations[i], some.rotations[j]) < 1e-6);
    }
    assert_within(compare(&some, &all), [1e-6, 1e-6, 1e-6, 1e-6, 2e-6, 0.0]);
}

#[test]
fn splat_transform_spz() {
    // Written by Adobe's build of Niantic's library; it takes PLY for y down and z ahead and turns it half round x
    // (rotations as R·q·R⁻¹, which is the same ellipsoid as R·q).
    let expected = half_turn(source(), Vec3::X);
    for name in ["splat-transform/degree3_v3.spz", "splat-transform/degree3_v4.spz"] {
        let file = load(name);
        assert_eq!((file.format, file.notes.len()), (SplatFormat::Spz, 0));
        // Harmonics in 5 and 4 bits: that library's choice.
        assert_within(compare(&file.cloud, &expected), [1.3e-4, 0.032, 2e-3, 3.6e-3, 0.0132, 0.0665]);
    }
    assert_eq!(load("splat-transform/degree3_v3.spz").cloud, load("splat-transform/degree3_v4.spz").cloud);
}

#[test]
fn splat_transform_glb() {
    let file = load("splat-transform/degree3.glb");
    assert_eq!((file.format, file.notes.len(), file.cloud.color_space), (SplatFormat::Glb, 0, ColorSpace::Display));
    // The program takes PLY for upside down and turns it half round z.
    let expected = half_turn(source(), Vec3::Z);
    assert_within(compare(&file.cloud, &expected), [1e-6, 6e-7, 1e-7, 1e-6, 0.0, 2e-6]);
}

#[test]
fn pygltflib_with_nodes_and_short_integers() {
    let file = load("pygltflib/node_transform.gltf");
    assert_eq!((file.cloud.color_space, file.notes.len()), (ColorSpace::Linear, 0));
    let mut expected = source();
    expected.limit_degree(1);
    expected.means.truncate(4);
    expected.log_scales.truncate(4);
    expected.rotations.truncate(4);
    expected.opacity_logits.truncate(4);
    expected.sh.truncate(48);
    // Turned a quarter round x, doubled, moved: first the child, then its parent.
    for i in 0..4 {
        let m = expected.means[i];
        expected.means[i] = Vec3::new(m.x, -m.z, m.y) * 2.0 + Vec3::new(1.0, 2.0, 3.0);
        expected.log_scales[i] += Vec3::splat(2f32.ln());
        expected.rotations[i] = Quat::from_rotation_x(std::f32::consts::FRAC_PI_2) * expected.rotations[i];
        // Degree 1 is −y, z, −x times its coefficients: a vector, turned as one.
        for channel in 0..3 {
            let c = |k: usize| expected.sh[i * 12 + k * 3 + channel];
            let v = Vec3::new(-c(3), -c(1), c(2));
            let v = Vec3::new(v.x, -v.z, v.y);
            expected.sh[i * 12 + 3 + channel] = -v.y;
            expected.sh[i * 12 + 6 + channel] = v.z;
            expected.sh[i * 12 + 9 + channel] = -v.x;
        }
    }
    assert_within(compare(&file.cloud, &expected), [1e-6, 1e-6, 2e-3, 1e-4, 0.0, 1e-6]);
}

#[test]
fn gsplat_js_rows() {
    let file = load("gsplat.js/rows.splat");
    let text = std::fs::read_to_string(fixture("gsplat.js/rows.json")).unwrap();
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    let list = |name: &str| -> Vec<f32> {
        json[name].as_array().unwrap().iter().map(|v| v.as_f64().unwrap() as f32).collect()
    };
    let (p, r, s, c) = (list("P"), list("R"), list("S"), list("C"));
    assert_eq!(file.cloud.len(), 6);
    for i in 0..6 {
        assert_eq!(file.cloud.means[i], Vec3::from_slice(&p[i * 3..]));
        let scale = file.cloud.to_gaussians().scales[i];
        assert!((scale / Vec3::from_slice(&s[i * 3..]) - 1.0).abs().max_element() < 5e-7);
        assert!(
            angle(file.cloud.rotations[i], Quat::from_xyzw(r[i * 4 + 1], r[i * 4 + 2], r[i * 4 + 3], r[i * 4])) < 0.021
        );
        let color = file.cloud.base_color(i) * 255.0;
        assert!((color - Vec3::from_slice(&c[i * 4..])).abs().max_element() < 1e-4);
        assert!((file.cloud.opacity(i) * 255.0 - c[i * 4 + 3]).abs() < 1e-4);
    }
}
