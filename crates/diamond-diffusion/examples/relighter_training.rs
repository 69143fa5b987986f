//! Trains the shipped relighter on shards, as `diamond train` does, without building the program.
//!
//!     cargo run --release -p diamond-diffusion --example relighter_training -- SHARDS TEST_SHARDS FOLDER STEPS BATCH RATE
use diamond_diffusion::relight::{RelightTraining, RelighterConfig, train_relighter};
use diamond_diffusion::train::TrainSettings;
use std::path::Path;
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let [shards, test, folder, steps, batch, rate] = words.as_slice() else {
        return Err("expected SHARDS TEST_SHARDS FOLDER STEPS BATCH RATE".into());
    };
    let steps: u64 = steps.parse()?;
    let settings = TrainSettings { steps, rate: rate.parse()?, warm_up: (steps / 20).min(100), ..Default::default() };
    let config = RelighterConfig::shipped();
    let test_shards = Some(test.into());
    let training =
        RelightTraining { config, settings, batch: batch.parse()?, save_every: 50, held_out: 60, test_shards };
    let begun = Instant::now();
    let (model, measured) = train_relighter(Path::new(shards), Path::new(folder), &training, true, &mut |report| {
        if report.step % 20 == 0 {
            let seconds = begun.elapsed().as_secs_f64();
            println!("{} loss {:.4} gradient {:.3} after {seconds:.0} s", report.step, report.loss, report.gradient);
        }
    })?;
    if let Some(measured) = measured {
        print!("{measured}");
    }
    println!("{}", model.display());
    Ok(())
}
