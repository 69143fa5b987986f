//! Writing a capture as nerfstudio's `transforms.json` or as COLMAP model, with its lights in `lights.json`.
//!
//! Images lie in `images/train` and `images/test`. Held-out images are listed in `test_filenames` for nerfstudio and in
//! `held_out_list.txt` for COLMAP.
use crate::write::{
    CaptureDescription, Pixels, ShotDescription, ViewDescription, check_shot, create_folder, encode, numbers,
    provenance_text, sync_folder, whole_or_absent, write_points, write_synced,
};
use crate::{ColmapEncoding, ColmapPoints, DatasetError, Provenance, Split};
use diamond_camera::Intrinsics;
use diamond_light::OlatLight;
use glam::{DMat3, DQuat};
use serde_json::{Map, Value, json};
use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::Path;

/// A view, an image of it, and the image's path below `images`.
type Item<'a> = (Split, &'a ViewDescription, &'a ShotDescription, String);

/// Writes the images to `images/train` and `images/test`, and the lights; what there is, in order.
fn write_images<'a>(
    dir: &Path,
    description: &'a CaptureDescription,
    prefix: &str,
    pixels: &mut impl FnMut(Split, usize, usize) -> Result<Pixels, DatasetError>,
) -> Result<Vec<Item<'a>>, DatasetError> {
    let mut items = Vec::new();
    let mut lights = Map::new();
    for (split, name, views) in [(Split::Train, "train", &description.train), (Split::Test, "test", &description.test)]
    {
        if views.is_empty() {
            continue;
        }
        let folder = dir.join("images").join(name);
        create_folder(&folder)?;
        let mut names = BTreeSet::new();
        for (v, view) in views.iter().enumerate() {
            for (s, shot) in view.shots.iter().enumerate() {
                check_shot(&folder, shot, &mut names)?;
                let path = folder.join(format!("{}.png", shot.name));
                let image = pixels(split, v, s)?;
                write_synced(&path, &encode(&path, &view.camera, &image, description.transfer, description.depth)?)?;
                let relative = format!("{name}/{}.png", shot.name);
                lights.insert(format!("{prefix}{relative}"), light_json(shot));
                items.push((split, view, shot, relative));
            }
        }
        sync_folder(&folder)?;
    }
    let text = format!("{:#}\n", json!({ "images": lights }));
    write_synced(&dir.join("lights.json"), text.as_bytes())?;
    Ok(items)
}

fn light_json(shot: &ShotDescription) -> Value {
    let mut out = Map::new();
    let (field, at, intensity) = match shot.light {
        OlatLight::Point { position, intensity } => ("position", position, intensity),
        OlatLight::Directional { direction, irradiance } => ("direction", direction, irradiance),
    };
    out.insert(field.into(), numbers(&at.to_array()));
    out.insert("intensity".into(), numbers(&intensity.to_array()));
    if shot.weight != 1.0 {
        out.insert("weight".into(), f64::from(shot.weight).into());
    }
    if shot.provenance != Provenance::Photograph {
        out.insert("provenance".into(), provenance_text(&shot.provenance).into());
    }
    Value::Object(out)
}

/// Writes a capture to the folder `dir`, which must not exist yet, as `transforms.json` (camera model `PINHOLE`, one
/// image per frame) with `lights.json`. Otherwise as [`crate::write_capture`].
pub fn write_nerfstudio(
    dir: &Path,
    description: &CaptureDescription,
    mut pixels: impl FnMut(Split, usize, usize) -> Result<Pixels, DatasetError>,
) -> Result<(), DatasetError> {
    whole_or_absent(dir, description, |dir| {
        create_folder(dir)?;
        let items = write_images(dir, description, "images/", &mut pixels)?;
        let files = |split: Split| -> Vec<String> {
            items.iter().filter(|i| i.0 == split).map(|i| format!("images/{}", i.3)).collect()
        };
        let mut root = Map::new();
        root.insert("camera_model".into(), "PINHOLE".into());
        if description.points.is_some() {
            root.insert("ply_file_path".into(), "points3d.ply".into());
        }
        root.insert("train_filenames".into(), json!(files(Split::Train)));
        root.insert("val_filenames".into(), json!(files(Split::Test)));
        root.insert("test_filenames".into(), json!(files(Split::Test)));
        let frames = items.iter().map(|(_, view, _, file)| {
            let matrix = view.camera.pose.to_opengl_camera_to_world().transpose().to_cols_array_2d();
            let k = &view.camera.intrinsics;
            json!({
                "file_path": format!("images/{file}"),
                "transform_matrix": matrix.iter().map(|row| numbers(row)).collect::<Vec<_>>(),
                "fl_x": f64::from(k.fx), "fl_y": f64::from(k.fy), "cx": f64::from(k.cx), "cy": f64::from(k.cy),
                "w": k.width, "h": k.height,
            })
        });
        root.insert("frames".into(), frames.collect());
        let text = format!("{:#}\n", Value::Object(root));
        write_synced(&dir.join("transforms.json"), text.as_bytes())?;
        write_points(dir, description)?;
        sync_folder(dir)
    })
}

/// Writes a capture to the folder `dir`, which must not exist yet, as COLMAP model in `sparse/0` (camera model
/// `PINHOLE`) with `lights.json`. Points go to `points3D`, a point cloud of the description to `points3d.ply`, which is
/// read in preference. Otherwise as [`crate::write_capture`].
pub fn write_colmap(
    dir: &Path,
    description: &CaptureDescription,
    encoding: ColmapEncoding,
    points: &ColmapPoints,
    mut pixels: impl FnMut(Split, usize, usize) -> Result<Pixels, DatasetError>,
) -> Result<(), DatasetError> {
    whole_or_absent(dir, description, |dir| {
        let model = dir.join("sparse").join("0");
        create_folder(&model)?;
        let items = write_images(dir, description, "", &mut pixels)?;
        let mut cameras: Vec<Intrinsics> = Vec::new();
        let mut images = Vec::with_capacity(items.len());
        for (_, view, _, file) in &items {
            let k = view.camera.intrinsics;
            let camera = cameras.iter().position(|c| *c == k).unwrap_or_else(|| {
                cameras.push(k);
                cameras.len() - 1
            });
            let pose = view.camera.pose;
            let q = DQuat::from_mat3(&DMat3::from_cols_array(&pose.rotation.to_cols_array().map(f64::from)));
            let t = pose.translation.as_dvec3();
            images.push(([q.w, q.x, q.y, q.z, t.x, t.y, t.z], camera as u32 + 1, file.as_str()));
        }
        let files = match encoding {
            ColmapEncoding::Text => [
                ("cameras.txt", cameras_text(&cameras).into_bytes()),
                ("images.txt", images_text(&images).into_bytes()),
                ("points3D.txt", points_text(points).into_bytes()),
            ],
            ColmapEncoding::Binary => [
                ("cameras.bin", cameras_binary(&cameras)),
                ("images.bin", images_binary(&images)),
                ("points3D.bin", points_binary(points)),
            ],
        };
        for (name, bytes) in files {
            write_synced(&model.join(name), &bytes)?;
        }
        let held_out: String = items.iter().filter(|i| i.0 == Split::Test).map(|i| format!("{}\n", i.3)).collect();
        if !held_out.is_empty() {
            write_synced(&dir.join("held_out_list.txt"), held_out.as_bytes())?;
        }
        write_points(dir, description)?;
        sync_folder(&model)?;
        sync_folder(dir)
    })
}

/// `qw qx qy qz tx ty tz`, number of the camera, name.
type Image<'a> = ([f64; 7], u32, &'a str);

fn parameters(k: &Intrinsics) -> [f64; 4] {
    [k.fx, k.fy, k.cx, k.cy].map(f64::from)
}

fn cameras_text(cameras: &[Intrinsics]) -> String {
    let mut out = String::from("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n");
    for (i, k) in cameras.iter().enumerate() {
        let [fx, fy, cx, cy] = parameters(k);
        // Writing to a string cannot fail.
        let _ = writeln!(out, "{} PINHOLE {} {} {fx} {fy} {cx} {cy}", i + 1, k.width, k.height);
    }
    out
}

fn images_text(images: &[Image]) -> String {
    let mut out =
        String::from("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n");
    for (i, (v, camera, name)) in images.iter().enumerate() {
        let numbers: Vec<String> = v.iter().map(f64::to_string).collect();
        let _ = writeln!(out, "{} {} {camera} {name}\n", i + 1, numbers.join(" "));
    }
    out
}

fn points_text(points: &ColmapPoints) -> String {
    let mut out = String::from("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n");
    for (i, (p, [r, g, b])) in points.positions.iter().zip(&points.colours).enumerate() {
        let _ = writeln!(out, "{} {} {} {} {r} {g} {b} 0", i + 1, f64::from(p.x), f64::from(p.y), f64::from(p.z));
    }
    out
}

fn cameras_binary(cameras: &[Intrinsics]) -> Vec<u8> {
    let mut out = (cameras.len() as u64).to_le_bytes().to_vec();
    for (i, k) in cameras.iter().enumerate() {
        out.extend((i as u32 + 1).to_le_bytes());
        // PINHOLE
        out.extend(1u32.to_le_bytes());
        out.extend(u64::from(k.width).to_le_bytes());
        out.extend(u64::from(k.height).to_le_bytes());
        parameters(k).iter().for_each(|v| out.extend(v.to_le_bytes()));
    }
    out
}

fn images_binary(images: &[Image]) -> Vec<u8> {
    let mut out = (images.len() as u64).to_le_bytes().to_vec();
    for (i, (v, camera, name)) in images.iter().enumerate() {
        out.extend((i as u32 + 1).to_le_bytes());
        v.iter().for_each(|v| out.extend(v.to_le_bytes()));
        out.extend(camera.to_le_bytes());
        out.extend(name.as_bytes());
        out.push(0);
        out.extend(0u64.to_le_bytes());
    }
    out
}

fn points_binary(points: &ColmapPoints) -> Vec<u8> {
    let mut out = (points.positions.len() as u64).to_le_bytes().to_vec();
    for (i, (p, rgb)) in points.positions.iter().zip(&points.colours).enumerate() {
        out.extend((i as u64 + 1).to_le_bytes());
        p.to_array().iter().for_each(|v| out.extend(f64::from(*v).to_le_bytes()));
        out.extend(rgb);
        out.extend(0f64.to_le_bytes());
        out.extend(0u64.to_le_bytes());
    }
    out
}
