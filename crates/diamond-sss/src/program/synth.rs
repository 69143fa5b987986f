//! `diamond synth`: captures from recipes.
use super::progress::Counter;
use super::{complain, print};
use diamond_sss::SssError;
use diamond_synth::{CaptureRecord, Family, Progress, Recipe, Stage, synthesize};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Progress within a stage is shown in so many parts.
const PARTS: f32 = 1000.0;

/// Makes the capture of a recipe, or those of a family.
pub fn run(file: PathBuf, output: PathBuf, members: Option<u32>) -> Result<(), SssError> {
    let text = std::fs::read_to_string(&file).map_err(|source| SssError::Io {
        path: file.clone(),
        action: "read the recipe",
        source,
    })?;
    let origin = file.display().to_string();
    let folder = file.parent().unwrap_or(Path::new(""));
    let is_family = toml::from_str::<toml::Table>(&text).is_ok_and(|table| table.contains_key("count"));
    if !is_family {
        if members.is_some() {
            return Err(SssError::Usage("--members is for families (recipes with `count`)".into()));
        }
        let recipe = Recipe::parse(&text, &origin)?;
        return make(&recipe, folder, &output).map(drop);
    }
    let family = Family::parse(&text, &origin)?;
    for index in 0..members.unwrap_or(family.count).min(family.count) {
        let capture = output.join(format!("{index:04}"));
        if capture.exists() {
            continue;
        }
        make(&family.member(index), folder, &capture)?;
    }
    Ok(())
}

fn make(recipe: &Recipe, folder: &Path, output: &Path) -> Result<CaptureRecord, SssError> {
    let counter: Mutex<Option<(Stage, Counter)>> = Mutex::new(None);
    let progress: &Progress<'_> = &|stage, fraction| {
        let mut shown = counter.lock().unwrap_or_else(PoisonError::into_inner);
        // Images are one stage however many are done.
        let same = |a: &Stage| match (a, &stage) {
            (Stage::Images(..), Stage::Images(..)) => true,
            (a, b) => a == b,
        };
        if !shown.as_ref().is_some_and(|(stage, _)| same(stage)) {
            if let Some((_, counter)) = shown.take() {
                counter.finish();
            }
            let what = match stage {
                Stage::Exposure => "exposure",
                Stage::Solve(..) => "light transport",
                Stage::Images(..) => "images",
                Stage::Measure => "measuring the error",
            };
            *shown = Some((stage, Counter::new(what)));
        }
        let Some((_, counter)) = shown.as_mut() else { return };
        match stage {
            Stage::Images(done, all) => counter.show(done, all),
            Stage::Solve(group, groups) => {
                let message = || format!("group {group} of {groups}");
                counter.show_with((fraction * PARTS) as u64, PARTS as u64, message);
            }
            _ => counter.show((fraction * PARTS) as usize, PARTS as usize),
        }
    };
    let record = synthesize(recipe, folder, output, progress)?;
    if let Some((_, counter)) = counter.lock().unwrap_or_else(PoisonError::into_inner).take() {
        counter.finish();
    }
    if record.repairs.changed() {
        complain(&format!("the mesh was repaired: {}", record.repairs));
    }
    print(&format!("{}: {} images, exposure {:.3}\n", output.display(), record.images, record.exposure));
    if let Some(e) = record.error {
        print(&format!(
            "  against the reference: bias {:+.2} % (± {:.2}), rms {:.2} % of the mean; noise {:.1} dB\n",
            100.0 * e.bias,
            100.0 * e.bias_standard_error,
            100.0 * e.rmse,
            e.noise_db
        ));
    }
    Ok(record)
}
