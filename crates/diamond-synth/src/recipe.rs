//! A recipe: everything that a synthetic capture depends on, as TOML.
//!
//! Lengths are scene units with the object inside the unit ball about the origin and z up; angles are degrees. A recipe
//! and its files determine every byte of the capture.
use crate::{SynthError, changed_table};
use diamond_pathtrace::{Boundary, Coat, DistanceField, Material, Medium, Operation, Solid, SurfaceNoise, Veins};
use glam::{EulerRot, Quat, Vec3};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::path::PathBuf;

/// What a capture is made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// What is shown, in a few words.
    pub name: String,
    /// Seed of all random numbers; held-out images use another one that is made from it.
    #[serde(default)]
    pub seed: u64,
    /// The shape.
    pub object: ObjectRecipe,
    /// What it is made of.
    pub material: MaterialRecipe,
    /// Cameras and lights of the training images.
    #[serde(default)]
    pub rig: RigRecipe,
    /// Cameras and lights of the held-out images.
    #[serde(default)]
    pub held_out: HeldOutRecipe,
    /// Pictures.
    #[serde(default)]
    pub film: FilmRecipe,
    /// How much is computed.
    #[serde(default)]
    pub quality: QualityRecipe,
}

/// A shape.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum ObjectRecipe {
    /// A mesh from an OBJ, PLY, glTF or GLB file. It is moved and scaled into the ball of radius `radius`.
    Mesh {
        /// The file; relative paths are relative to the recipe's folder.
        path: PathBuf,
        /// Radius of the ball about the origin that holds the object.
        #[serde(default = "whole_ball")]
        radius: f32,
        /// Which axis of the file points up.
        #[serde(default)]
        up: UpAxis,
        /// Whether normals are interpolated between vertices.
        #[serde(default)]
        smooth: bool,
    },
    /// Solids that flow into each other.
    Solids {
        /// Parts in the order in which they are applied.
        parts: Vec<Part>,
        /// Distance over which parts flow into each other; 0 keeps creases.
        #[serde(default)]
        blend: f32,
        /// Noise on the surface.
        #[serde(default)]
        noise: Option<NoiseRecipe>,
        /// Cells along the longest side when the surface is polygonised.
        #[serde(default = "cells")]
        cells: u32,
    },
    /// A random blend of solids.
    Random {
        /// Which one.
        seed: u64,
        /// Cells along the longest side when the surface is polygonised.
        #[serde(default = "cells")]
        cells: u32,
    },
}

fn whole_ball() -> f32 {
    1.0
}

fn cells() -> u32 {
    64
}

/// An axis of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpAxis {
    /// As in glTF.
    #[default]
    Y,
    /// As here.
    Z,
}

/// A solid and what it does.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Part {
    /// The solid.
    #[serde(flatten)]
    pub solid: SolidRecipe,
    /// Whether it is cut away instead of added.
    #[serde(default)]
    pub cut: bool,
}

/// A solid.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "solid", rename_all = "snake_case")]
pub enum SolidRecipe {
    /// A ball.
    Sphere {
        /// Centre.
        centre: [f32; 3],
        /// Radius.
        radius: f32,
    },
    /// A box with rounded edges.
    Cuboid {
        /// Centre.
        centre: [f32; 3],
        /// Half of each side, rounding included.
        half: [f32; 3],
        /// Radius of edges and corners.
        #[serde(default)]
        rounding: f32,
        /// Turned about x, then y, then z, degrees.
        #[serde(default)]
        rotation: [f32; 3],
    },
    /// All points within `radius` of a segment.
    Capsule {
        /// One end.
        a: [f32; 3],
        /// The other.
        b: [f32; 3],
        /// Radius.
        radius: f32,
    },
    /// A ring.
    Torus {
        /// Centre.
        centre: [f32; 3],
        /// Axis, of any length.
        axis: [f32; 3],
        /// Distance of the ring's middle from the axis.
        major: f32,
        /// Radius of the cross-section.
        minor: f32,
    },
    /// An ellipsoid.
    Ellipsoid {
        /// Centre.
        centre: [f32; 3],
        /// Semi-axes.
        radii: [f32; 3],
        /// Turned about x, then y, then z, degrees.
        #[serde(default)]
        rotation: [f32; 3],
    },
}

/// Noise on a surface.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoiseRecipe {
    /// Largest displacement.
    pub amplitude: f32,
    /// Bumps of the coarsest octave per scene unit.
    pub frequency: f32,
    /// Octaves, 1 to 8.
    pub octaves: u32,
    /// Which noise.
    #[serde(default)]
    pub seed: u64,
}

/// A medium with its boundary and coat.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaterialRecipe {
    /// Extinction per scene unit, per channel.
    pub sigma_t: [f32; 3],
    /// Single-scattering albedo per channel, 0 to 1.
    pub albedo: [f32; 3],
    /// Mean cosine of scattering.
    #[serde(default)]
    pub g: f32,
    /// The boundary to the air.
    #[serde(default)]
    pub boundary: BoundaryRecipe,
    /// A glossy reflection on top.
    #[serde(default)]
    pub coat: Option<CoatRecipe>,
    /// Sheets in which the medium absorbs more; without them it is the same everywhere.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub veins: Option<VeinsRecipe>,
}

/// Sheets in which a medium absorbs more, see [`diamond_pathtrace::Veins`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VeinsRecipe {
    /// Cells of the noise per scene unit.
    pub frequency: f32,
    /// Noise of this size (of about 1) is half out of a vein.
    pub width: f32,
    /// Factor on the albedo in the middle of a vein, per channel, 0 to 1.
    pub factor: [f32; 3],
    /// Which noise.
    #[serde(default)]
    pub seed: u64,
}

/// The boundary to the air.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum BoundaryRecipe {
    /// None: the index of refraction of air.
    #[default]
    Matched,
    /// A polished dielectric.
    Smooth {
        /// Index of refraction.
        eta: f32,
    },
    /// A rough dielectric.
    Rough {
        /// Index of refraction.
        eta: f32,
        /// Perceptual roughness; its square is the width of the GGX lobe.
        roughness: f32,
    },
}

/// A glossy reflection on top.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CoatRecipe {
    /// Perceptual roughness, 0 to 1.
    pub roughness: f32,
    /// Reflectance at normal incidence per channel.
    pub f0: [f32; 3],
}

/// Who moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RigKind {
    /// Cameras and lights on domes around the object.
    #[default]
    Dome,
    /// The object turns before a camera at one elevation, under lights that stay where they are: seen from the object, camera
    /// and lights turn together, and each view has light positions of its own.
    Turntable,
}

/// Cameras and lights.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RigRecipe {
    /// Who moves.
    pub kind: RigKind,
    /// Number of cameras.
    pub views: u32,
    /// Number of lights per view.
    pub lights: u32,
    /// From the origin to the cameras.
    pub camera_distance: f32,
    /// From the origin to the lights.
    pub light_distance: f32,
    /// Lowest elevation of cameras on a dome; elevation of a turntable's camera. Degrees.
    pub camera_elevation: f32,
    /// Lowest elevation of lights, degrees.
    pub light_elevation: f32,
    /// Horizontal angle of view, degrees; from a distance of 4, 29 hold the unit ball.
    pub angle_of_view: f32,
}

impl Default for RigRecipe {
    fn default() -> Self {
        Self {
            kind: RigKind::Dome,
            views: 24,
            lights: 16,
            camera_distance: 4.0,
            light_distance: 4.5,
            camera_elevation: -20.0,
            light_elevation: -10.0,
            angle_of_view: 30.0,
        }
    }
}

/// Held-out images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HeldOutRecipe {
    /// Cameras that no training image has.
    pub views: u32,
    /// Lights of the training images, spread over them.
    pub seen_lights: u32,
    /// Lights that no training image has.
    pub unseen_lights: u32,
}

impl Default for HeldOutRecipe {
    fn default() -> Self {
        Self { views: 8, seen_lights: 4, unseen_lights: 4 }
    }
}

/// Pictures.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FilmRecipe {
    /// Width and height, pixels.
    pub resolution: u32,
    /// Radiance is multiplied by this before it is stored; by default such that one in a hundred covered pixels of the
    /// training images is above 0.9.
    pub exposure: Option<f32>,
    /// Whether PNGs have 16 bits.
    pub sixteen_bits: bool,
    /// Whether linear EXR images are written as well (not multiplied by the exposure).
    pub exr: bool,
    /// Points on the surface in `points3d.ply`.
    pub points: u32,
}

impl Default for FilmRecipe {
    fn default() -> Self {
        Self { resolution: 128, exposure: None, sixteen_bits: false, exr: false, points: 4000 }
    }
}

/// How much is computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct QualityRecipe {
    /// Rays per pixel are the square of this; by default the renderer's.
    pub samples_per_axis: Option<u32>,
    /// Points at which transport is solved.
    pub points: Option<u32>,
    /// Walks from each point.
    pub walks: Option<u32>,
    /// Whether errors are measured against the reference and written into `capture.json`.
    pub measure: bool,
    /// Paths per pixel of that reference.
    pub measured_paths: u32,
}

impl Default for QualityRecipe {
    fn default() -> Self {
        Self { samples_per_axis: None, points: None, walks: None, measure: true, measured_paths: 256 }
    }
}

fn rotation(degrees: [f32; 3]) -> Quat {
    let [x, y, z] = degrees.map(f32::to_radians);
    Quat::from_euler(EulerRot::ZYX, z, y, x)
}

impl SolidRecipe {
    fn solid(&self) -> Solid {
        match *self {
            SolidRecipe::Sphere { centre, radius } => Solid::Sphere { centre: centre.into(), radius },
            SolidRecipe::Cuboid { centre, half, rounding, rotation: r } => {
                Solid::Cuboid { centre: centre.into(), half: half.into(), rounding, rotation: rotation(r) }
            }
            SolidRecipe::Capsule { a, b, radius } => Solid::Capsule { a: a.into(), b: b.into(), radius },
            SolidRecipe::Torus { centre, axis, major, minor } => {
                let axis = Vec3::from(axis).try_normalize().unwrap_or(Vec3::Z);
                Solid::Torus { centre: centre.into(), axis, major, minor }
            }
            SolidRecipe::Ellipsoid { centre, radii, rotation: r } => {
                Solid::Ellipsoid { centre: centre.into(), radii: radii.into(), rotation: rotation(r) }
            }
        }
    }
}

impl ObjectRecipe {
    /// The field of procedural objects.
    pub fn field(&self) -> Option<DistanceField> {
        match self {
            ObjectRecipe::Mesh { .. } => None,
            ObjectRecipe::Solids { parts, blend, noise, .. } => {
                let operation = |cut: bool| if cut { Operation::Difference } else { Operation::Union };
                let parts = parts.iter().map(|part| (operation(part.cut), part.solid.solid())).collect();
                Some(DistanceField { parts, blend: *blend, noise: noise.map(NoiseRecipe::noise) })
            }
            ObjectRecipe::Random { seed, .. } => Some(DistanceField::random(*seed)),
        }
    }
}

impl NoiseRecipe {
    fn noise(self) -> SurfaceNoise {
        let Self { amplitude, frequency, octaves, seed } = self;
        SurfaceNoise { amplitude, frequency, octaves, seed }
    }
}

impl MaterialRecipe {
    /// As the renderer wants it.
    pub fn material(&self) -> Material {
        let veins = self.veins.map(|VeinsRecipe { frequency, width, factor, seed }| Veins {
            frequency,
            width,
            factor: factor.into(),
            seed,
        });
        let medium = Medium { sigma_t: self.sigma_t.into(), albedo: self.albedo.into(), g: self.g, veins };
        let boundary = match self.boundary {
            BoundaryRecipe::Matched => Boundary::IndexMatched,
            BoundaryRecipe::Smooth { eta } => Boundary::Smooth { eta },
            BoundaryRecipe::Rough { eta, roughness } => Boundary::Rough { eta, alpha: roughness * roughness },
        };
        let coat = self.coat.map(|c| Coat { roughness: c.roughness, f0: c.f0.into() });
        Material { medium, boundary, coat }
    }
}

/// Largest numbers of a recipe: what is beyond is more likely a mistake than a wish.
const MAX_VIEWS: u32 = 10_000;
const MAX_LIGHTS: u32 = 4096;
const MAX_RESOLUTION: u32 = 4096;

impl Recipe {
    /// Reads a recipe; `origin` names it in errors.
    ///
    /// # Errors
    /// [`SynthError::Recipe`].
    pub fn parse(text: &str, origin: &str) -> Result<Self, SynthError> {
        Self::parse_changed(text, origin, &[])
    }

    /// Reads a recipe with changes such as `rig.views=4`, see [`changed_table`](crate::changed_table).
    ///
    /// # Errors
    /// [`SynthError::Recipe`].
    pub fn parse_changed(text: &str, origin: &str, changes: &[String]) -> Result<Self, SynthError> {
        let fail = |detail: String| SynthError::Recipe { origin: origin.into(), detail };
        // Without changes, errors say the line.
        let recipe: Result<Recipe, _> = match changes.is_empty() {
            true => toml::from_str(text),
            false => changed_table(text, origin, changes)?.try_into(),
        };
        let recipe = recipe.map_err(|e| fail(e.to_string()))?;
        recipe.check(origin)?;
        Ok(recipe)
    }

    /// `Err` where a value is out of range.
    pub fn check(&self, origin: &str) -> Result<(), SynthError> {
        let fail = |field: &str, expected: &str, found: String| {
            let detail = format!("{field}: expected {expected}, found {found}");
            Err(SynthError::Recipe { origin: origin.into(), detail })
        };
        let counts = [
            ("rig.views", self.rig.views, 1, MAX_VIEWS),
            ("rig.lights", self.rig.lights, 1, MAX_LIGHTS),
            ("held_out.views", self.held_out.views, 0, MAX_VIEWS),
            ("held_out.seen_lights", self.held_out.seen_lights, 0, self.rig.lights),
            ("held_out.unseen_lights", self.held_out.unseen_lights, 0, MAX_LIGHTS),
            ("film.resolution", self.film.resolution, 8, MAX_RESOLUTION),
            ("film.points", self.film.points, 0, 10_000_000),
            ("quality.measured_paths", self.quality.measured_paths, 2, 1 << 20),
        ];
        for (field, found, low, high) in counts {
            if !(low..=high).contains(&found) {
                return fail(field, &format!("{low} to {high}"), found.to_string());
            }
        }
        let rig = &self.rig;
        let ranges = [
            ("rig.camera_distance", rig.camera_distance, 1.05, 1e3),
            ("rig.light_distance", rig.light_distance, 1.05, 1e3),
            ("rig.camera_elevation", rig.camera_elevation, -90.0, 89.0),
            ("rig.light_elevation", rig.light_elevation, -90.0, 89.0),
            ("rig.angle_of_view", rig.angle_of_view, 1.0, 150.0),
            ("film.exposure", self.film.exposure.unwrap_or(1.0), 1e-6, 1e6),
        ];
        for (field, found, low, high) in ranges {
            if !(low..=high).contains(&found) {
                return fail(field, &format!("{low} to {high}"), found.to_string());
            }
        }
        if self.held_out.views > 0 && self.held_out.seen_lights + self.held_out.unseen_lights == 0 {
            return fail("held_out", "lights where there are views", "none".into());
        }
        self.material
            .material()
            .validate()
            .map_err(|e| SynthError::Recipe { origin: origin.into(), detail: format!("material: {e}") })
    }

    /// SHA-256 of all that the recipe says, in hexadecimal: the same for files that differ in comments or in the order of fields.
    pub fn hash(&self) -> String {
        // A recipe came from TOML or from code; as JSON all of its numbers are written with the digits they need.
        let text = serde_json::to_string(self).unwrap_or_default();
        Sha256::digest(text.as_bytes()).iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CANDLE: &str = r#"
name = "a candle"
seed = 3
[object]
kind = "solids"
blend = 0.05
parts = [
  { solid = "capsule", a = [0, 0, -0.6], b = [0, 0, 0.5], radius = 0.35 },
  { solid = "sphere", centre = [0, 0, 1], radius = 0.2, cut = true },
]
[material]
sigma_t = [8, 10, 14]
albedo = [0.99, 0.97, 0.9]
boundary = { kind = "rough", eta = 1.4, roughness = 0.5 }
coat = { roughness = 0.3, f0 = [0.04, 0.04, 0.04] }
[rig]
views = 6
"#;

    #[test]
    fn a_recipe_is_read_and_hashed_by_content() {
        let recipe = Recipe::parse(CANDLE, "candle").unwrap();
        assert_eq!((recipe.rig.views, recipe.rig.lights, recipe.seed), (6, 16, 3));
        let field = recipe.object.field().unwrap();
        assert_eq!(field.parts.len(), 2);
        assert!(field.distance(Vec3::ZERO) < 0.0 && field.distance(Vec3::new(0.0, 0.0, 0.95)) > 0.0);
        let Boundary::Rough { alpha, .. } = recipe.material.material().boundary else { panic!("a rough boundary") };
        assert_eq!(alpha, 0.25);
        let commented = format!("# a comment\n{CANDLE}");
        assert_eq!(Recipe::parse(&commented, "x").unwrap().hash(), recipe.hash());
        let other = Recipe { seed: 4, ..recipe.clone() };
        assert_ne!(other.hash(), recipe.hash());
        let again: Recipe = toml::from_str(&toml::to_string(&recipe).unwrap()).unwrap();
        assert_eq!(again, recipe);
    }

    #[test]
    fn mistakes_name_the_field_and_what_was_expected() {
        let of =
            |from: &str, to: &str| Recipe::parse(&CANDLE.replace(from, to), "candle.toml").unwrap_err().to_string();
        assert!(of("views = 6", "views = 0").contains("candle.toml: rig.views: expected 1 to 10000, found 0"));
        assert!(of("views = 6", "vews = 6").contains("vews"));
        assert!(of("0.97", "1.97").contains("material: "));
        assert!(of("views = 6", "camera_distance = 0.5").contains("rig.camera_distance"));
        assert!(of("views = 6", "camera_distance = nan").contains("NaN"));
    }
}
