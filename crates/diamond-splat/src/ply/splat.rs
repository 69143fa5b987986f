//! Splat files: the customary attributes of Gaussian splatting, and ours beside them.
//!
//! All values are raw, as an optimiser holds them: logit of the opacity, logarithm of the scales, a quaternion that
//! need not be normalised. That is what programs that train or show splats write and expect. Our own attributes have
//! names of their own, so that other programs pass over them, and theirs without ours can be read here.
use super::point_cloud::{push_vectors, vectors};
use super::{PlyTable, ScalarType, in_file, read_ply, write_ply};
use crate::{Gaussians, SplatError};
use glam::{Quat, Vec3};
use std::path::Path;

/// The constant spherical harmonic Y₀₀ = ½·√(1/π): displayed colour = ½ + `SH_DC` · `f_dc`.
pub const SH_DC: f32 = 0.282_094_8;

/// Log-scales are clamped to ± this before `exp`, so that any finite file gives finite Gaussians (e⁴⁰ ≈ 2·10¹⁷).
const MAX_LOG_SCALE: f32 = 40.0;

/// Opacities are kept this far from 0 and 1 before the logit, so that it is finite (± 13.8).
const OPACITY_MARGIN: f32 = 1e-6;

const READING: &str = "a splat file";

/// The attributes of a splat file, raw. Every list that is present has one entry per Gaussian.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SplatPly {
    /// Comments of the header.
    pub comments: Vec<String>,
    /// Means, scene units (`x y z`).
    pub means: Vec<Vec3>,
    /// Normals (`nx ny nz`), not normalised; `None` also where all are zero, as plain splat files have it.
    pub normals: Option<Vec<Vec3>>,
    /// Degree 0 of the colour in spherical harmonics (`f_dc_0..2`).
    pub f_dc: Option<Vec<Vec3>>,
    /// Higher degrees (`f_rest_*`), `f_rest_count` values per Gaussian, in file order (all red, all green, all blue).
    pub f_rest: Vec<f32>,
    /// Number of `f_rest_*` properties: 0, 9, 24 or 45 for degrees 0 to 3.
    pub f_rest_count: usize,
    /// Logit of the opacity (`opacity`).
    pub opacity_logits: Vec<f32>,
    /// Logarithm of the standard deviations in scene units (`scale_0..2`).
    pub log_scales: Vec<Vec3>,
    /// Rotations (`rot_0..3`, stored w, x, y, z), perhaps not normalised.
    pub rotations: Vec<Quat>,
    /// Before the sigmoid (`base_color_0..2`).
    pub base_color: Option<Vec<Vec3>>,
    /// Before the sigmoid (`roughness`).
    pub roughness: Option<Vec<f32>>,
    /// Before the sigmoid (`metalness`).
    pub metalness: Option<Vec<f32>>,
    /// Before the sigmoid (`subsurfaceness`).
    pub subsurfaceness: Option<Vec<f32>>,
    /// Visibility in spherical harmonics of degree 3 (`vis_sh_0..15`).
    pub visibility_sh: Option<Vec<[f32; 16]>>,
}

impl SplatPly {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Looks for the attributes in a table. `x y z`, `opacity`, `scale_*` and `rot_*` must be there; a group of
    /// which only some are there is an error.
    pub fn from_table(table: &PlyTable) -> Result<Self, SplatError> {
        let means = table.require(["x", "y", "z"], READING)?;
        let [opacity, scale_0, scale_1, scale_2, w, x, y, z] =
            table.require(["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"], READING)?;
        let normals = table.optional(["nx", "ny", "nz"], READING)?.map(vectors);
        let f_rest_count = table.columns.iter().filter(|c| c.name.starts_with("f_rest_")).count();
        let mut f_rest = vec![0.0; f_rest_count * table.len];
        for index in 0..f_rest_count {
            let [column] = table.require([format!("f_rest_{index}").as_str()], READING)?;
            for (row, &value) in column.iter().enumerate() {
                f_rest[row * f_rest_count + index] = value;
            }
        }
        let scalar = |name: &str| Ok(table.optional([name], READING)?.map(|[c]| c.to_vec()));
        let sh_names: Vec<String> = (0..16).map(|i| format!("vis_sh_{i}")).collect();
        let sh_names: [&str; 16] = std::array::from_fn(|i| sh_names[i].as_str());
        let visibility_sh = table
            .optional(sh_names, READING)?
            .map(|columns| (0..table.len).map(|row| std::array::from_fn(|i| columns[i][row])).collect());
        Ok(Self {
            comments: table.comments.clone(),
            means: vectors(means),
            normals: normals.filter(|n| n.iter().any(|n| *n != Vec3::ZERO)),
            f_dc: table.optional(["f_dc_0", "f_dc_1", "f_dc_2"], READING)?.map(vectors),
            f_rest,
            f_rest_count,
            opacity_logits: opacity.to_vec(),
            log_scales: vectors([scale_0, scale_1, scale_2]),
            rotations: (0..table.len).map(|i| Quat::from_xyzw(x[i], y[i], z[i], w[i])).collect(),
            base_color: table.optional(["base_color_0", "base_color_1", "base_color_2"], READING)?.map(vectors),
            roughness: scalar("roughness")?,
            metalness: scalar("metalness")?,
            subsurfaceness: scalar("subsurfaceness")?,
            visibility_sh,
        })
    }

    /// The table, with the columns in the customary order and ours last. Absent normals are written as zeros, as
    /// other programs expect these columns; other absent attributes have no column.
    pub fn to_table(&self) -> PlyTable {
        let len = self.len();
        let mut table = PlyTable { comments: self.comments.clone(), columns: Vec::new(), len };
        push_vectors(&mut table, ["x", "y", "z"], &self.means);
        match &self.normals {
            Some(normals) => push_vectors(&mut table, ["nx", "ny", "nz"], normals),
            None => push_vectors(&mut table, ["nx", "ny", "nz"], &vec![Vec3::ZERO; len]),
        }
        if let Some(f_dc) = &self.f_dc {
            push_vectors(&mut table, ["f_dc_0", "f_dc_1", "f_dc_2"], f_dc);
        }
        for index in 0..self.f_rest_count {
            let column = self.f_rest.iter().skip(index).step_by(self.f_rest_count).copied().collect();
            table.push(format!("f_rest_{index}"), ScalarType::F32, column);
        }
        table.push("opacity", ScalarType::F32, self.opacity_logits.clone());
        push_vectors(&mut table, ["scale_0", "scale_1", "scale_2"], &self.log_scales);
        for index in 0..4 {
            let wxyz = |q: &Quat| [q.w, q.x, q.y, q.z][index];
            table.push(format!("rot_{index}"), ScalarType::F32, self.rotations.iter().map(wxyz).collect());
        }
        if let Some(base_color) = &self.base_color {
            push_vectors(&mut table, ["base_color_0", "base_color_1", "base_color_2"], base_color);
        }
        for (name, values) in
            [("roughness", &self.roughness), ("metalness", &self.metalness), ("subsurfaceness", &self.subsurfaceness)]
        {
            if let Some(values) = values {
                table.push(name, ScalarType::F32, values.clone());
            }
        }
        if let Some(sh) = &self.visibility_sh {
            for index in 0..16 {
                table.push(format!("vis_sh_{index}"), ScalarType::F32, sh.iter().map(|c| c[index]).collect());
            }
        }
        table
    }

    /// Reads a splat file.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, SplatError> {
        let path = path.as_ref();
        Self::from_table(&read_ply(path)?).map_err(|e| in_file(e, path))
    }

    /// Writes a splat file, `binary_little_endian`, whole or not at all.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<(), SplatError> {
        write_ply(path, &self.to_table())
    }

    /// Applies the activations: σ(logit), exp(log-scale) with the exponent clamped to ±40.
    pub fn to_gaussians(&self) -> Gaussians {
        Gaussians {
            means: self.means.clone(),
            scales: self
                .log_scales
                .iter()
                .map(|s| s.clamp(Vec3::splat(-MAX_LOG_SCALE), Vec3::splat(MAX_LOG_SCALE)).map(libm::expf))
                .collect(),
            rotations: self.rotations.clone(),
            opacities: self.opacity_logits.iter().map(|&v| sigmoid(v)).collect(),
            factors: Vec::new(),
        }
    }

    /// Undoes the activations. Opacities are kept 10⁻⁶ away from 0 and 1, log-scales within ±40.
    pub fn from_gaussians(gaussians: &Gaussians) -> Self {
        let logit = |o: f32| {
            let o = o.clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
            libm::logf(o / (1.0 - o))
        };
        let log = |s: f32| libm::logf(s.max(0.0)).clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE);
        Self {
            means: gaussians.means.clone(),
            opacity_logits: gaussians.opacities.iter().map(|&o| logit(o)).collect(),
            log_scales: gaussians.scales.iter().map(|s| Vec3::new(log(s.x), log(s.y), log(s.z))).collect(),
            rotations: gaussians.rotations.clone(),
            ..Self::default()
        }
    }

    /// Fills `f_dc` from the base colour, so that programs that know only the customary attributes show something:
    /// ½ + [`SH_DC`] · f_dc = √σ(base colour), the square root as a rough transfer to display values.
    pub fn fill_display_color(&mut self) {
        if let Some(base_color) = &self.base_color {
            let display = |v: f32| (sigmoid(v).sqrt() - 0.5) / SH_DC;
            self.f_dc = Some(base_color.iter().map(|c| Vec3::new(display(c.x), display(c.y), display(c.z))).collect());
        }
    }
}

fn sigmoid(v: f32) -> f32 {
    1.0 / (1.0 + libm::expf(-v))
}
