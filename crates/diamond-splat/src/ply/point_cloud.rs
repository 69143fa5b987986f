//! Coloured points with normals, as scanners and structure from motion leave them.
use super::{PlyColumn, PlyTable, ScalarType, in_file, read_ply};
use crate::SplatError;
use glam::Vec3;
use std::path::Path;

/// Points with optional normals and colours.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PointCloud {
    /// Positions, scene units, world axes as written.
    pub positions: Vec<Vec3>,
    /// Normals as written (not normalised), from `nx ny nz`; `None` also where they are all zero.
    pub normals: Option<Vec<Vec3>>,
    /// Colours in `[0, 1]`, in the file's transfer (usually sRGB), from `red green blue`.
    pub colors: Option<Vec<Vec3>>,
}

impl PointCloud {
    /// Looks for the columns `x y z`, `nx ny nz` and `red green blue` (or `r g b`, `diffuse_red …`).
    ///
    /// Integer colours are divided by 255, those of type `ushort` by 65535; float colours are in `[0, 1]` already.
    pub fn from_table(table: &PlyTable) -> Result<Self, SplatError> {
        const READING: &str = "a point cloud";
        let positions = vectors(table.require(["x", "y", "z"], READING)?);
        let normals = table.optional(["nx", "ny", "nz"], READING)?.map(vectors);
        let normals = normals.filter(|n| n.iter().any(|n| *n != Vec3::ZERO));
        let mut colors = None;
        for names in [["red", "green", "blue"], ["r", "g", "b"], ["diffuse_red", "diffuse_green", "diffuse_blue"]] {
            if let Some(columns) = table.optional(names, READING)? {
                let scale = names.map(|name| {
                    table.columns.iter().find(|c| c.name == name).map_or(1.0, |c: &PlyColumn| match c.scalar {
                        ScalarType::F32 | ScalarType::F64 => 1.0,
                        ScalarType::U16 => 1.0 / 65535.0,
                        _ => 1.0 / 255.0,
                    })
                });
                let scale = Vec3::from(scale);
                colors = Some(vectors(columns).into_iter().map(|c| (c * scale).clamp(Vec3::ZERO, Vec3::ONE)).collect());
                break;
            }
        }
        Ok(Self { positions, normals, colors })
    }

    /// Reads a PLY file.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, SplatError> {
        let path = path.as_ref();
        Self::from_table(&read_ply(path)?).map_err(|e| in_file(e, path))
    }

    /// The table to write: float positions and normals, uchar colours.
    pub fn to_table(&self) -> PlyTable {
        let mut table = PlyTable::new(self.positions.len());
        push_vectors(&mut table, ["x", "y", "z"], &self.positions);
        if let Some(normals) = &self.normals {
            push_vectors(&mut table, ["nx", "ny", "nz"], normals);
        }
        if let Some(colors) = &self.colors {
            for (axis, name) in ["red", "green", "blue"].into_iter().enumerate() {
                let values = colors.iter().map(|c| (c[axis].clamp(0.0, 1.0) * 255.0).round()).collect();
                table.push(name, ScalarType::U8, values);
            }
        }
        table
    }
}

/// Three columns as vectors.
pub(super) fn vectors(columns: [&[f32]; 3]) -> Vec<Vec3> {
    let [x, y, z] = columns;
    x.iter().zip(y).zip(z).map(|((&x, &y), &z)| Vec3::new(x, y, z)).collect()
}

/// Vectors as three float columns.
pub(super) fn push_vectors(table: &mut PlyTable, names: [&str; 3], values: &[Vec3]) {
    for (axis, name) in names.into_iter().enumerate() {
        table.push(name, ScalarType::F32, values.iter().map(|v| v[axis]).collect());
    }
}
