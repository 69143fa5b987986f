//! Cross-crate tests in one binary, a module per topic: one link instead of many.

mod fixtures;
mod oracles;
mod tidy;
