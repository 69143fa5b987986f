//! Fixtures, tidy, oracle checks, tests, benchmarks.
fn main() {}
