//! `report.html`: one file that shows what a run has come to, and lets the reader turn the light.
mod chart;
mod light_control;
mod maps;
mod page;

pub(crate) use chart::curves;
pub use page::write_report;
