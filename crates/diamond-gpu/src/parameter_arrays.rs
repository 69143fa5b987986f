//! The model's parameters, moments and statistics as arrays of the device, and back.
use crate::GpuError;
use crate::workspace::{Store, Workspace};
use bytemuck::{Pod, Zeroable};
use diamond_reconstruct::{Attribute, Model};
use diamond_shading::{Mlp, ResidualNetwork};
use diamond_splat::density::DensityStats;

/// Arrays of attributes begin at multiples of so many words: 256 bytes, WebGPU's alignment of a binding.
const ALIGNMENT: u64 = 64;

/// `Raw` of `raw.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct Raw {
    pub mean: u32,
    pub scale: u32,
    pub rotation: u32,
    pub opacity: u32,
    pub normal: u32,
    pub base_color: u32,
    pub roughness: u32,
    pub metalness: u32,
    pub subsurfaceness: u32,
    pub channels: u32,
    pub unused_0: u32,
    pub unused_1: u32,
}

/// Where attributes and parts of the network lie.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct ParameterLayout {
    /// Gaussians.
    pub gaussians: u64,
    /// First word of each attribute, and one for the end.
    pub first: [u64; 14],
    /// Numbers per Gaussian.
    pub width: [u64; 13],
    /// Shapes of trunk, residual head, incident head, with the first word of each.
    pub network: Vec<(diamond_shading::MlpShape, u64)>,
    /// Words of the network.
    pub network_words: u64,
}

fn parts(network: &ResidualNetwork) -> Vec<&Mlp> {
    let mut parts = vec![&network.trunk, &network.residual_head];
    parts.extend(&network.incident_head);
    parts
}

fn parts_mut(network: &mut ResidualNetwork) -> Vec<&mut Mlp> {
    let mut parts = vec![&mut network.trunk, &mut network.residual_head];
    parts.extend(&mut network.incident_head);
    parts
}

impl ParameterLayout {
    /// Of a model.
    pub fn of(model: &Model) -> Self {
        let mut out = Self { gaussians: model.len() as u64, ..Self::default() };
        let mut at = 0;
        for (k, group) in model.parameters.groups().iter().enumerate() {
            out.first[k] = at;
            out.width[k] = group.width as u64;
            at += (group.width as u64 * out.gaussians).next_multiple_of(ALIGNMENT);
        }
        out.first[13] = at;
        for mlp in model.network.iter().flat_map(parts) {
            out.network.push((mlp.shape.clone(), out.network_words));
            out.network_words += (mlp.parameters.len() as u64).next_multiple_of(ALIGNMENT);
        }
        out
    }

    /// Words of all attributes.
    pub fn words(&self) -> u64 {
        self.first[13]
    }

    /// First word and number of words of an attribute.
    pub fn part(&self, attribute: Attribute) -> (u64, u64) {
        let k = attribute as usize;
        (self.first[k], self.width[k] * self.gaussians)
    }

    /// First word and number of words of the attributes from means to subsurfaceness, which lie side by side.
    pub fn surface(&self) -> (u64, u64) {
        (0, self.first[Attribute::VisibilitySh as usize])
    }

    /// Where the attributes lie that become Gaussians and channels.
    pub fn raw(&self, channels: u32) -> Raw {
        let first = |attribute: Attribute| self.first[attribute as usize] as u32;
        Raw {
            mean: first(Attribute::Mean),
            scale: first(Attribute::Scale),
            rotation: first(Attribute::Rotation),
            opacity: first(Attribute::Opacity),
            normal: first(Attribute::Normal),
            base_color: first(Attribute::BaseColor),
            roughness: first(Attribute::Roughness),
            metalness: first(Attribute::Metalness),
            subsurfaceness: first(Attribute::Subsurfaceness),
            channels,
            unused_0: 0,
            unused_1: 0,
        }
    }

    fn gathered<'a>(&self, columns: impl Iterator<Item = &'a [f32]>) -> Vec<u32> {
        let mut out = vec![0u32; self.words() as usize];
        for (values, first) in columns.zip(self.first) {
            out[first as usize..first as usize + values.len()].copy_from_slice(bytemuck::cast_slice(values));
        }
        out
    }

    fn network_gathered<'a>(&self, columns: impl Iterator<Item = &'a [f32]>) -> Vec<u32> {
        let mut out = vec![0u32; self.network_words as usize];
        for (values, (_, first)) in columns.zip(&self.network) {
            let first = *first as usize;
            out[first..first + values.len()].copy_from_slice(bytemuck::cast_slice(values));
        }
        out
    }

    /// Writes everything that a step changes.
    pub fn load(&self, to: &mut Workspace, model: &Model, stats: &DensityStats) -> Result<(), GpuError> {
        let groups = model.parameters.groups();
        to.upload(Store::Values, &self.gathered(groups.iter().map(|g| g.values.as_slice())))?;
        to.upload(Store::FirstMoments, &self.gathered(groups.iter().map(|g| g.moments.first.as_slice())))?;
        to.upload(Store::SecondMoments, &self.gathered(groups.iter().map(|g| g.moments.second.as_slice())))?;
        let mlps: Vec<&Mlp> = model.network.iter().flat_map(parts).collect();
        to.upload(Store::Network, &self.network_gathered(mlps.iter().map(|m| m.parameters.as_slice())))?;
        let moments = &model.network_moments;
        to.upload(Store::NetworkFirst, &self.network_gathered(moments.iter().map(|m| m.first.as_slice())))?;
        to.upload(Store::NetworkSecond, &self.network_gathered(moments.iter().map(|m| m.second.as_slice())))?;
        // Counts are far below 2²⁴, so f32 holds them exactly.
        let rows = stats.gradient_sum.iter().zip(&stats.views).zip(&stats.max_radius);
        let rows = rows.flat_map(|((sum, views), radius)| [*sum, *views as f32, *radius, 0.0]);
        let rows: Vec<u32> = rows.map(f32::to_bits).collect();
        to.upload(Store::Statistics, &rows)
    }

    /// Reads it back.
    pub fn store(&self, from: &Workspace, model: &mut Model, stats: &mut DensityStats) -> Result<(), GpuError> {
        let read = from.read(&[
            Store::Values,
            Store::FirstMoments,
            Store::SecondMoments,
            Store::Network,
            Store::NetworkFirst,
            Store::NetworkSecond,
            Store::Statistics,
        ])?;
        for attribute in Attribute::ALL {
            let (first, words) = self.part(attribute);
            let range = first as usize..(first + words) as usize;
            let group = model.parameters.group_mut(attribute);
            group.values.copy_from_slice(&read[0][range.clone()]);
            group.moments.first.copy_from_slice(&read[1][range.clone()]);
            group.moments.second.copy_from_slice(&read[2][range]);
        }
        let mlps = model.network.iter_mut().flat_map(parts_mut);
        for ((mlp, moments), (_, first)) in mlps.zip(&mut model.network_moments).zip(&self.network) {
            let range = *first as usize..*first as usize + mlp.parameters.len();
            mlp.parameters.copy_from_slice(&read[3][range.clone()]);
            moments.first.copy_from_slice(&read[4][range.clone()]);
            moments.second.copy_from_slice(&read[5][range]);
        }
        for (i, row) in read[6].chunks_exact(4).take(stats.len()).enumerate() {
            (stats.gradient_sum[i], stats.views[i], stats.max_radius[i]) = (row[0], row[1] as u32, row[2]);
        }
        Ok(())
    }
}
