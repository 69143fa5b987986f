//! Readers of Gaussians and points.
use super::asset;
use super::harness::{Answer, Target};
use super::random::Random;
use diamond_splat::{PlyFormat, PointCloud, SplatPly, parse_ply, ply_bytes};
use diamond_splat_files::limits::{PACKED_FACTOR, largest_body};
use diamond_splat_files::{SplatCloud, SplatFormat, WriteOptions, parse, to_bytes};
use std::io::{Read, Write};

/// All of them.
pub fn targets() -> Vec<Target> {
    vec![
        ply(),
        cloud("splats_ply", SplatFormat::Ply, &["plyfile/degree0_ascii.ply", "plyfile/degree3_shuffled_double_be.ply"]),
        cloud("splats_compressed_ply", SplatFormat::CompressedPly, &["splat-transform/degree3.compressed.ply"]),
        cloud("splats_rows", SplatFormat::Splat, &["gsplat.js/rows.splat"]),
        cloud("splats_spz", SplatFormat::Spz, &["splat-transform/degree3_v3.spz", "splat-transform/degree3_v4.spz"]),
        spz_body(),
        cloud("splats_glb", SplatFormat::Glb, &["splat-transform/degree3.glb"]),
        gltf(),
    ]
}

/// A reader of splat files, on files of other programs and one of ours.
fn cloud(name: &'static str, format: SplatFormat, files: &[&str]) -> Target {
    let mut seeds: Vec<Vec<u8>> = files.iter().map(|f| asset(&format!("fixtures/foreign-splats/{f}"))).collect();
    let mut small = SplatCloud::zeros(3, 1);
    small.means[1] = glam::Vec3::new(1.0, -2.0, 0.5);
    if let Ok((bytes, _)) = to_bytes(&small, format, &WriteOptions::default()) {
        seeds.push(bytes);
    }
    let check = move |bytes: &[u8]| {
        let _ = SplatFormat::from_bytes(bytes);
        let file = match parse(bytes, format) {
            Err(e) => return Answer::refused(e),
            Ok(file) => file,
        };
        super::law("cloud of splats", file.cloud.validate())?;
        super::law("cloud of Gaussians", file.cloud.to_gaussians().validate())?;
        let _ = file.cloud.summary().to_text(&file.cloud);
        for to in SplatFormat::ALL {
            let written = match to_bytes(&file.cloud, to, &WriteOptions::default()) {
                Ok((written, _)) => written,
                // Compressed PLY is never written; SPZ has no room for every coordinate, and glTF none for an empty cloud.
                Err(_) if !matches!(to, SplatFormat::Ply | SplatFormat::Splat) => continue,
                Err(e) => return Err(format!("cannot be written as {}: {e}", to.name())),
            };
            let again = match parse(&written, to) {
                Ok(again) => again.cloud,
                Err(e) => return Err(format!("what it writes as {} is refused: {e}", to.name())),
            };
            if again.len() != file.cloud.len() {
                return Err(format!("{} splats become {} as {}", file.cloud.len(), again.len(), to.name()));
            }
            // PLY holds every value as it is, but not what colours mean and not a rotation of zero.
            let exact = again.means == file.cloud.means && again.sh == file.cloud.sh;
            if to == SplatFormat::Ply && !exact {
                return Err("changes in being written as PLY and read".into());
            }
        }
        Ok(Answer::Parsed)
    };
    // Documented: a small compressed file may unfold to 16 MiB, and the cloud to 16 times that.
    let memory = |length: usize| 64 * length + (64 << 20) + PACKED_FACTOR * largest_body(length);
    let plain = |length: usize| 128 * length + (64 << 20);
    let memory = if format == SplatFormat::Spz { memory } else { plain };
    Target { cases: 150, memory, ..Target::new(name, seeds, check) }
}

/// SPZ before version 4, where what is mutated is what was compressed.
fn spz_body() -> Target {
    let target = cloud("splats_spz_body", SplatFormat::Spz, &["splat-transform/degree3_v3.spz"]);
    let unpacked = |bytes: &Vec<u8>| {
        let mut body = Vec::new();
        flate2::read::GzDecoder::new(&bytes[..]).read_to_end(&mut body).unwrap();
        body
    };
    let seeds = target.seeds.iter().map(unpacked).collect();
    let wrap = |body: Vec<u8>, _: &mut Random| {
        let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        packed.write_all(&body).unwrap();
        packed.finish().unwrap()
    };
    Target { seeds, wrap, ..target }
}

/// glTF as text. The buffer of the foreign file lies beside it, so the seed is ours, with its buffer inside.
fn gltf() -> Target {
    let target = cloud("splats_gltf", SplatFormat::Gltf, &[]);
    Target { cases: 300, ..target }.text()
}

fn ply() -> Target {
    let ascii = b"ply\nformat ascii 1.0\ncomment a point cloud\nelement vertex 3\nproperty float x\nproperty double y\n\
        property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n\
        property list uchar int vertex_indices\nend_header\n0 0 0 9 9 9\n0.1 0.2 0.3 1 2 3\n0.3 1e-3 -2 255 0 7\n3 0 1 2\n";
    let splats = SplatPly::from_gaussians(&diamond_splat::Gaussians {
        means: vec![glam::Vec3::X, glam::Vec3::Y],
        scales: vec![glam::Vec3::ONE, glam::Vec3::splat(0.1)],
        rotations: vec![glam::Quat::IDENTITY; 2],
        opacities: vec![0.5, 0.9],
        ..Default::default()
    });
    let bytes = |format| ply_bytes(&splats.to_table(), format).unwrap();
    let seeds = vec![
        ascii.to_vec(),
        bytes(PlyFormat::Ascii),
        bytes(PlyFormat::BinaryLittleEndian),
        bytes(PlyFormat::BinaryBigEndian),
        asset("fixtures/foreign-captures/nerfstudio/sparse_pc.ply"),
    ];
    let check = |bytes: &[u8]| {
        let table = match parse_ply(bytes) {
            Err(e) => return Answer::refused(e),
            Ok(table) => table,
        };
        if table.columns.iter().any(|c| c.values.len() != table.len || c.values.iter().any(|v| !v.is_finite())) {
            return Err("a column that is short or not finite".into());
        }
        if let Ok(points) = PointCloud::from_table(&table)
            && points.positions.iter().any(|p| !p.is_finite())
        {
            return Err("a point that is not finite".into());
        }
        if let Ok(splats) = SplatPly::from_table(&table) {
            super::law("cloud of Gaussians", splats.to_gaussians().validate())?;
            if SplatPly::from_table(&splats.to_table()).map_err(|e| e.to_string())? != splats {
                return Err("splats change in being written and read".into());
            }
        }
        for format in [PlyFormat::Ascii, PlyFormat::BinaryLittleEndian, PlyFormat::BinaryBigEndian] {
            // What cannot be written says so: names and comments may hold what PLY text does not allow again.
            let Ok(written) = ply_bytes(&table, format) else { continue };
            match parse_ply(&written) {
                Ok(again) if again == table => {}
                Ok(_) => return Err(format!("changes in being written as {} and read", format.name())),
                Err(e) => return Err(format!("what it writes as {} is refused: {e}", format.name())),
            }
        }
        Ok(Answer::Parsed)
    };
    Target { cases: 1500, ..Target::new("ply", seeds, check) }
}
