//! Pictures that nobody took, beside photographs: what a capture lacks, who can make it, and what is believed of what they make.
//!
//! - [`Lack`] says which pairs of view and light a capture lacks, and chooses [`Target`]s among them;
//! - a [`Source`] makes a [`Picture`] of a target: linear radiance with a confidence for each pixel. The physical prior of `diamond-medium` is one, a
//!   diffusion model can be another; whoever uses pictures does not see the difference;
//! - [`generate`] asks a source for all targets, in batches; keeps pictures on disk, looks at each one, and refuses with a reason what contradicts the
//!   photographs.
//!
//! Invariant: nothing here knows how a picture is made or what it is used for. A [`Frame`] is never a photograph: its [`Provenance`](diamond_dataset::Provenance) says who made it, and
//! [`Frame::load`] gives its confidence with it.
//!
//! ```
//! use diamond_augment::{GenerateOptions, Lack, Picture, Source, SourceError, Target, Wanted, generate};
//! use diamond_dataset::{Capture, OpenOptions, Regime};
//! use diamond_image::Image;
//!
//! /// Grey, and hardly sure of it.
//! struct Grey;
//! impl Source for Grey {
//!     fn method(&self) -> String {
//!         "grey".into()
//!     }
//!     fn state(&self) -> String {
//!         "0.5".into()
//!     }
//!     fn pictures(&mut self, _: &Capture, targets: &[Target]) -> Result<Vec<Picture>, SourceError> {
//!         let size = |t: &Target| (t.camera.intrinsics.width as usize, t.camera.intrinsics.height as usize);
//!         let grey = |(w, h)| Picture { radiance: Image::filled(w, h, 3, 0.5), mask: None, confidence: Image::filled(w, h, 1, 0.1) };
//!         Ok(targets.iter().map(|t| grey(size(t))).collect())
//!     }
//! }
//!
//! # let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/captures/candle-small");
//! let capture = Capture::open(&path, &OpenOptions::default())?;
//! let sparse = "3x2".parse::<Regime>()?.apply(&capture, 0)?;
//! let lack = Lack::of(&sparse, &Wanted { lights: 2, ..Default::default() });
//! assert_eq!((lack.rig, lack.targets.len()), (6, 6));
//! let made = generate(&sparse, &lack.targets, &mut Grey, &GenerateOptions::default(), &mut |_, _| ())?;
//! assert!(made.frames.len() == 6 && made.frames[0].load()?.confidence.pixel(3, 3)[0] < 0.11);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
mod cache;
mod error;
mod frame;
mod generate;
mod hull;
mod lack;
mod source;
mod spread;

pub use error::AugmentError;
pub use frame::{Frame, Loaded};
pub use generate::{Augmentation, GenerateOptions, Refused, generate};
pub use lack::{Lack, ViewLack, Wanted};
pub use source::{Picture, Source, SourceError, Target};
