//! Pictures of a finished model: a camera path under any lights.
use crate::picture::encode_png_linear;
use crate::relight::{render_lights, render_sum};
use crate::{CameraChoice, LightChoice, RunRecord, SssError, cameras_of, encode_exr, write_output};
use diamond_gpu::{Device, DeviceChoice, DeviceRelighter};
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_reconstruct::{Model, Relighter as _};
use glam::Vec3;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// What to render.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RenderOptions {
    /// The run's folder.
    pub folder: PathBuf,
    /// A file for one picture, else a folder.
    pub output: PathBuf,
    /// From where.
    pub cameras: CameraChoice,
    /// Under which light.
    pub lights: LightChoice,
    /// Width and height, pixels; the camera's where absent.
    pub size: Option<(u32, u32)>,
    /// Another medium: a TOML file, or changes such as `mean_free_path=*2`.
    pub medium: Option<String>,
    /// Linear light as EXR instead of sRGB as PNG.
    pub linear: bool,
    /// Where pictures are made; on the CPU where absent.
    pub device: Option<DeviceChoice>,
    /// Stops by which pictures are brighter than the model says; every stop doubles the radiance.
    pub exposure: f32,
}

/// Renders and writes the pictures; returns their paths. Calls `progress` with pictures done and all.
pub fn render_folder(
    options: &RenderOptions,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<PathBuf>, SssError> {
    // Before anything is read: a device that is not there is a wrong option.
    let device = options.device.map_or(Ok(None), Device::open).map_err(|e| SssError::Usage(e.to_string()))?;
    let mut model = Model::load(&options.folder)?;
    if let Some(changes) = &options.medium {
        crate::edit_medium(&mut model, changes)?;
    }
    let model = model;
    let record = RunRecord::read(&options.folder)?;
    let run_file = options.folder.join(crate::run_record::RUN_FILE);
    let rig: Vec<OlatLight> = match &record {
        Some(record) => record.rig.iter().map(|l| l.light(&run_file)).collect::<Result<_, _>>()?,
        None => Vec::new(),
    };
    let up = record.as_ref().map_or(Vec3::Z, |r| Vec3::from(r.up));
    let cameras = cameras_of(&options.cameras, &options.folder, record.as_ref(), model.scene.centre())?;
    let mixes = options.lights.mixes(&model, &rig, up)?;
    let total = cameras.len() * mixes.len();
    let extension = if options.linear { "exr" } else { "png" };
    let as_file = options.output.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension));
    if as_file && total > 1 {
        return Err(SssError::Usage(format!(
            "{}: {total} pictures do not fit in one file; name a folder",
            options.output.display()
        )));
    }
    let mut written = Vec::with_capacity(total);
    let mut store = |picture: &Image, camera: &str, light: &str| -> Result<(), SssError> {
        let path = if as_file {
            options.output.clone()
        } else {
            options.output.join(match mixes.len() {
                1 => format!("{camera}.{extension}"),
                _ => format!("{camera}_{light}.{extension}"),
            })
        };
        let gain = libm::exp2f(options.exposure);
        let exposed = if gain == 1.0 { picture.clone() } else { picture.map(|v| v * gain) };
        let bytes = if options.linear { encode_exr(&exposed)? } else { encode_png_linear(&exposed)? };
        write_output(&path, &bytes)?;
        written.push(path);
        progress(written.len(), total);
        Ok(())
    };
    let mut renderer = crate::AtOnce::default().renderer(&model);
    if let Some(device) = device {
        let relighter = DeviceRelighter::new(Arc::new(device)).map_err(crate::reconstruct_run::device_error)?;
        let name = relighter.name().to_owned();
        let lacking;
        (renderer, lacking) = renderer.relight_by(Box::new(relighter));
        if let Some(lacking) = lacking {
            return Err(SssError::Usage(format!(
                "{name} cannot render this model, it lacks {lacking}; use --device cpu"
            )));
        }
    }
    let renderer = renderer;
    for (name, camera) in cameras {
        let camera = options.size.map_or(camera, |(w, h)| camera.resized(w, h));
        if mixes.iter().all(|m| m.lights.len() == 1) {
            // One projection serves all lights of the view.
            let lights: Vec<OlatLight> = mixes.iter().map(|m| m.lights[0]).collect();
            render_lights(&renderer, &camera, &lights, |i, picture| store(picture, &name, &mixes[i].name))?;
        } else {
            for mix in &mixes {
                store(&render_sum(&renderer, &camera, &mix.lights)?, &name, &mix.name)?;
            }
        }
    }
    Ok(written)
}

/// Whether a path looks like the folder of a run.
pub(crate) fn holds_results(folder: &Path) -> bool {
    ["model.ply", "run.json", "metrics.json"].iter().any(|f| folder.join(f).exists())
        || folder.join("checkpoint").exists()
}
