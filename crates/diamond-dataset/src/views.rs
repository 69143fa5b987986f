//! From frames to views: images found, lights and masks assigned, names made unique.
use crate::develop::Undistortion;
use crate::exclusions::{EXTENSIONS, Exclusions, strip_extension};
use crate::frames::{Entry, Frame, Frames};
use crate::lights::{ADD_LIGHTS, Lights};
use crate::{DatasetError, MaskSource, OpenOptions, Place, Shot, Split, View, folder};
use diamond_camera::Camera;
use diamond_light::OlatLight;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// What the frames of one capture are turned into views with.
pub(crate) struct Context<'a> {
    /// The capture's folder, canonical.
    pub(crate) root: &'a Path,
    /// The file that the frames come from, for error messages.
    pub(crate) file: &'a Path,
    /// Folders below `root` in which images are looked for, in this order.
    pub(crate) image_folders: &'a [&'a str],
    pub(crate) excluded: &'a Exclusions,
    pub(crate) lights: Option<&'a Lights>,
    pub(crate) options: &'a OpenOptions,
}

/// An entry with its light in the world.
struct Lit {
    entry: Entry,
    light: OlatLight,
}

impl Context<'_> {
    /// The views of a split, in the order of the frames. Only frames that `kept` keeps are looked at.
    pub(crate) fn build(
        &self,
        frames: &Frames,
        split: Split,
        kept: &dyn Fn(&Frame) -> bool,
    ) -> Result<Vec<View>, DatasetError> {
        let mut views: Vec<View> = Vec::new();
        let mut first_use: BTreeMap<PathBuf, Place> = BTreeMap::new();
        for frame in frames.frames.iter().filter(|f| kept(f)) {
            let mut shots = Vec::new();
            let mut light_index = 0;
            for entry in &frame.entries {
                for Lit { entry, light } in self.lit(frames, frame, entry)? {
                    light_index += 1;
                    if self.excluded.contains(&entry.file) {
                        continue;
                    }
                    let path = self.find_image(&entry.file, &entry.place)?;
                    if let Some(first) = first_use.insert(path.clone(), entry.place.clone()) {
                        return Err(DatasetError::Field {
                            place: entry.place.into(),
                            expected: "an image that no other entry of the file names".into(),
                            found: format!("\"{}\", already named by {first}", entry.file),
                            advice: "an image has one camera and one light: remove one of the two entries",
                        });
                    }
                    shots.push(Shot {
                        name: path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default(),
                        mask: self.named_mask(&path, &entry)?,
                        path,
                        light,
                        provenance: entry.provenance.clone(),
                        weight: entry.weight,
                        light_index: light_index - 1,
                        width: 0,
                        height: 0,
                        undistortion: None,
                        named_by: entry.place,
                    });
                }
            }
            if shots.is_empty() {
                continue;
            }
            let camera = self.camera(frame, &shots[0])?;
            let undistortion = (!frame.distortion.is_none())
                .then(|| Arc::new(Undistortion { intrinsics: camera.intrinsics, distortion: frame.distortion }));
            for shot in &mut shots {
                (shot.width, shot.height) = (camera.intrinsics.width, camera.intrinsics.height);
                shot.undistortion = undistortion.clone();
            }
            // In the NeRF layout each image is a frame of its own: frames with the same camera are one view.
            if frame.entries.len() == 1
                && let Some(view) =
                    views.iter_mut().find(|view| view.camera == camera && view.shots[0].undistortion == undistortion)
            {
                shots.iter_mut().enumerate().for_each(|(i, shot)| shot.light_index = view.shots.len() + i);
                view.shots.append(&mut shots);
                continue;
            }
            let name = view_name(&shots).unwrap_or_else(|| format!("view_{}", frame.index));
            views.push(View { name, camera, shots, split, index: frame.index, geometry: None });
        }
        make_names_unique(self.root, &mut views);
        self.assign_backgrounds(&mut views);
        Ok(views)
    }

    /// Looks for the true geometry of each view.
    pub(crate) fn find_geometry(&self, views: &mut [View]) {
        for view in views {
            let folder = match view.split {
                Split::Train => "train",
                Split::Test => "test",
            };
            let path = format!("geometry/{folder}_{}.exr", view.name);
            view.geometry = folder::resolve(self.root, &path, &Place::file(self.file)).ok();
        }
    }

    /// An entry with its light: that of the frame, else that (or those) of `lights.json`.
    fn lit(&self, frames: &Frames, frame: &Frame, entry: &Entry) -> Result<Vec<Lit>, DatasetError> {
        if let Some(light) = entry.light {
            return Ok(vec![Lit { entry: entry.clone(), light }]);
        }
        let Some(lights) = self.lights.map(|lights| lights.of(&entry.file)).transpose()?.flatten() else {
            // What is left out needs no light.
            if self.excluded.contains(&entry.file) {
                return Ok(vec![]);
            }
            let mut place = entry.place.clone();
            place.field = Some(entry.light_field.clone());
            return Err(DatasetError::Field {
                place: place.into(),
                expected: "a light position (or direction) for this image".into(),
                found: match self.lights {
                    None => format!("nothing, and no lights.json in {}", self.root.display()),
                    Some(_) => format!("nothing, and neither \"{}\" nor a default in lights.json", entry.file),
                },
                advice: ADD_LIGHTS,
            });
        };
        let mut out = Vec::with_capacity(lights.len());
        for rule in lights {
            let light = rule.in_world(&frame.pose, frames.applied_transform.as_ref())?;
            let mut entry = entry.clone();
            if let Some(file) = &rule.image {
                entry.file.clone_from(file);
                entry.place = rule.place.clone();
                entry.mask = None;
            }
            entry.weight = rule.weight.unwrap_or(entry.weight);
            entry.provenance = rule.provenance.clone().unwrap_or(entry.provenance);
            out.push(Lit { entry, light });
        }
        Ok(out)
    }

    /// The image that an entry names. An extension that can be read is kept; else those are tried in turn.
    fn find_image(&self, written: &str, place: &Place) -> Result<PathBuf, DatasetError> {
        let complete = strip_extension(written).len() < written.len();
        let mut first_error = None;
        for folder in self.image_folders {
            let base = if *folder == "." { String::new() } else { format!("{folder}/") };
            for extension in if complete { &[""][..] } else { &EXTENSIONS[..] } {
                let path = match strip_extension(written).len() {
                    0 => written.to_string(),
                    _ => format!("{base}{written}{extension}"),
                };
                match folder::resolve(self.root, &path, place) {
                    Ok(path) => return Ok(path),
                    Err(e @ DatasetError::Outside { .. }) => return Err(e),
                    Err(e) => first_error = first_error.or(Some(e)),
                }
            }
        }
        // A name with another extension: decoding will say that it cannot be read.
        let other = folder::resolve(self.root, written, place).ok().filter(|p| !complete && p.is_file());
        other.ok_or_else(|| {
            first_error
                .unwrap_or_else(|| DatasetError::Outside { place: place.clone().into(), path: written.to_string() })
        })
    }

    /// The mask of an image: the file that the capture names, else one beside it, else its alpha.
    fn named_mask(&self, image: &Path, entry: &Entry) -> Result<MaskSource, DatasetError> {
        if let Some(mask) = &entry.mask {
            return folder::resolve(self.root, mask, &entry.place).map(MaskSource::File);
        }
        let relative = image.strip_prefix(self.root).unwrap_or(image).to_string_lossy().replace('\\', "/");
        let bare = strip_extension(&relative);
        let (folder, name) = relative.rsplit_once('/').unwrap_or(("", &relative));
        let stem = strip_extension(name);
        let mut candidates = vec![format!("{bare}_mask.png")];
        if self.root.join("masks").is_dir() {
            // The path below the folder of images, as COLMAP's masks have it, and the bare name.
            let below = self.image_folders.iter().filter_map(|f| relative.strip_prefix(&format!("{f}/"))).next();
            let inner = below.unwrap_or(&relative);
            let inner_bare = strip_extension(inner);
            candidates.extend([
                format!("masks/{relative}.png"),
                format!("masks/{bare}.png"),
                format!("masks/{inner}.png"),
                format!("masks/{inner_bare}.png"),
                format!("masks/{name}.png"),
                format!("masks/{stem}.png"),
            ]);
        }
        if !folder.is_empty() {
            candidates.push(format!("{folder}/masks/{stem}.png"));
        }
        let place = Place::file(image);
        let found = candidates.iter().filter(|c| self.root.join(c).is_file());
        let resolved = found.filter_map(|c| folder::resolve(self.root, c, &place).ok()).next();
        Ok(resolved.map_or(MaskSource::Alpha, MaskSource::File))
    }

    /// Where photographs of the background are there, shots without a mask of their own get the most specific.
    fn assign_backgrounds(&self, views: &mut [View]) {
        let place = Place::file(self.file);
        let find =
            |name: &str| EXTENSIONS.iter().find_map(|e| folder::resolve(self.root, &format!("{name}{e}"), &place).ok());
        let (common, folder) = (find("background"), self.root.join("background").is_dir());
        if common.is_none() && !folder {
            return;
        }
        for view in views {
            let of_view = if folder { find(&format!("background/{}", view.name)) } else { None };
            for shot in view.shots.iter_mut().filter(|s| s.mask == MaskSource::Alpha) {
                let of_shot = if folder { find(&format!("background/{}", shot.name)) } else { None };
                if let Some(path) = of_shot.or_else(|| of_view.clone()).or_else(|| common.clone()) {
                    shot.mask = MaskSource::Background(path);
                }
            }
        }
    }

    /// Intrinsics and pose of a frame; a missing image size is read from the header of its first image.
    fn camera(&self, frame: &Frame, first: &Shot) -> Result<Camera, DatasetError> {
        let (width, height) = match (frame.width, frame.height) {
            (Some(w), Some(h)) => (w, h),
            _ => crate::decode::read_size(&first.path, &first.named_by)?,
        };
        if u64::from(width) * u64::from(height) > self.options.max_pixels {
            let max_pixels = self.options.max_pixels;
            let field = Some("width, height".into());
            let named_by = Place { file: self.file.to_path_buf(), frame: Some(frame.index), field };
            return Err(DatasetError::TooLarge {
                path: first.path.clone(),
                named_by: named_by.into(),
                width,
                height,
                max_pixels,
            });
        }
        Ok(Camera { intrinsics: frame.lens.intrinsics(width, height), pose: frame.pose })
    }
}

/// `r_<view>` where all shots are called `r_<view>_l_<light>` with the same view.
fn view_name(shots: &[Shot]) -> Option<String> {
    let mut names = shots.iter().map(|shot| {
        let (view, light) = shot.name.strip_prefix("r_")?.split_once("_l_")?;
        (is_number(view) && is_number(light)).then(|| format!("r_{view}"))
    });
    let first = names.next()??;
    names.all(|name| name.as_deref() == Some(&first)).then_some(first)
}

fn is_number(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit())
}

/// Views and shots whose names collide get the frame's index, or the folder, into their names.
fn make_names_unique(root: &Path, views: &mut [View]) {
    let mut seen = BTreeSet::new();
    for view in views.iter_mut() {
        if !seen.insert(view.name.clone()) {
            view.name = format!("{}_frame_{}", view.name, view.index);
        }
    }
    let mut count: BTreeMap<String, usize> = BTreeMap::new();
    for shot in views.iter().flat_map(|view| &view.shots) {
        *count.entry(shot.name.clone()).or_default() += 1;
    }
    for shot in views.iter_mut().flat_map(|view| &mut view.shots) {
        if count[&shot.name] > 1 {
            let relative = shot.path.strip_prefix(root).unwrap_or(&shot.path).with_extension("");
            shot.name = relative.components().map(|c| c.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("_");
        }
    }
}
