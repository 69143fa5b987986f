//! The workspace's own tools, as a library: what `cargo xtask` does, callable from tests.
//!
//! `cargo xtask oracle` and the cross-crate tests run the same code, so a table that passes in one passes in the other.

pub mod bench;
pub mod captures;
pub mod eval;
pub mod fixtures;
pub mod oracle;
pub mod suite;
pub mod tidy;
pub mod tune;
