//! Laws: what is written is read back, exactly where the format is float, within a step where it is not; moving a cloud
//! moves what is seen.
use crate::clouds::{angle, cloud};
use diamond_splat_files::{ColorSpace, SplatCloud, SplatFormat, WriteOptions, parse, rotate_harmonics, to_bytes};
use glam::{DAffine3, DMat3, DQuat, DVec3, Quat, Vec3};
use proptest::prelude::*;

fn round_trip(cloud: &SplatCloud, format: SplatFormat, spz_version: u32) -> SplatCloud {
    let (bytes, _) = to_bytes(cloud, format, &WriteOptions { spz_version }).unwrap();
    let file = parse(&bytes, format).unwrap();
    assert_eq!((file.format, file.notes.as_slice()), (format, &[][..]));
    if format != SplatFormat::Splat {
        assert_eq!(SplatFormat::from_bytes(&bytes), Some(format));
    }
    file.cloud
}

/// Largest differences: position, log-scale, opacity, rotation (radians), coefficients of degree 0 and above.
fn differences(a: &SplatCloud, b: &SplatCloud) -> [f64; 6] {
    assert_eq!((a.len(), a.degree), (b.len(), b.degree));
    let mut out = [0.0f64; 6];
    let mut worst = |k: usize, v: f64| out[k] = out[k].max(v);
    let width = a.coefficients() * 3;
    for i in 0..a.len() {
        worst(0, f64::from((a.means[i] - b.means[i]).abs().max_element()));
        worst(1, f64::from((a.log_scales[i] - b.log_scales[i]).abs().max_element()));
        worst(2, f64::from((a.opacity(i) - b.opacity(i)).abs()));
        if a.rotations[i].length_squared() > 1e-3 {
            worst(3, angle(a.rotations[i], b.rotations[i]));
        }
        for k in 0..width {
            worst(if k < 3 { 4 } else { 5 }, f64::from((a.sh[i * width + k] - b.sh[i * width + k]).abs()));
        }
    }
    out
}

fn within(found: [f64; 6], limits: [f64; 6]) -> Result<(), TestCaseError> {
    for k in 0..6 {
        prop_assert!(found[k] <= limits[k], "quantity {k}: {} above {}", found[k], limits[k]);
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn ply_keeps_every_bit(mut cloud in cloud(12), linear in any::<bool>(), normals in any::<bool>()) {
        cloud.color_space = if linear { ColorSpace::Linear } else { ColorSpace::Display };
        cloud.normals = normals.then(|| cloud.means.iter().map(|m| m.normalize_or(Vec3::X)).collect());
        prop_assert_eq!(round_trip(&cloud, SplatFormat::Ply, 3), cloud);
    }

    #[test]
    fn gltf_keeps_floats(mut cloud in cloud(12), text in any::<bool>(), linear in any::<bool>()) {
        cloud.color_space = if linear { ColorSpace::Linear } else { ColorSpace::Display };
        let back = round_trip(&cloud, if text { SplatFormat::Gltf } else { SplatFormat::Glb }, 3);
        prop_assert_eq!((&back.means, &back.sh, back.color_space), (&cloud.means, &cloud.sh, cloud.color_space));
        // One step of 32 bits at 8 is 4.8e-7.
        within(differences(&cloud, &back), [0.0, 6.1e-7, 6e-8, 3e-7, 0.0, 0.0])?;
        // A second trip changes nothing that the file holds.
        let again = round_trip(&back, SplatFormat::Glb, 3);
        within(differences(&back, &again), [0.0, 6.1e-7, 6e-8, 3e-7, 0.0, 0.0])?;
    }

    #[test]
    fn splat_rows_keep_what_they_hold(mut cloud in cloud(12)) {
        cloud.limit_degree(0);
        let back = round_trip(&cloud, SplatFormat::Splat, 3);
        // Colour: half of 1/255 over Y₀₀. Rotation: half steps of 1/128 in four components, and 1 is not to be had (127/128).
        within(differences(&cloud, &back), [0.0, 6.1e-7, 0.5001 / 255.0, 0.021, 0.5001 / 255.0 / 0.2820948, 0.0])?;
    }

    #[test]
    fn spz_keeps_steps(cloud in cloud(12), version in 3u32..=4) {
        let back = round_trip(&cloud, SplatFormat::Spz, version);
        let largest = cloud.means.iter().map(|m| m.abs().max_element()).fold(0.0f32, f32::max);
        // 2¹⁸ steps to the largest coordinate, or 4096 per unit where that is finer.
        let step = (f64::from(largest) / f64::from(1 << 18)).min(1.0 / 4096.0).max(1.0 / f64::from(1 << 23));
        // Rotation: three components to h = half of a step of 1/(511·√2); where all four are ½ the fourth is then off by 3·h, the angle by 2·h·√12.
        let angle = 2.0 * 12f64.sqrt() * 0.51 / (511.0 * 2f64.sqrt());
        let limits =
            [0.5001 * step, 0.5001 / 16.0, 0.5001 / 255.0, angle, 0.5001 / 255.0 / 0.15, 0.5001 / 128.0];
        within(differences(&cloud, &back), limits)?;
        prop_assert_eq!(round_trip(&back, SplatFormat::Spz, version).sh, back.sh);
    }

    #[test]
    fn colours_turn_with_the_cloud(
        cloud in cloud(2), q in prop::array::uniform4(-1.0f64..1.0), d in prop::array::uniform3(-1.0f32..1.0), mirror in any::<bool>()
    ) {
        let q = DQuat::from_array(q);
        let d = Vec3::from(d);
        prop_assume!(q.length() > 0.1 && d.length() > 0.1);
        let turn = DMat3::from_quat(q.normalize()) * if mirror { -1.0 } else { 1.0 };
        let mut turned = cloud.clone();
        let coefficients = cloud.coefficients();
        rotate_harmonics(&mut turned.sh, coefficients, turn);
        let d = d.normalize();
        let there = (turn * d.as_dvec3()).as_vec3().normalize();
        for i in 0..cloud.len() {
            let (a, b) = (cloud.color(i, d), turned.color(i, there));
            prop_assert!((a - b).abs().max_element() < 2e-5, "{a} {b}");
        }
    }

    #[test]
    fn covariances_follow_the_map(
        cloud in cloud(2), entries in prop::array::uniform9(-1.0f64..1.0), similar in any::<bool>(), size in 0.2f64..4.0
    ) {
        let mut a = DMat3::from_cols_array(&entries);
        if similar {
            let q = DQuat::from_array([entries[0], entries[1], entries[2], entries[3] + 1.5]).normalize();
            a = DMat3::from_quat(q) * size * if entries[4] < 0.0 { -1.0 } else { 1.0 };
        }
        prop_assume!(a.determinant().abs() > 0.05);
        let shift = DVec3::new(1.0, -2.0, 0.5);
        let mut moved = cloud.clone();
        moved.transform(DAffine3::from_mat3_translation(a, shift));
        for i in 0..cloud.len() {
            prop_assume!(cloud.rotations[i].length() > 0.01);
            let sigma = |c: &SplatCloud| {
                let r = DMat3::from_quat(c.rotations[i].as_dquat().normalize());
                let s = DMat3::from_diagonal((c.log_scales[i].as_dvec3() * 2.0).exp());
                r * s * r.transpose()
            };
            let (expected, found) = (a * sigma(&cloud) * a.transpose(), sigma(&moved));
            let size = expected.to_cols_array().iter().fold(0.0f64, |m, v| m.max(v.abs()));
            let error = (expected - found).to_cols_array().iter().fold(0.0f64, |m, v| m.max(v.abs())) / size;
            prop_assert!(error < 1e-5, "{error}");
            let mean = a * cloud.means[i].as_dvec3() + shift;
            prop_assert!((mean - moved.means[i].as_dvec3()).length() < 1e-5);
        }
    }
}

#[test]
fn a_half_turn_twice_is_nothing() {
    let cloud = crate::clouds::sample(20, 3);
    let mut turned = cloud.clone();
    let half = DAffine3::from_quat(DQuat::from_rotation_x(std::f64::consts::PI));
    assert_eq!(turned.transform(half), None);
    assert!(differences(&cloud, &turned)[0] > 1.0);
    turned.transform(half);
    let d = differences(&cloud, &turned);
    assert!(d.iter().all(|v| *v < 2e-6), "{d:?}");
}

#[test]
fn the_comparison_notices_a_difference() {
    let cloud = crate::clouds::sample(3, 1);
    let mut other = cloud.clone();
    other.rotations[1] *= Quat::from_rotation_x(0.01);
    other.sh[4] += 0.1;
    let d = differences(&cloud, &other);
    assert!(
        within(d, [0.0, 0.0, 0.0, 0.009, 0.0, 0.2]).is_err() && within(d, [0.0, 0.0, 0.0, 0.011, 0.0, 0.09]).is_err()
    );
    assert!(within(d, [0.0, 0.0, 0.0, 0.011, 0.0, 0.11]).is_ok());
}

#[test]
fn what_is_lost_is_said() {
    let mut cloud = crate::clouds::sample(4, 2);
    cloud.color_space = ColorSpace::Linear;
    cloud.normals = Some(vec![Vec3::Z; 4]);
    cloud.sh[3] = 1.7;
    let said = |format| to_bytes(&cloud, format, &WriteOptions::default()).unwrap().1.join("\n");
    assert_eq!(said(SplatFormat::Ply), "");
    assert_eq!(said(SplatFormat::Glb), "normals are not in a .glb");
    assert!(said(SplatFormat::Splat).contains("degree 2") && said(SplatFormat::Splat).contains("too dark"));
    assert!(said(SplatFormat::Spz).contains("1 of 4 harmonics outside [−1, 1]"));
    assert!(to_bytes(&cloud, SplatFormat::CompressedPly, &WriteOptions::default()).is_err());
}
