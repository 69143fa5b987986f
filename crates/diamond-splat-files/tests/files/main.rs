//! Splat files: laws of round trips, files of other programs, broken files.
mod clouds;
mod foreign;
mod hostile;
mod laws;
