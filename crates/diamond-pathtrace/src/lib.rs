//! Ground-truth light transport: closed meshes filled with a scattering medium, traced without bias.
//!
//! Invariant: nothing here knows of splats, networks or captures. It is the referee of what the other packages compute, so it shares
//! no formula with them, and its own are tested against values from the literature and pictures of another renderer.
//!
//! An object is a [`Geometry`] (a mesh in a bounding volume hierarchy, or an exact sphere or slab), a [`Material`] (a homogeneous
//! [`Medium`], a [`Boundary`], perhaps a [`Coat`]); with its [`Light`]s it is a [`Scene`]. [`render_reference`] makes one picture for each
//! light from the same paths, with the standard error of every pixel.
//!
//! ```
//! use diamond_camera::{Camera, Intrinsics, Pose};
//! use diamond_pathtrace::{Geometry, Light, Material, Medium, ReferenceOptions, Scene, render_reference};
//! use glam::Vec3;
//! let scene = Scene {
//!     geometry: Geometry::Sphere { centre: Vec3::ZERO, radius: 1.0 },
//!     material: Material::index_matched(Medium::gray(4.0, 0.9, 0.0)),
//!     lights: vec![Light::directional(Vec3::Z, Vec3::ONE), Light::directional(Vec3::X, Vec3::ONE)],
//! };
//! let pose = Pose::look_at(Vec3::new(0.0, 0.0, 4.0), Vec3::ZERO, Vec3::Y);
//! let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.6, 8, 8), pose };
//! let image = render_reference(&scene, &camera, &ReferenceOptions { samples: 16, ..Default::default() })?;
//! assert_eq!(image.lights.len(), 2);
//! // The camera stands where the first light does: that picture is the brighter one.
//! assert!(image.lights[0].mean.pixel(4, 4)[0] > image.lights[1].mean.pixel(4, 4)[0]);
//! # Ok::<(), diamond_pathtrace::PathtraceError>(())
//! ```
mod boundary;
mod bulk;
mod clearance;
pub mod closed_form;
mod coat;
mod distance_field;
mod environment;
mod error;
mod exit_walks;
pub mod fresnel;
mod geometry;
pub mod ggx;
mod gltf_file;
mod hierarchy;
mod light;
mod medium;
mod mesh;
mod mesh_geometry;
mod noise;
mod obj;
mod patch_interpolation;
mod patches;
mod path;
mod ply;
mod polygonise;
mod reference;
mod repair;
mod repair_holes;
mod repair_nesting;
mod rng;
pub mod sampling;
mod scene;
mod sobol;
mod triangle;
mod veins;
mod view_walks;

pub use boundary::{Boundary, BoundarySample};
pub use bulk::{Bulk, BulkError, BulkOptions, BulkView, ReferencePair, measure_bulk, reference_pairs};
pub use coat::Coat;
pub use distance_field::{DistanceField, Operation, Solid, SurfaceNoise, smooth_minimum};
pub use environment::{Environment, EnvironmentMap};
pub use error::PathtraceError;
pub use exit_walks::{AngularExit, ExitMoments, ExitWalkOptions, ExitWalks, WalkFates, WalkOperator};
pub use geometry::{Facing, Geometry, Hit, NO_PRIMITIVE};
pub use gltf_file::{GltfObject, parse_gltf, read_gltf};
pub use light::{Light, LightSample};
pub use medium::{Flight, FreeFlight, MAX_MEAN_COSINE, Medium, henyey_greenstein, sample_henyey_greenstein};
pub use mesh::{MAX_COORDINATE, Mesh};
pub use mesh_geometry::MeshGeometry;
pub use obj::{parse_obj, read_obj};
pub use patch_interpolation::PatchInterpolation;
pub use patches::Patch;
pub use path::{PathEnd, PathOptions, Tracer};
pub use ply::{parse_ply, read_ply};
pub use polygonise::polygonise;
pub use reference::{LightImage, ReferenceImage, ReferenceOptions, render_reference};
pub use repair::{RepairOptions, RepairReport};
pub use rng::Rng;
pub use sampling::Frame;
pub use scene::{Material, Scene};
pub use veins::Veins;
pub use view_walks::{RadianceMoments, ViewWalkOptions, ViewWalks, WalkStart};
