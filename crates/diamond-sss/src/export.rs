//! The model for other programs.
use crate::SssError;
use diamond_reconstruct::{Model, ReconstructError};
use diamond_splat::{PlyFormat, PlyTable, ScalarType, ply_bytes, read_ply};
use std::path::Path;

/// Properties that every viewer of 3D Gaussians reads, in the usual order.
const STANDARD: [&str; 17] = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0",
    "rot_1", "rot_2", "rot_3",
];

/// Writes the model of the run in `folder` to `output` with the standard 3DGS properties, which other viewers open; with
/// `materials` also `base_color_0…2`, `roughness`, `metalness` and `subsurfaceness`, each in `[0, 1]`, linear.
/// Returns the number of Gaussians.
pub fn export_model(folder: &Path, output: &Path, materials: bool) -> Result<usize, SssError> {
    let model = Model::load(folder)?;
    let path = folder.join("model.ply");
    let fail = |detail: String| ReconstructError::Checkpoint { path: path.clone(), detail };
    let table = read_ply(&path).map_err(|e| fail(e.to_string()))?;
    let mut out = PlyTable::new(table.len);
    out.comments.push("diamond-sss export: 3D Gaussians, colour is the base colour".into());
    for name in STANDARD {
        let values = table.column(name).ok_or_else(|| fail(format!("property `{name}` is missing")))?;
        out.push(name, ScalarType::F32, values.to_vec());
    }
    if materials {
        let activated = model.parameters.activate();
        for k in 0..3 {
            let values = activated.base_color.iter().map(|c| c[k]).collect();
            out.push(format!("base_color_{k}"), ScalarType::F32, values);
        }
        for (name, values) in [
            ("roughness", activated.roughness),
            ("metalness", activated.metalness),
            ("subsurfaceness", activated.subsurfaceness),
        ] {
            out.push(name, ScalarType::F32, values);
        }
    }
    let bytes = ply_bytes(&out, PlyFormat::BinaryLittleEndian).map_err(|e| fail(e.to_string()))?;
    crate::write_output(output, &bytes)?;
    Ok(table.len)
}
