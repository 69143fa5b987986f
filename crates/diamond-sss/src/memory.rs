//! What a run takes in memory at its peak, before it begins, and how it is made to fit a limit.
//!
//! A run is a row of moments (opening, first Gaussians, steps, checkpoint, evaluation, report). [`moments`] says what is
//! held in each, part by part, from the configuration and the facts of the capture alone; the peak is that of the largest.
//! Under a limit, [`MemoryPlan::new`] first lowers what is held at once without changing the result ([`AtOnce`]), then the
//! number of Gaussians, and refuses a limit under which hardly any are left.
//!
//! Nothing here depends on the number of threads or on the machine, since the number of Gaussians must not.
mod at_once;
mod fit;
mod moments;

pub use at_once::AtOnce;
pub use fit::{MemoryPlan, Refused};
pub use moments::{Moment, Part, moments};
