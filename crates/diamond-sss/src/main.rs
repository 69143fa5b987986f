//! The `diamond` program.
fn main() {}
