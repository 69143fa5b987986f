//! `lights.json`: the lights of a capture whose format has no place for them.
//!
//! ```json
//! {
//!   "frame": "world",
//!   "default": { "position": [0, 0, 2], "intensity": [1, 1, 1] },
//!   "images": {
//!     "IMG_0001.jpg": { "direction": [0, 0, 1], "intensity": 0.5 },
//!     "flash_*":      { "frame": "camera", "position": [0.05, 0, 0] },
//!     "*_lamp_3":     { "position": [1, 2, 3] },
//!     "room_07.jpg":  [ { "image": "olat/07_a.png", "position": [1, 0, 2] }, { "image": "olat/07_b.png", "position": [0, 1, 2] } ]
//!   }
//! }
//! ```
//!
//! Keys are image names as the capture writes them, with or without folders and extension; one `*` stands for anything.
//! An exact name goes before a pattern, a pattern with more fixed letters before one with fewer. `frame` is `world` (that
//! of the cameras as the capture writes them), `camera` (x right, y down, z ahead: a flash fixed to the camera), or
//! `original` (the world before nerfstudio's `applied_transform`). A list in place of one light puts other photographs
//! from the same camera in place of the image: the one with which the camera was found, in room light, is not used.
use crate::field::Object;
use crate::frames::{parse_light, parse_provenance, parse_weight};
use crate::{DatasetError, Place, Provenance};
use diamond_camera::Pose;
use diamond_light::OlatLight;
use glam::Mat4;
use serde_json::Value;
use std::cell::RefCell;
use std::collections::BTreeSet;
use std::path::Path;

/// What to add where an image has no light.
pub(crate) const ADD_LIGHTS: &str = "one-light-at-a-time captures need the light of each image: write a file lights.json \
    next to the images' folder, for instance {\"default\": {\"frame\": \"camera\", \"position\": [0.1, 0, 0]}, \
    \"images\": {\"IMG_0001.jpg\": {\"position\": [1.0, 0.5, 2.0], \"intensity\": [1, 1, 1]}, \"*_lamp_2\": \
    {\"direction\": [0, 0, 1]}}} with positions in the world of the cameras; or add light_position to each frame of a \
    transforms file";

/// In which axes a light is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LightFrame {
    /// The cameras' world.
    #[default]
    World,
    /// The camera of the image: x right, y down, z ahead.
    Camera,
    /// The world before `applied_transform`.
    Original,
}

/// The light of one image.
#[derive(Debug, Clone, PartialEq)]
pub struct LightEntry {
    /// The light, in the axes of `frame`.
    pub light: OlatLight,
    /// Its axes.
    pub frame: LightFrame,
    /// Weight of the image in the photometric losses, at least 0.
    pub weight: Option<f32>,
    /// Where the image comes from.
    pub provenance: Option<Provenance>,
    /// In lists: the image to use.
    pub image: Option<String>,
    /// Where this stands, for error messages.
    pub place: Place,
}

/// The content of `lights.json`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Lights {
    /// For images that no rule names.
    pub default: Option<LightEntry>,
    /// Key (a name, or a pattern with one `*`) and lights: one, or several with images.
    pub rules: Vec<(String, Vec<LightEntry>)>,
    used: RefCell<BTreeSet<usize>>,
}

/// Parses and checks the bytes of `lights.json`; `path` is only named in errors.
pub fn parse_lights(path: &Path, bytes: &[u8]) -> Result<Lights, DatasetError> {
    let root = crate::field::parse_json(path, crate::folder::as_text(path, bytes)?)?;
    let top = Object::new(&root, path, None, "an object with \"default\" or \"images\"")?;
    let frame = parse_frame(&top, "frame")?.unwrap_or_default();
    let mut out = Lights::default();
    if let Some(value) = top.get("default") {
        out.default = Some(parse_light_entry(path, value, "default", frame)?);
    }
    match top.get("images") {
        None => {}
        Some(Value::Object(images)) => {
            for (key, value) in images {
                let at = format!("images[\"{key}\"]");
                if key.matches('*').count() > 1 {
                    let advice = "split it into two patterns";
                    return Err(top.error(at, "a name with at most one *", format!("\"{key}\""), advice));
                }
                let lights = match value {
                    Value::Array(list) => {
                        let mut lights = Vec::with_capacity(list.len());
                        for (k, item) in list.iter().enumerate() {
                            let light = parse_light_entry(path, item, &format!("{at}[{k}]"), frame)?;
                            if light.image.is_none() {
                                let advice =
                                    "name the photograph that this light made, relative to the capture's folder";
                                return Err(top.error(format!("{at}[{k}].image"), "a path", "nothing", advice));
                            }
                            lights.push(light);
                        }
                        lights
                    }
                    value => vec![parse_light_entry(path, value, &at, frame)?],
                };
                out.rules.push((plain(key), lights));
            }
        }
        Some(_) => {
            let advice = "write \"images\": {\"NAME\": {\"position\": [x, y, z]}}";
            return Err(top.error("images", "an object from image names to lights", "something else", advice));
        }
    }
    if out.default.is_none() && out.rules.is_empty() {
        let advice = "add the light of at least one image";
        return Err(top.error("images", "\"default\" or at least one entry in \"images\"", "neither", advice));
    }
    Ok(out)
}

fn parse_frame(object: &Object, at: &str) -> Result<Option<LightFrame>, DatasetError> {
    let Some(value) = object.get("frame") else { return Ok(None) };
    match object.as_text(value, at)? {
        "world" => Ok(Some(LightFrame::World)),
        "camera" => Ok(Some(LightFrame::Camera)),
        "original" => Ok(Some(LightFrame::Original)),
        other => Err(object.error(
            at,
            "\"world\", \"camera\" or \"original\"",
            format!("\"{other}\""),
            "say in which axes the light is written",
        )),
    }
}

fn parse_light_entry(path: &Path, value: &Value, at: &str, frame: LightFrame) -> Result<LightEntry, DatasetError> {
    let plain = Place { file: path.to_path_buf(), frame: None, field: Some(at.to_string()) };
    let Value::Object(_) = value else {
        return Err(DatasetError::Field {
            place: plain.into(),
            expected: "an object with position or direction".into(),
            found: "something else".into(),
            advice: "write {\"position\": [x, y, z], \"intensity\": [r, g, b]}",
        });
    };
    let object = Object::new(value, path, None, "an object with position or direction")?;
    let field = |name: &str| (format!("{at}.{name}"), object.get(name));
    let light = parse_light(&object, field("position"), field("direction"), field("intensity"))?.ok_or_else(|| {
        let advice = "add \"position\": [x, y, z] (a lamp) or \"direction\": [x, y, z] (towards a far light)";
        object.error(at, "position or direction", "neither", advice)
    })?;
    Ok(LightEntry {
        light,
        frame: parse_frame(&object, &format!("{at}.frame"))?.unwrap_or(frame),
        weight: object.get("weight").map(|_| parse_weight(&object, field("weight"))).transpose()?,
        provenance: object.get("provenance").map(|_| parse_provenance(&object, field("provenance"))).transpose()?,
        image: object.get("image").map(|v| object.as_text(v, &format!("{at}.image"))).transpose()?.map(str::to_string),
        place: plain,
    })
}

/// A name with `/` between its parts and without a leading `./`.
fn plain(name: &str) -> String {
    name.replace('\\', "/").trim_start_matches("./").to_string()
}

/// Whether `key` names `name`, and with how many fixed letters; exact names count more than any pattern.
fn matches(key: &str, name: &str) -> Option<usize> {
    match key.split_once('*') {
        None => (key == name).then_some(usize::MAX),
        Some((start, end)) => {
            let fits = name.len() >= start.len() + end.len() && name.starts_with(start) && name.ends_with(end);
            fits.then_some(start.len() + end.len())
        }
    }
}

impl Lights {
    /// The lights of an image as the capture names it: those of the best rule, else the default; `None` where neither.
    ///
    /// Errors where two patterns fit equally well.
    pub(crate) fn of(&self, file: &str) -> Result<Option<&[LightEntry]>, DatasetError> {
        let full = plain(file);
        let base = full.rsplit('/').next().unwrap_or_default();
        let bare = crate::exclusions::strip_extension(&full);
        let bare_base = crate::exclusions::strip_extension(base);
        let mut best: Option<(usize, usize)> = None;
        let mut tied = None;
        for (i, (key, _)) in self.rules.iter().enumerate() {
            let Some(fit) = [full.as_str(), base, bare, bare_base].iter().filter_map(|n| matches(key, n)).max() else {
                continue;
            };
            match best {
                Some((_, other)) if other > fit => {}
                Some((j, other)) if other == fit => tied = Some((j, i)),
                _ => (best, tied) = (Some((i, fit)), None),
            }
        }
        if let Some((a, b)) = tied {
            let (key_a, key_b) = (&self.rules[a].0, &self.rules[b].0);
            return Err(DatasetError::Field {
                place: self.rules[a].1.first().map(|e| e.place.clone()).unwrap_or_default().into(),
                expected: format!("one rule for the image \"{file}\""),
                found: format!("\"{key_a}\" and \"{key_b}\", which fit it equally well"),
                advice: "make one of the two keys more specific",
            });
        }
        if let Some((i, _)) = best {
            self.used.borrow_mut().insert(i);
            return Ok(Some(&self.rules[i].1));
        }
        Ok(self.default.as_ref().map(std::slice::from_ref))
    }

    /// Notes rules that named no image.
    pub(crate) fn note_unused(&self, notes: &mut Vec<String>) {
        let used = self.used.borrow();
        for (_, (key, _)) in self.rules.iter().enumerate().filter(|(i, _)| !used.contains(i)) {
            notes.push(format!("lights.json: \"{key}\" names no image of this capture"));
        }
    }
}

impl LightEntry {
    /// The light in the world of the cameras, for an image with this pose. `applied` is the file's `applied_transform`.
    ///
    /// Errors where the axes are `original` and there is no `applied_transform`, or the result is not finite.
    pub(crate) fn in_world(&self, pose: &Pose, applied: Option<&Mat4>) -> Result<OlatLight, DatasetError> {
        let no = |expected: &str, found: &str, advice: &'static str| DatasetError::Field {
            place: self.place.clone().into(),
            expected: expected.into(),
            found: found.into(),
            advice,
        };
        let (point, vector): (&dyn Fn(glam::Vec3) -> glam::Vec3, &dyn Fn(glam::Vec3) -> glam::Vec3) =
            match (self.frame, applied) {
                (LightFrame::World, _) => return Ok(self.light),
                (LightFrame::Camera, _) => (&|p| pose.inverse_transform_point(p), &|d| pose.rotation.transpose() * d),
                (LightFrame::Original, Some(m)) => (&|p| m.transform_point3(p), &|d| m.transform_vector3(d)),
                (LightFrame::Original, None) => {
                    let advice = "write \"frame\": \"world\", or add the transform to transforms.json";
                    return Err(no("an applied_transform in the transforms file", "none", advice));
                }
            };
        let light = match self.light {
            OlatLight::Point { position, intensity } => OlatLight::Point { position: point(position), intensity },
            OlatLight::Directional { direction, irradiance } => OlatLight::Directional {
                direction: vector(direction).try_normalize().ok_or_else(|| {
                    no("a transform that keeps directions", "one that flattens this one", "correct applied_transform")
                })?,
                irradiance,
            },
        };
        light
            .validate()
            .map_err(|e| no("a light that is finite in world axes", &e.to_string(), "correct the light"))?;
        Ok(light)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    fn lights(text: &str) -> Result<Lights, DatasetError> {
        parse_lights(Path::new("lights.json"), text.as_bytes())
    }

    #[test]
    fn names_go_before_patterns_and_long_patterns_before_short_ones() {
        let l = lights(
            r#"{"default": {"position": [0, 0, 0]}, "images": {
            "images/a.png": {"position": [1, 0, 0]}, "a*": {"position": [2, 0, 0]}, "*_l_3": {"position": [3, 0, 0]},
            "./sub\\b": {"position": [4, 0, 0]}}}"#,
        )
        .unwrap();
        let x = |name: &str| match l.of(name).unwrap().unwrap()[0].light {
            OlatLight::Point { position, .. } => position.x,
            _ => f32::NAN,
        };
        assert_eq!(
            [x("images/a.png"), x("abc.jpg"), x("x/r_0_l_3.png"), x("sub/b.exr"), x("z")],
            [1.0, 2.0, 3.0, 4.0, 0.0]
        );
        assert_eq!(x("a_l_3"), 3.0, "more fixed letters");
        let mut notes = vec![];
        lights(r#"{"images": {"q": {"direction": [0, 0, 1]}}}"#).unwrap().note_unused(&mut notes);
        assert!(notes[0].contains("\"q\" names no image"));
        let tie = lights(r#"{"images": {"a*": {"position": [1, 0, 0]}, "*b": {"position": [1, 0, 0]}}}"#).unwrap();
        assert!(tie.of("ab").unwrap_err().to_string().contains("equally well"));
        assert!(tie.of("c").unwrap().is_none());
    }

    #[test]
    fn a_light_fixed_to_the_camera_moves_with_it() {
        let l = lights(
            r#"{"frame": "camera", "default": {"position": [0, 0, 1]}, "images": {
            "far": {"direction": [0, 0, -1], "intensity": 2}, "w": {"frame": "world", "position": [7, 8, 9]},
            "o": {"frame": "original", "position": [1, 2, 3]}}}"#,
        )
        .unwrap();
        let pose = Pose::look_at(Vec3::new(4.0, 0.0, 0.0), Vec3::ZERO, Vec3::Z);
        let at = |name: &str, applied| l.of(name).unwrap().unwrap()[0].in_world(&pose, applied);
        let OlatLight::Point { position, .. } = at("any", None).unwrap() else { panic!() };
        assert!(position.distance(Vec3::new(3.0, 0.0, 0.0)) < 1e-6, "one unit ahead of the camera: {position}");
        let OlatLight::Directional { direction, irradiance } = at("far", None).unwrap() else { panic!() };
        assert!(direction.distance(Vec3::X) < 1e-6 && irradiance == Vec3::splat(2.0), "back to the camera");
        assert_eq!(at("w", None).unwrap().position(), Some(Vec3::new(7.0, 8.0, 9.0)));
        assert!(at("o", None).unwrap_err().to_string().contains("applied_transform"));
        let swap = Mat4::from_cols_array_2d(&[
            [0.0, 1.0, 0.0, 0.0],
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, -1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]);
        assert_eq!(at("o", Some(&swap)).unwrap().position(), Some(Vec3::new(2.0, 1.0, -3.0)));
    }

    #[test]
    fn mistakes_are_named() {
        for (text, part) in [
            ("[]", "an object"),
            ("{}", "neither"),
            (r#"{"default": 3}"#, "default: expected an object"),
            (r#"{"default": {}}"#, "position or direction"),
            (r#"{"default": {"position": [1, 2]}}"#, "default.position"),
            (r#"{"default": {"position": [1, 2, 3], "frame": "lamp"}}"#, "default.frame"),
            (r#"{"images": []}"#, "image names"),
            (r#"{"images": {"a*b*": {"position": [1, 2, 3]}}}"#, "at most one *"),
            (r#"{"images": {"a": [{"position": [1, 2, 3]}]}}"#, "images[\"a\"][0].image"),
            (r#"{"images": {"a": {"direction": [0, 0, 0]}}}"#, "not zero"),
            (r#"{"images": {"a": {"position": [0, 0, 0], "intensity": -1}}}"#, "at least 0"),
        ] {
            let error = lights(text).unwrap_err().to_string();
            assert!(error.contains("lights.json") && error.contains(part), "{text}: {error}");
        }
    }
}
