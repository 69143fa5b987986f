//! Captures: views × lights × images on disk, read lazily.
//!
//! A *capture* is a folder of photographs of one object, each taken with one camera under one light (OLAT). A *view* is
//! a camera; a *shot* is one image of it with its light. A light's position belongs to the shot and not to an index: on
//! a turntable the object moves under fixed lamps. Grids are incomplete, and nothing here assumes that views × lights
//! all exist.
//!
//! Invariant: nothing here knows of Gaussians, shading or losses; whatever the bytes on disk, the answer is a value or
//! a [`DatasetError`] that names file, frame and field, never a panic, and memory stays within the limits of
//! [`OpenOptions`].
//!
//! ```
//! use diamond_dataset::{Capture, OpenOptions, Selection};
//! # let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/captures/spot-small");
//! let capture = Capture::open(&path, &OpenOptions::default())?;
//! let sparse = capture.select(&Selection::Count(3), &"0,2-3".parse()?)?;
//! assert_eq!((sparse.train.len(), sparse.train[0].shots.len(), sparse.test.len()), (3, 3, 4));
//! let observation = sparse.observation(&sparse.train[0].shots[0])?;
//! assert_eq!(observation.radiance.shape(), (128, 128, 3));
//! # Ok::<(), diamond_dataset::DatasetError>(())
//! ```
mod background;
mod cache;
mod capture;
mod colmap;
mod decode;
mod develop;
mod error;
mod exclusions;
mod field;
mod folder;
mod format;
mod frames;
mod geometry;
mod hash;
mod hold_out;
mod in_progress;
mod lens;
mod lights;
mod manifest;
mod observation;
mod regime;
mod scene;
mod select;
mod stored;
mod views;
mod write;
mod write_other;

pub use capture::{
    AlphaPremultiplied, Capture, EvalSplit, MaskSource, OpenOptions, Provenance, Shot, Split, TransferChoice, View,
};
pub use colmap::{
    ColmapCamera, ColmapEncoding, ColmapImage, ColmapPoints, parse_colmap_cameras, parse_colmap_images,
    parse_colmap_points, read_colmap_points,
};
pub use decode::decode_image;
pub use develop::Undistortion;
pub use error::{DatasetError, Place};
pub use format::CaptureFormat;
pub use frames::{Entry, Frame, Frames, parse_transforms};
pub use geometry::{Geometry, encode_exr};
pub use hash::FileDigest;
pub use hold_out::HoldOut;
pub use in_progress::CaptureInProgress;
pub use lens::Lens;
pub use lights::{LightEntry, LightFrame, Lights, parse_lights};
pub use manifest::{ManifestView, SelectionManifest};
pub use observation::{Observation, StoredForm, to_display};
pub use regime::Regime;
pub use scene::{Scene, light_direction};
pub use select::{Selection, farthest_points, farthest_points_seeded};
pub use write::{BitDepth, CaptureDescription, Pixels, ShotDescription, ViewDescription, write_capture};
pub use write_other::{write_colmap, write_nerfstudio};
