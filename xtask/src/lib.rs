//! Fixtures, tidy, oracle checks, tests, benchmarks.
