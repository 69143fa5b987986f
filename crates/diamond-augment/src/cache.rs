//! Pictures on disk, named by everything that they depend on.
use crate::frame::Packed;
use crate::{AugmentError, Source, Target};
use diamond_camera::Camera;
use diamond_dataset::Capture;
use diamond_light::OlatLight;
use sha2::{Digest, Sha256};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Part of every name: changes where files or what decides them change.
const FORMAT: &str = "diamond-augment 1";

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

fn numbers(hash: &mut Sha256, values: &[f32]) {
    values.iter().for_each(|v| hash.update(v.to_bits().to_le_bytes()));
}

fn of_camera(hash: &mut Sha256, camera: &Camera) {
    let k = &camera.intrinsics;
    hash.update(k.width.to_le_bytes());
    hash.update(k.height.to_le_bytes());
    numbers(hash, &[k.fx, k.fy, k.cx, k.cy]);
    numbers(hash, &camera.pose.rotation.to_cols_array());
    numbers(hash, &camera.pose.translation.to_array());
}

fn of_light(hash: &mut Sha256, light: &OlatLight) {
    let (kind, at, rgb) = match *light {
        OlatLight::Point { position, intensity } => (0u8, position, intensity),
        OlatLight::Directional { direction, irradiance } => (1, direction, irradiance),
    };
    hash.update([kind]);
    numbers(hash, &at.to_array());
    numbers(hash, &rgb.to_array());
}

/// The name of a target's picture: SHA-256 of the source's method and state, the photograph that the target names, the target itself, and the seed.
pub(crate) fn key(capture: &Capture, source: &dyn Source, target: &Target, seed: u64) -> Result<String, AugmentError> {
    let mut hash = Sha256::new();
    for text in [FORMAT, &source.method(), &source.state()] {
        hash.update((text.len() as u64).to_le_bytes());
        hash.update(text.as_bytes());
    }
    let (v, s) = target.photograph;
    if let Some(shot) = capture.train.get(v).and_then(|view| view.shots.get(s)) {
        let inside = shot.path.strip_prefix(&capture.root).unwrap_or(&shot.path);
        let name = inside.components().map(|c| c.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/");
        if let Some(file) = capture.files()?.iter().find(|f| f.name == name) {
            hash.update(file.sha256);
        }
    }
    of_camera(&mut hash, &target.camera);
    of_light(&mut hash, &target.light);
    hash.update([u8::from(target.view.is_some())]);
    hash.update(seed.to_le_bytes());
    Ok(hex(&hash.finalize()))
}

/// Where the picture of a key lies.
pub(crate) fn path(folder: &Path, key: &str) -> PathBuf {
    folder.join(format!("{}.safetensors", &key[..32.min(key.len())]))
}

/// The text that is kept with a picture: its whole key and the hash of its pixels, by which a damaged file is known.
fn about(key: &str, packed: &Packed) -> Result<String, String> {
    let bare = packed.to_bytes("")?;
    Ok(serde_json::json!({ "key": key, "pixels": hex(&Sha256::digest(&bare)) }).to_string())
}

/// The picture that is kept under a key; `None` where there is none, or it is another one's, or damaged.
pub(crate) fn find(folder: &Path, key: &str) -> Option<Packed> {
    let bytes = std::fs::read(path(folder, key)).ok()?;
    let (packed, text) = Packed::parse(&bytes).ok()?;
    (about(key, &packed).ok()? == text).then_some(packed)
}

/// Keeps a picture, whole or not at all.
pub(crate) fn keep(folder: &Path, key: &str, packed: &Packed) -> Result<PathBuf, AugmentError> {
    let path = path(folder, key);
    let fail = |detail: String| AugmentError::File { path: path.clone(), detail };
    let bytes = about(key, packed).and_then(|about| packed.to_bytes(&about)).map_err(fail)?;
    std::fs::create_dir_all(folder).map_err(|e| fail(format!("its folder could not be made: {e}")))?;
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let temporary = folder.join(format!(".{name}.{}.0.tmp", std::process::id()));
    let written = std::fs::File::create(&temporary)
        .and_then(|mut file| file.write_all(&bytes).and_then(|()| file.sync_all()))
        .and_then(|()| std::fs::rename(&temporary, &path));
    written.map_err(|e| {
        // Gives the space back; that the removal may fail as well changes nothing.
        let _ = std::fs::remove_file(&temporary);
        fail(format!("could not be written: {e}; free some space, or name another folder"))
    })?;
    Ok(path)
}
