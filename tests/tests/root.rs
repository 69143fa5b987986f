//! Cross-crate tests in one binary, a module per topic.
