//! Cross-crate tests in one binary, a module per topic: one link instead of many.

#[path = "../../crates/diamond-sss/tests/program/captures.rs"]
mod captures;
mod determinism;
mod fixtures;
mod formats;
mod fuzz;
mod oracles;
mod resume;
mod standalone;
mod tidy;
