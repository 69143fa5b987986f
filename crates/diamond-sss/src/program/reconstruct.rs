//! `diamond reconstruct`.
use super::cli::ReconstructArguments;
use super::print;
use super::progress::Counter;
use diamond_sss::{Event, ReconstructOptions, SssError};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Runs the subcommand.
pub fn run(a: ReconstructArguments) -> Result<(), SssError> {
    let interrupted = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&interrupted);
    // The first Ctrl-C asks to stop after the step; the second stops at once, the checkpoint on disk stays whole.
    let handler = ctrlc::set_handler(move || {
        if flag.swap(true, Ordering::SeqCst) {
            std::process::exit(130);
        }
        super::complain("diamond: finishing the step and writing a checkpoint; press Ctrl-C again to stop at once");
    });
    if let Err(e) = handler {
        tracing::warn!("Ctrl-C will not write a checkpoint: {e}");
    }
    super::signals::terminate_interrupts(&interrupted);
    let (views, lights) = a.regime.map_or((a.views, a.lights), |regime| (regime.views, regime.lights));
    let options = ReconstructOptions {
        capture: a.capture,
        output: a.output,
        preset: a.preset,
        steps: a.steps,
        seed: a.seed,
        threads: a.threads.map(usize::from),
        instruction_set: a.instruction_set,
        memory_limit: a.memory_limit,
        views,
        lights,
        selection: a.selection,
        initial: a.initial,
        device: a.device,
        resume: a.resume,
        force: a.force,
        command: std::env::args().collect::<Vec<_>>().join(" "),
    };
    let mut training = Counter::new("reconstructing");
    let (mut making, mut evaluating) = (Counter::new("making pictures"), Counter::new("evaluating"));
    let mut all = 0;
    let mut events = |event: Event<'_>| match event {
        Event::Note(text) => training.say(&text),
        Event::Started { done, steps, images } => {
            all = steps;
            let from = if done > 0 { format!(", continuing after step {done}") } else { String::new() };
            training.say(&format!("{steps} steps on {images} images{from}"));
        }
        Event::Made { done, all } => making.show(done, all),
        Event::Step { report, psnr } => {
            training.show_with(report.step + 1, all, || format!("PSNR {psnr:.2} dB, {} Gaussians", report.gaussians))
        }
        Event::Checkpoint { step } if step == all => training.finish(),
        Event::Checkpoint { step } => tracing::debug!("checkpoint after step {step}"),
        Event::Evaluated { done, all } => evaluating.show(done, all),
    };
    let outcome = diamond_sss::reconstruct(&options, &mut events, &interrupted);
    training.finish();
    making.finish();
    evaluating.finish();
    let outcome = outcome?;
    if let Some(metrics) = &outcome.metrics {
        print(&metrics.to_table());
    }
    print(&format!(
        "{} Gaussians in {:.1} seconds; open {}\n",
        outcome.gaussians,
        outcome.seconds,
        options.output.join("report.html").display()
    ));
    Ok(())
}
