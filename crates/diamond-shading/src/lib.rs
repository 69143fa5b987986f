//! See Cargo.toml.
mod error;

pub use error::ShadingError;
