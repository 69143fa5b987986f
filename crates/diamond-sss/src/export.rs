//! The model for other programs.
use crate::SssError;
use diamond_reconstruct::{Model, ReconstructError};
use diamond_splat::{PlyFormat, ScalarType, parse_ply, ply_bytes};
use diamond_splat_files::{ColorSpace, SplatFormat, WriteOptions, read, to_bytes};
use glam::DAffine3;
use std::path::Path;

/// How to export.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ExportOptions {
    /// The format; that of the file's name where absent.
    pub format: Option<SplatFormat>,
    /// Also `base_color_0…2`, `roughness`, `metalness` and `subsurfaceness`, each in `[0, 1]`, linear; PLY only.
    pub materials: bool,
    /// Applied to the cloud before it is written.
    pub turn: DAffine3,
    /// Settings of the format.
    pub write: WriteOptions,
}

/// What was written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exported {
    /// Number of Gaussians.
    pub count: usize,
    /// What of the model is not in the file, and what its colours are, a sentence each.
    pub notes: Vec<String>,
}

/// Writes the model of the run in `folder` to `output` as Gaussians that other programs show. The colour of a
/// Gaussian is its base colour: linear, without any light, reflection, shadow or scattering, the same from everywhere.
pub fn export_model(folder: &Path, output: &Path, options: &ExportOptions) -> Result<Exported, SssError> {
    let format = format_of(output, options.format)?;
    if options.materials && format != SplatFormat::Ply {
        return Err(SssError::Usage(format!("--materials needs PLY: a .{} has no place for them", format.name())));
    }
    let model = Model::load(folder)?;
    let path = folder.join("model.ply");
    let fail = |detail: String| ReconstructError::Checkpoint { path: path.clone(), detail };
    let mut cloud = read(&path)?.cloud;
    cloud.color_space = ColorSpace::Linear;
    let moved = cloud.transform(options.turn);
    let (mut bytes, losses) = to_bytes(&cloud, format, &options.write)?;
    let mut notes = vec!["colour is the base colour: linear, no light baked in, the same from everywhere".to_string()];
    if options.materials {
        let mut table = parse_ply(&bytes).map_err(|e| fail(e.to_string()))?;
        let activated = model.parameters.activate();
        for k in 0..3 {
            let values = activated.base_color.iter().map(|c| c[k]).collect();
            table.push(format!("base_color_{k}"), ScalarType::F32, values);
        }
        for (name, values) in [
            ("roughness", activated.roughness),
            ("metalness", activated.metalness),
            ("subsurfaceness", activated.subsurfaceness),
        ] {
            table.push(name, ScalarType::F32, values);
        }
        bytes = ply_bytes(&table, PlyFormat::BinaryLittleEndian).map_err(|e| fail(e.to_string()))?;
        notes.push("not in the file: visibility, the subsurface network and its codes".into());
    } else {
        notes.push("not in the file: materials, visibility, the subsurface network and its codes".into());
    }
    crate::write_output(output, &bytes)?;
    notes.extend(moved);
    notes.extend(losses);
    Ok(Exported { count: cloud.len(), notes })
}

/// Reads a splat file of any format and writes it as another. Notes say what was not read and what was not written.
pub fn convert_splats(input: &Path, output: &Path, options: &ExportOptions) -> Result<Exported, SssError> {
    let format = format_of(output, options.format)?;
    let file = read(input)?;
    let mut cloud = file.cloud;
    let mut notes = file.notes;
    notes.extend(cloud.transform(options.turn));
    let (bytes, losses) = to_bytes(&cloud, format, &options.write)?;
    crate::write_output(output, &bytes)?;
    notes.extend(losses);
    Ok(Exported { count: cloud.len(), notes })
}

fn format_of(output: &Path, format: Option<SplatFormat>) -> Result<SplatFormat, SssError> {
    match format {
        Some(format) => Ok(format),
        None => SplatFormat::from_path(output).map_err(|e| SssError::Usage(e.to_string())),
    }
}

/// A turn as `axis:degrees`, such as `x:180`, several of them one after another, separated by commas.
pub fn parse_turn(text: &str) -> Result<DAffine3, String> {
    text.split(',').try_fold(DAffine3::IDENTITY, |so_far, part| {
        let (axis, degrees) = part.split_once(':').ok_or("expected AXIS:DEGREES such as x:180")?;
        let degrees: f64 = degrees.trim().parse().map_err(|_| format!("{degrees:?} is no number of degrees"))?;
        let radians = degrees.to_radians();
        let turn = match axis.trim() {
            _ if !degrees.is_finite() => return Err("expected a finite number of degrees".to_string()),
            "x" => DAffine3::from_rotation_x(radians),
            "y" => DAffine3::from_rotation_y(radians),
            "z" => DAffine3::from_rotation_z(radians),
            other => return Err(format!("expected the axis x, y or z, found {other:?}")),
        };
        Ok(turn * so_far)
    })
}

/// Whether `path` is a splat file rather than a capture, by its name.
pub fn is_splat_file(path: &Path) -> bool {
    path.is_file() && SplatFormat::from_path(path).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn turns_are_read_in_order() {
        let half = parse_turn("x:180").unwrap();
        assert!((half.transform_vector3(DVec3::new(1.0, 2.0, 3.0)) - DVec3::new(1.0, -2.0, -3.0)).length() < 1e-12);
        let both = parse_turn("x:90,z:90").unwrap();
        assert!((both.transform_vector3(DVec3::Y) - DVec3::Z).length() < 1e-12);
        assert!((both.transform_vector3(DVec3::X) - DVec3::Y).length() < 1e-12);
        for bad in ["", "x", "w:3", "x:nan", "x:1;y:2"] {
            assert!(parse_turn(bad).is_err(), "{bad}");
        }
    }
}
