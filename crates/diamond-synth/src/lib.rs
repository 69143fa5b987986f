//! Synthetic one-light-at-a-time captures of translucent objects: from a [`Recipe`] to a folder that opens like photographs do.
//!
//! Invariant: a recipe determines every byte. What a capture's error is, is measured with it and written beside it.
//!
//! A [`Recipe`] names an object, its material, a rig of cameras and lights, and how much is computed. [`Plan`] lists the
//! images that follow, [`Object`] is the closed shape. A [`Family`] draws hundreds of recipes
//! from one seed.
mod capture;
mod changes;
mod error;
mod exposure;
mod family;
mod measure;
mod object;
mod plan;
mod recipe;
mod shards;

pub use capture::{CaptureRecord, Progress, Stage, synthesize};
pub use changes::changed_table;
pub use error::SynthError;
pub use exposure::exposure;
pub use family::Family;
pub use measure::Measurement;
pub use object::Object;
pub use plan::{Plan, PlannedView};
pub use recipe::{
    BoundaryRecipe, CoatRecipe, FilmRecipe, HeldOutRecipe, MaterialRecipe, NoiseRecipe, ObjectRecipe, Part,
    QualityRecipe, Recipe, RigKind, RigRecipe, SolidRecipe, UpAxis, VeinsRecipe,
};
pub use shards::{ShardEntry, ShardIndex, ShardOptions, export_shards};
