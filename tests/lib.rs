//! Cross-crate tests; everything is in `tests/root.rs`.
