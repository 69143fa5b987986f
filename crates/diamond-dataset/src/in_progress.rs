//! A capture that takes long to make: written image by image, and finished later, perhaps by another process.
//!
//! Everything lies in a hidden folder beside the capture until [`CaptureInProgress::finish`] renames it. Each file in it is
//! whole or absent, so that whoever goes on knows what is done.
use crate::write::{
    check_new, create_folder, encode, frames, image_path, splits, sync_folder, write_points, write_synced,
    write_transforms,
};
use crate::{CaptureDescription, DatasetError, Pixels, Split};
use std::path::{Path, PathBuf};

/// Holds the text by which a capture in progress is recognised; not part of the finished capture.
const IDENTITY: &str = ".identity";

/// A capture being written.
#[derive(Debug)]
pub struct CaptureInProgress {
    dir: PathBuf,
    folder: PathBuf,
    description: CaptureDescription,
}

impl CaptureInProgress {
    /// Begins to write the capture `dir`, which must not exist, or goes on with it. `identity` says what is written (for instance
    /// a hash of a recipe): what was begun with another identity is not continued.
    ///
    /// # Errors
    /// The capture exists, its unfinished folder belongs to another identity, names are unusable or not unique, no training
    /// image, or the system's.
    pub fn open(dir: &Path, description: CaptureDescription, identity: &str) -> Result<Self, DatasetError> {
        let name = check_new(dir, &description)?;
        let parent = dir.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let folder = parent.join(format!(".{name}.in-progress"));
        create_folder(&folder)?;
        let path = folder.join(IDENTITY);
        match std::fs::read_to_string(&path) {
            Ok(found) if found == identity => {}
            Ok(_) => {
                let reason = "an unfinished capture of another recipe lies here; remove the folder, or choose another \
                              capture's name";
                return Err(DatasetError::Write { path: folder, reason: reason.into() });
            }
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => write_synced(&path, identity.as_bytes())?,
            Err(e) => return Err(DatasetError::io(&path, "read the file", e)),
        }
        for (_, split, views) in splits(&description) {
            frames(&folder, split, views)?;
            create_folder(&folder.join(split))?;
        }
        Ok(Self { dir: dir.to_path_buf(), folder, description })
    }

    /// What is written.
    pub fn description(&self) -> &CaptureDescription {
        &self.description
    }

    /// The hidden folder. Other files that belong to the capture may be put there, see [`CaptureInProgress::write_file`].
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    fn path(&self, split: Split, view: usize, shot: usize) -> Option<PathBuf> {
        let (_, folder, views) = splits(&self.description).find(|(s, ..)| *s == split)?;
        Some(image_path(&self.folder, folder, views.get(view)?.shots.get(shot)?))
    }

    /// Whether an image is there already.
    pub fn has(&self, split: Split, view: usize, shot: usize) -> bool {
        self.path(split, view, shot).is_some_and(|path| path.exists())
    }

    /// Writes one image, see [`write_capture`](crate::write_capture).
    ///
    /// # Errors
    /// An image that is not described, has another size than its camera or is not finite, or the system's.
    pub fn write(&self, split: Split, view: usize, shot: usize, pixels: &Pixels) -> Result<(), DatasetError> {
        let Some(path) = self.path(split, view, shot) else {
            let reason = format!("there is no image {shot} of view {view} in this split; describe it first");
            return Err(DatasetError::Write { path: self.folder.clone(), reason });
        };
        let views = if split == Split::Train { &self.description.train } else { &self.description.test };
        let (transfer, depth) = (self.description.transfer, self.description.depth);
        let bytes = encode(&path, &views[view].camera, pixels, transfer, depth)?;
        self.put(&path, &bytes)
    }

    /// Writes another file of the capture, by its name relative to the capture.
    pub fn write_file(&self, name: &str, bytes: &[u8]) -> Result<(), DatasetError> {
        let path = self.folder.join(name);
        if let Some(parent) = path.parent() {
            create_folder(parent)?;
        }
        self.put(&path, bytes)
    }

    fn put(&self, path: &Path, bytes: &[u8]) -> Result<(), DatasetError> {
        let mut temporary = path.as_os_str().to_owned();
        temporary.push(".partial");
        let temporary = PathBuf::from(temporary);
        write_synced(&temporary, bytes)?;
        std::fs::rename(&temporary, path).map_err(|e| DatasetError::io(path, "rename the finished file", e))
    }

    /// Writes what names the images, and gives the capture its name.
    ///
    /// # Errors
    /// An image is missing, or the system's.
    pub fn finish(self) -> Result<(), DatasetError> {
        for (_, folder, views) in splits(&self.description) {
            for shot in views.iter().flat_map(|view| &view.shots) {
                let path = image_path(&self.folder, folder, shot);
                if !path.exists() {
                    let reason = "this image was not written yet; write all images first".into();
                    return Err(DatasetError::Write { path, reason });
                }
            }
        }
        write_transforms(&self.folder, &self.description)?;
        write_points(&self.folder, &self.description)?;
        sync_folder(&self.folder)?;
        std::fs::rename(&self.folder, &self.dir)
            .map_err(|e| DatasetError::io(&self.dir, "rename the finished capture", e))?;
        // From here on the capture is whole.
        let identity = self.dir.join(IDENTITY);
        std::fs::remove_file(&identity).map_err(|e| DatasetError::io(&identity, "remove the file", e))?;
        sync_folder(self.dir.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new(".")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{BitDepth, Capture, OpenOptions, Provenance, ShotDescription, ViewDescription};
    use diamond_camera::{Camera, Intrinsics, Pose};
    use diamond_image::{Image, Mask, Transfer};
    use diamond_light::OlatLight;
    use glam::Vec3;

    fn description() -> CaptureDescription {
        let pose = Pose::look_at(Vec3::new(0.0, -4.0, 0.0), Vec3::ZERO, Vec3::Z);
        let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.6, 4, 3), pose };
        let shot = |k: usize| ShotDescription {
            name: format!("r_0_l_{k}"),
            light: OlatLight::Point { position: Vec3::new(k as f32, 0.0, 4.0), intensity: Vec3::ONE },
            provenance: Provenance::Photograph,
            weight: 1.0,
        };
        let train = vec![ViewDescription { camera, shots: vec![shot(0), shot(1)] }];
        let (transfer, depth) = (Transfer::Srgb, BitDepth::Sixteen);
        CaptureDescription { train, test: Vec::new(), points: None, transfer, depth }
    }

    fn pixels(value: f32) -> Pixels {
        (Image::filled(4, 3, 3, value), Mask::from_vec(4, 3, vec![1.0; 12]).ok())
    }

    #[test]
    fn it_goes_on_where_it_was_left_and_appears_whole() {
        let parent = std::env::temp_dir().join(format!("diamond-in-progress-{}", std::process::id()));
        let dir = parent.join("capture");
        let first = CaptureInProgress::open(&dir, description(), "a").unwrap();
        assert!(!first.has(Split::Train, 0, 0));
        first.write(Split::Train, 0, 0, &pixels(0.25)).unwrap();
        assert!(first.finish().unwrap_err().to_string().contains("r_0_l_1.png"));
        assert!(!dir.exists());
        let other = CaptureInProgress::open(&dir, description(), "b").unwrap_err();
        assert!(other.to_string().contains("another recipe"), "{other}");
        let again = CaptureInProgress::open(&dir, description(), "a").unwrap();
        assert!(again.has(Split::Train, 0, 0) && !again.has(Split::Train, 0, 1));
        assert!(again.write(Split::Test, 0, 0, &pixels(0.5)).is_err());
        again.write(Split::Train, 0, 1, &pixels(0.5)).unwrap();
        again.write_file("geometry/x.txt", b"x").unwrap();
        again.finish().unwrap();
        let capture = Capture::open(&dir, &OpenOptions::default()).unwrap();
        assert_eq!(capture.train[0].shots.len(), 2);
        assert!(dir.join("geometry/x.txt").exists() && !dir.join(IDENTITY).exists());
        assert!(CaptureInProgress::open(&dir, description(), "a").is_err());
        std::fs::remove_dir_all(&parent).unwrap();
    }
}
