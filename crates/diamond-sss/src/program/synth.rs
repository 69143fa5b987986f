//! `diamond synth`: captures from recipes; `diamond shards`: captures for other programs.
use super::progress::Counter;
use super::{complain, print};
use diamond_dataset::{Capture, OpenOptions};
use diamond_sss::{SheetOptions, SssError, contact_sheet, export_predictions, family_sheet, write_output};
use diamond_synth::{CaptureRecord, Family, Object, Progress, Recipe, ShardOptions, Stage, export_shards, synthesize};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Progress within a stage is shown in so many parts.
const PARTS: f32 = 1000.0;

/// What is asked for.
pub struct Wish {
    /// A recipe or a family.
    pub recipe: PathBuf,
    /// Changes to it.
    pub changes: Vec<String>,
    /// Folder of the capture, or of the family's captures.
    pub output: PathBuf,
    /// Only the first members.
    pub members: Option<u32>,
    /// Where many small pictures go.
    pub contact_sheet: Option<PathBuf>,
    /// Where the object's surface goes.
    pub mesh: Option<PathBuf>,
    /// Where shards go.
    pub shards: Option<PathBuf>,
}

/// Makes the capture of a recipe, or those of a family, and what else is asked for. Captures of a family that are there are kept.
pub fn run(wish: &Wish) -> Result<(), SssError> {
    let file = &wish.recipe;
    let text = std::fs::read_to_string(file).map_err(|source| SssError::Io {
        path: file.clone(),
        action: "read the recipe",
        source,
    })?;
    let origin = file.display().to_string();
    let folder = file.parent().unwrap_or(Path::new(""));
    let is_family = toml::from_str::<toml::Table>(&text).is_ok_and(|table| table.contains_key("count"));
    let mut captures = Vec::new();
    if is_family {
        if wish.mesh.is_some() {
            return Err(SssError::Usage(
                "--mesh is for one recipe, this is a family; name the member's own recipe".into(),
            ));
        }
        let family = Family::parse_changed(&text, &origin, &wish.changes)?;
        let count = wish.members.unwrap_or(family.count).min(family.count);
        for index in 0..count {
            let capture = wish.output.join(format!("{index:04}"));
            if !capture.exists() {
                print(&format!("member {} of {count}\n", index + 1));
                make(&family.member(index), folder, &capture)?;
            }
            captures.push(capture);
        }
    } else {
        if wish.members.is_some() {
            return Err(SssError::Usage("--members is for families (recipes with `count`)".into()));
        }
        let recipe = Recipe::parse_changed(&text, &origin, &wish.changes)?;
        if let Some(path) = &wish.mesh {
            let object = Object::new(&recipe, folder)?;
            write_output(path, &object.mesh.to_ply())?;
            print(&format!("{}: {} triangles\n", path.display(), object.mesh.triangles.len()));
        }
        make(&recipe, folder, &wish.output)?;
        captures.push(wish.output.clone());
    }
    if let Some(path) = &wish.contact_sheet {
        let opened: Vec<Capture> =
            captures.iter().map(|path| Capture::open(path, &OpenOptions::default())).collect::<Result<_, _>>()?;
        let options = SheetOptions::default();
        let png = match (is_family, opened.first()) {
            (false, Some(capture)) => contact_sheet(capture, &options)?,
            _ => family_sheet(&opened, &options)?,
        };
        write_output(path, &png)?;
        print(&format!("written: {}\n", path.display()));
    }
    match &wish.shards {
        Some(output) => shards(&captures, output, ShardOptions::default().bytes, false),
        None => Ok(()),
    }
}

/// Writes captures as shards.
pub fn shards(captures: &[PathBuf], output: &Path, bytes: u64, prior: bool) -> Result<(), SssError> {
    let counter = Mutex::new(Counter::new("shards"));
    let told = |done, all| counter.lock().unwrap_or_else(PoisonError::into_inner).show(done, all);
    let index = export_shards(captures, output, &ShardOptions { bytes }, &told)?;
    counter.lock().unwrap_or_else(PoisonError::into_inner).finish();
    let size = index.shards.iter().map(|s| s.bytes).sum::<u64>() as f64 / 1e6;
    print(&format!("{}: {} shards, {size:.1} MB\n", output.display(), index.shards.len()));
    if prior {
        let mut counter = Counter::new("predictions");
        let left_out = export_predictions(captures, &index, output, &mut |done, all| counter.show(done, all))?;
        counter.finish();
        left_out.iter().for_each(|line| print(&format!("{line}\n")));
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
