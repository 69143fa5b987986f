//! Opening a capture for a long run: what is broken is found at the start and not hours later.
use crate::SssError;
use diamond_dataset::{Capture, DatasetError, OpenOptions, Shot};
use diamond_reconstruct::Config;
use rayon::prelude::*;
use std::path::Path;

/// Opens a capture as a configuration says.
pub fn open_capture(path: &Path, config: &Config) -> Result<Capture, SssError> {
    let options = OpenOptions {
        format: config.input.format.format(),
        transfer: config.input.transfer.transfer(),
        exr_transfer: config.input.exr_transfer.transfer(),
        hold_out_every: config.input.hold_out_every,
        cache_bytes: config.input.cache_bytes,
        ..OpenOptions::default()
    };
    Ok(Capture::open(path, &options)?)
}

/// Decodes every image of the capture once, on all threads or one after the other; the error is that of the first broken
/// one, in the order of the files.
pub(crate) fn check_images(capture: &Capture, in_parallel: bool) -> Result<(), DatasetError> {
    let shots: Vec<&Shot> = capture.train.iter().chain(&capture.test).flat_map(|v| &v.shots).collect();
    if !in_parallel {
        return shots.iter().try_for_each(|shot| capture.observation(shot).map(|_| ()));
    }
    let results: Vec<Result<(), DatasetError>> =
        shots.par_iter().map(|shot| capture.observation(shot).map(|_| ())).collect();
    results.into_iter().collect()
}
