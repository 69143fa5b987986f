//! What was found about the inside of an object, for people: numbers, remarks, and a plot.
use crate::report::curves;
use crate::{SssError, write_output};
use diamond_medium::{Medium, Transport};
use diamond_reconstruct::{Model, ReconstructError};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// What is said about a medium.
#[derive(Debug, Clone, PartialEq)]
pub struct MediumReport {
    /// For the terminal.
    pub text: String,
    /// The plot that was written.
    pub plot: PathBuf,
}

/// Reads the medium of a finished run, with `changes` if any (a file or `KEY=VALUE,…`), and writes its plot to `plot` (`DIR/medium.svg` unless told otherwise).
///
/// # Errors
/// Where the run has no medium: it was made with `subsurface.model = "mlp"`, or none could be fitted.
pub fn inspect_medium(folder: &Path, changes: Option<&str>, plot: Option<&Path>) -> Result<MediumReport, SssError> {
    let mut model = Model::load(folder)?;
    if let Some(changes) = changes {
        edit_medium(&mut model, changes)?;
    }
    let term = model.medium.as_ref().ok_or_else(|| no_medium(folder))?;
    let (medium, surface) = (term.medium(), term.surface());
    let radius = surface.radius();
    let mut text = format!(
        "{}: {} inside a surface of {} triangles and {} surfels {:.4} apart (radius {radius:.4})\n",
        folder.display(),
        medium.kind(),
        surface.mesh().triangles.len(),
        surface.patches().len(),
        surface.spacing()
    );
    // Writing to a string cannot fail.
    let row = |text: &mut String, name: &str, v: [f32; 3], unit: &str| {
        let _ = writeln!(text, "  {name:<34} {:>9.4} {:>9.4} {:>9.4}  {unit}", v[0], v[1], v[2]);
    };
    let _ = writeln!(text, "  {:<34} {:>9} {:>9} {:>9}", "", "red", "green", "blue");
    match &medium.transport {
        Transport::Walk { sigma_t, albedo, g, ior, gain } => {
            row(&mut text, "sigma_t (reduced where g = 0)", *sigma_t, "per scene unit");
            row(&mut text, "mean free path", sigma_t.map(|s| 1.0 / s), "scene units");
            row(&mut text, "single-scattering albedo", *albedo, "");
            row(&mut text, "gain of the photographs", *gain, "");
            let _ = writeln!(text, "  g {g}, index of refraction {ior}");
        }
        Transport::Profile { .. } => {
            if let Some(d) = &medium.described {
                row(&mut text, "as normalised diffusion: reflectance", d.reflectance, "");
                row(&mut text, "  transport mean free path", d.mean_free_path, "scene units");
                row(&mut text, "  reduced sigma_t", d.mean_free_path.map(|l| 1.0 / l), "per scene unit");
            }
        }
    }
    row(&mut text, "reflectance of a half space", medium.reflectance().to_array(), "");
    row(&mut text, "light spreads over", medium.mean_radius().to_array(), "scene units");
    row(&mut text, "", (medium.mean_radius() / radius).to_array(), "of the radius");
    let _ = writeln!(text, "  coat: roughness {:.3}, scale {:.3}", medium.coat.roughness, medium.coat.scale);
    if let Some(q) = &medium.quality {
        let _ = writeln!(
            text,
            "  explains its {} photographs to {:.1} dB ({:.1} % of their values); {:.0} % of what is left is the same under all lights of a view",
            q.images,
            q.psnr,
            100.0 * q.relative_error,
            100.0 * q.constant_part
        );
    }
    for remark in medium.remarks(surface.spacing()) {
        let _ = writeln!(text, "  {remark}");
    }
    let path = plot.map_or_else(|| folder.join("medium.svg"), Path::to_owned);
    let spread = term.spread();
    let of =
        |c: usize| spread.iter().map(|(r, share)| (f64::from(*r / radius), f64::from(share[c]))).collect::<Vec<_>>();
    let svg = curves(
        "Where light leaves that enters at a point",
        "distance, radii of the object",
        "share per ring",
        &[("red", "#c23b22", of(0)), ("green", "#2e8b57", of(1)), ("blue", "#3b6fb6", of(2))],
    );
    write_output(&path, svg.as_bytes())?;
    Ok(MediumReport { text, plot: path })
}

fn no_medium(folder: &Path) -> SssError {
    SssError::Usage(format!(
        "{}: this model has no medium; reconstruct with subsurface.model = \"profile+mlp\" (or profile, walk, walk+mlp)",
        folder.display()
    ))
}

/// Puts another medium into a model: one from a TOML file, or the model's own with changes such as `mean_free_path=*2`.
pub fn edit_medium(model: &mut Model, changes: &str) -> Result<(), SssError> {
    let term = model.medium.as_ref().ok_or_else(|| {
        SssError::Usage("this model has no medium that could be changed (subsurface.model = \"mlp\")".into())
    })?;
    let fail = |e: diamond_medium::MediumError| SssError::from(ReconstructError::Unusable { detail: e.to_string() });
    let medium = match changes.ends_with(".toml") {
        true => Medium::read(Path::new(changes)).map_err(fail)?,
        false => term.medium().edited(changes).map_err(fail)?,
    };
    model.medium = Some(term.with_medium(medium)?);
    Ok(())
}
