//! What many lights send through the same Gaussians: residual and incident light of rows, sixteen rows at a time.
//!
//! For the rows of a view most of the work does not depend on the light: it is done once ([`ManyLights`], [`LitRows`]). For
//! a light remain, row by row, its direction and distance, the sum over the transfer vector and the network from its
//! first layer's sums on. A block of sixteen rows goes through all of that for one light after the other while its sums and
//! the weights stay in the first cache, one row per lane of the vectors.
use crate::encoding::{InputScaling, LIGHT_COLUMNS};
use crate::error::{ShadingError, check_length};
use crate::incidence::Arriving;
use crate::mlp::{Activation, Mlp, MlpShape};
use crate::prepared::TransportChannels;
use crate::residual::{ResidualNetwork, ResidualOutput};
use crate::row_blocks::{BlockNetwork, Column};
use crate::row_chunks::map_chunks_mut;
use crate::simd::MAGNITUDE_LIMIT;
use crate::transfer::{TransferConfig, basis_at};
use crate::vector::Vector;
use diamond_light::{Falloff, OlatLight};
use diamond_simd::{BLOCK, Lanes, Level, Simd, WithSimd, with_lanes};
use glam::Vec3;

/// Blocks that are one task.
const BLOCKS_PER_TASK: usize = 16;

/// A residual network for many lights of the same rows: the first layer's sums over the inputs that do not depend on the
/// light are done once.
#[derive(Debug, Clone)]
pub struct ManyLights {
    /// With the light's inputs alone.
    trunk: BlockNetwork,
    residual_head: BlockNetwork,
    incident_head: Option<BlockNetwork>,
    /// Outputs of the first layer.
    width: usize,
    /// First layer's bias and sums over the other inputs: `width` columns of each block.
    sums: Vec<Column>,
    batch: usize,
}

impl ResidualNetwork {
    /// Prepares for many lights of the rows `inputs` `[batch × inputs]`, in which the columns of the light
    /// ([`LIGHT_COLUMNS`]) are not looked at.
    ///
    /// Errors: as [`ResidualNetwork::forward`].
    /// `[eq:residual-network]`
    pub fn many_lights(&self, inputs: &[f32], batch: usize) -> Result<ManyLights, ShadingError> {
        self.check()?;
        let width = self.inputs();
        let expected = batch.saturating_mul(width);
        check_length("inputs of ResidualNetwork::many_lights (batch × inputs)", expected, inputs.len())?;
        let outputs = self.trunk.shape.widths[1];
        let (first, rest) = self.trunk.parameters.split_at(outputs * (width + 1));
        let (weights, bias) = first.split_at(outputs * width);
        let mut fixed = first.to_vec();
        let mut light = Vec::with_capacity(outputs * (LIGHT_COLUMNS.len() + 1) + rest.len());
        for (line, fixed) in weights.chunks_exact(width).zip(fixed.chunks_exact_mut(width)) {
            light.extend(LIGHT_COLUMNS.iter().map(|&c| line[c]));
            LIGHT_COLUMNS.iter().for_each(|&c| fixed[c] = 0.0);
        }
        // The bias is in the sums already.
        light.resize(light.len() + bias.len(), 0.0);
        light.extend_from_slice(rest);
        let shape = MlpShape { widths: vec![width, outputs], hidden: Activation::Linear, output: Activation::Linear };
        let fixed = Mlp { shape, parameters: fixed };
        let (values, _) = fixed.forward(inputs, batch)?;
        let mut shape = self.trunk.shape.clone();
        shape.widths[0] = LIGHT_COLUMNS.len();
        Ok(ManyLights {
            trunk: BlockNetwork::new(&Mlp { shape, parameters: light }),
            residual_head: BlockNetwork::new(&self.residual_head),
            incident_head: self.incident_head.as_ref().map(BlockNetwork::new),
            width: outputs,
            sums: columns(&values, outputs),
            batch,
        })
    }
}

/// Rows of `width` values → blocks of `width` columns; the last block is filled up with zeros.
fn columns(rows: &[f32], width: usize) -> Vec<Column> {
    let blocks = rows.chunks(width.max(1) * BLOCK);
    let mut out = vec![[0.0; BLOCK]; blocks.len() * width];
    for (block, out) in blocks.zip(out.chunks_exact_mut(width.max(1))) {
        for (r, row) in block.chunks_exact(width.max(1)).enumerate() {
            for (column, v) in out.iter_mut().zip(row) {
                column[r] = *v;
            }
        }
    }
    out
}

impl ManyLights {
    /// What [`ResidualNetwork::forward`] gives for the rows under one light, to rounding; `light` `[batch × 5]` holds the
    /// columns [`LIGHT_COLUMNS`] (see [`ResidualInputs::light_columns`](crate::ResidualInputs::light_columns)). A row's
    /// bits do not depend on the others.
    ///
    /// Errors: [`ShadingError::Shape`] if `light` has the wrong length.
    /// `[eq:residual-network]`
    pub fn forward(&self, light: &[f32]) -> Result<ResidualOutput, ShadingError> {
        check_length("light of ManyLights::forward (batch × 5)", self.batch * LIGHT_COLUMNS.len(), light.len())?;
        let incident = self.incident_head.is_some();
        let x = columns(light, LIGHT_COLUMNS.len());
        let (level, mut out) = (Level::current(), vec![[0.0; 4]; self.batch]);
        map_chunks_mut(&mut out, BLOCK, |block, out| {
            let x = &x[block * LIGHT_COLUMNS.len()..][..LIGHT_COLUMNS.len()];
            let mut planes = [[0.0; BLOCK]; 4];
            level.dispatch(NetworkBlock { network: self, block, x, incident, planes: &mut planes });
            for (r, out) in out.iter_mut().enumerate() {
                *out = planes.map(|plane| plane[r]);
            }
        });
        Ok(ResidualOutput {
            residual: out.iter().flat_map(|v| [v[0], v[1], v[2]]).collect(),
            incident: if incident { out.iter().map(|v| v[3]).collect() } else { Vec::new() },
        })
    }

    /// Columns that [`ManyLights::block`] writes by turns, and those of the features.
    fn scratch(&self) -> usize {
        let heads = [Some(&self.trunk), Some(&self.residual_head), self.incident_head.as_ref()];
        heads.into_iter().flatten().map(BlockNetwork::widest).max().unwrap_or(0)
    }

    /// Residual and, if asked for, incident light of a block whose light columns are `x`.
    #[inline(always)]
    fn block<S: Simd, const N: usize>(
        &self,
        s: S,
        block: usize,
        x: &[Column],
        incident: bool,
        scratch: &mut [Column],
        planes: &mut [Column; 4],
    ) {
        let width = scratch.len() / 4;
        let (first, rest) = scratch.split_at_mut(width);
        let (second, rest) = rest.split_at_mut(width);
        let (third, fourth) = rest.split_at_mut(width);
        let sums = &self.sums[block * self.width..][..self.width];
        let features = self.trunk.forward::<S, N>(s, x, Some(sums), [first, second]);
        let residual = self.residual_head.forward::<S, N>(s, features, None, [&mut *third, &mut *fourth]);
        planes[..3].copy_from_slice(&residual[..3]);
        if let Some(head) = self.incident_head.as_ref().filter(|_| incident) {
            planes[3] = head.forward::<S, N>(s, features, None, [third, fourth])[0];
        }
    }
}

/// The network alone on one block.
struct NetworkBlock<'a> {
    network: &'a ManyLights,
    block: usize,
    x: &'a [Column],
    incident: bool,
    planes: &'a mut [Column; 4],
}

impl WithSimd for NetworkBlock<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        let mut scratch = vec![[0.0; BLOCK]; 4 * self.network.scratch()];
        with_lanes!(s: S, network_block(self, &mut scratch));
    }
}

#[inline(always)]
fn network_block<S: Simd, const N: usize>(s: S, k: NetworkBlock<'_>, scratch: &mut [Column]) {
    k.network.block::<S, N>(s, k.block, k.x, k.incident, scratch, k.planes);
}

/// Rows of a view, ready for any number of lights.
#[derive(Debug, Clone)]
pub struct LitRows {
    rows: usize,
    /// Three columns of each block: positions, world.
    positions: Vec<Column>,
    network: Option<ManyLights>,
    /// 3 × coefficients columns of each block, saturated at ±1e12.
    transfer: Option<(TransferConfig, Vec<Column>)>,
    scaling: InputScaling,
}

/// Where [`LitRows::task`] writes the channels of a row under all lights.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LightChannels {
    /// Of one light, among its own.
    pub places: TransportChannels,
    /// How many each light has.
    pub per_light: usize,
}

impl LitRows {
    /// Rows at `positions` (world), with a network prepared for them, or transfer vectors `[rows × 3 × coefficients]`, or
    /// both, or neither; `scaling` as for [`ResidualInputs`](crate::ResidualInputs).
    ///
    /// Errors: [`ShadingError::Shape`] if the lengths disagree, [`ShadingError::Setting`] as in [`TransferConfig::check`].
    pub fn new(
        positions: &[Vec3],
        network: Option<ManyLights>,
        transfer: Option<(&[f32], TransferConfig)>,
        scaling: &InputScaling,
    ) -> Result<Self, ShadingError> {
        let rows = positions.len();
        if let Some(network) = &network {
            check_length("LitRows::network, rows", rows, network.batch)?;
        }
        let transfer = match transfer {
            Some((values, config)) => {
                config.check()?;
                let width = 3 * config.coefficients();
                check_length("LitRows::transfer (rows × 3 × coefficients)", rows.saturating_mul(width), values.len())?;
                let mut columns = columns(values, width);
                let limit = MAGNITUDE_LIMIT;
                columns.iter_mut().flatten().for_each(|v| *v = v.clamp(-limit, limit));
                Some((config, columns))
            }
            None => None,
        };
        let flat: Vec<f32> = positions.iter().flat_map(|p| p.to_array()).collect();
        Ok(Self { rows, positions: columns(&flat, 3), network, transfer, scaling: *scaling })
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.rows
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.rows == 0
    }

    /// Rows of one task of [`LitRows::task`].
    pub const TASK_ROWS: usize = BLOCKS_PER_TASK * BLOCK;

    /// Computes the rows of one task under every light and calls `put` with each row's number and its channels
    /// `[lights × per_light]`: residual (network and transfer vectors together), the network's incident light, and
    /// visibility, each where [`LightChannels::places`] has a place for it. What the model has not is 0. `visibility` has
    /// one value in \[0, 1\] per row for each light, or is empty for zeros.
    ///
    /// A row's bits under a light depend neither on the other rows nor on the other lights.
    ///
    /// Errors: [`ShadingError::Shape`] if the visibilities have the wrong length, or a place lies beyond a light's channels.
    /// `[eq:residual-network]` `[eq:light-transfer]` `[eq:residual-inputs]`
    pub fn task(
        &self,
        task: usize,
        level: Level,
        lights: &[(OlatLight, &[f32])],
        channels: &LightChannels,
        mut put: impl FnMut(usize, &[f32]),
    ) -> Result<(), ShadingError> {
        check_length("LitRows, last channel", channels.per_light, channels.per_light.max(channels.places.end()))?;
        for (_, visibility) in lights.iter().filter(|(_, visibility)| !visibility.is_empty()) {
            check_length("LitRows, visibility", self.rows, visibility.len())?;
        }
        let width = lights.len() * channels.per_light;
        let mut scratch = vec![[0.0; BLOCK]; 4 * self.network.as_ref().map_or(0, ManyLights::scratch)];
        let mut planes = vec![[0.0; BLOCK]; width];
        let mut row = vec![0.0; width];
        let blocks = self.rows.div_ceil(BLOCK);
        for block in (task * BLOCKS_PER_TASK..blocks).take(BLOCKS_PER_TASK) {
            level.dispatch(LitBlock {
                rows: self,
                block,
                lights,
                channels,
                scratch: &mut scratch,
                planes: &mut planes,
            });
            let first = block * BLOCK;
            for r in 0..(self.rows - first).min(BLOCK) {
                for (to, plane) in row.iter_mut().zip(&planes) {
                    *to = plane[r];
                }
                put(first + r, &row);
            }
        }
        Ok(())
    }
}

/// One block under all lights.
struct LitBlock<'a> {
    rows: &'a LitRows,
    block: usize,
    lights: &'a [(OlatLight, &'a [f32])],
    channels: &'a LightChannels,
    scratch: &'a mut [Column],
    /// `[lights × per_light]`.
    planes: &'a mut [Column],
}

impl WithSimd for LitBlock<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) {
        with_lanes!(s: S, lit_block(self));
    }
}

#[inline(always)]
fn lit_block<S: Simd, const N: usize>(s: S, k: LitBlock<'_>) {
    let LitBlock { rows, block, lights, channels, scratch, planes } = k;
    let TransportChannels { residual, incident, visibility: visible } = channels.places;
    let network = rows.network.as_ref().filter(|_| residual.is_some() || incident.is_some());
    let transfer = rows.transfer.as_ref().filter(|_| residual.is_some());
    for ((light, visibility), planes) in lights.iter().zip(planes.chunks_exact_mut(channels.per_light.max(1))) {
        let mut x = [[0.0; BLOCK]; LIGHT_COLUMNS.len()];
        if let Some(visibility) = visibility.get(block * BLOCK..) {
            let count = visibility.len().min(BLOCK);
            x[3][..count].copy_from_slice(&visibility[..count]);
        }
        if let Some(place) = visible {
            planes[place] = x[3];
        }
        let mut sums = [[0.0; BLOCK]; 4];
        if network.is_some() || transfer.is_some() {
            rows.arrive::<S, N>(s, block, light, &mut x);
        }
        if let Some(network) = network {
            network.block::<S, N>(s, block, &x, incident.is_some(), scratch, &mut sums);
        }
        if let Some((config, transfer)) = transfer {
            let width = 3 * config.coefficients();
            add_transfer::<S, N>(s, config, &transfer[block * width..][..width], &x, &mut sums);
        }
        if let Some(place) = residual {
            planes[place..place + 3].copy_from_slice(&sums[..3]);
        }
        if let Some(place) = incident {
            planes[place] = sums[3];
        }
    }
}

impl LitRows {
    /// The light's columns but its visibility.
    #[inline(always)]
    fn arrive<S: Simd, const N: usize>(&self, s: S, block: usize, light: &OlatLight, x: &mut [Column]) {
        let at = &self.positions[3 * block..][..3];
        for n in 0..N {
            let lane = n * S::F32_LANES;
            let (p, q, r) =
                (Lanes::load(s, &at[0][lane..]), Lanes::load(s, &at[1][lane..]), Lanes::load(s, &at[2][lane..]));
            let arriving = Arriving::new(light, Falloff::None, Vector::new(p, q, r));
            for (c, v) in arriving.direction.array().into_iter().enumerate() {
                v.store(&mut x[c][lane..]);
            }
            let distance = match light {
                OlatLight::Point { .. } => self.scaling.distance_input_of(arriving.distance),
                OlatLight::Directional { .. } => Lanes::splat(s, self.scaling.distance_input(f32::INFINITY)),
            };
            distance.store(&mut x[4][lane..]);
        }
    }
}

/// Adds a block's transfer vectors times the harmonics of the directions in the first three columns of `x`.
/// `[eq:light-transfer]`
#[inline(always)]
fn add_transfer<S: Simd, const N: usize>(
    s: S,
    config: &TransferConfig,
    transfer: &[Column],
    x: &[Column],
    sums: &mut [Column; 4],
) {
    let size = config.coefficients();
    for n in 0..N {
        let lane = n * S::F32_LANES;
        let (a, b, c) = (Lanes::load(s, &x[0][lane..]), Lanes::load(s, &x[1][lane..]), Lanes::load(s, &x[2][lane..]));
        let basis = basis_at(Vector::new(a, b, c));
        for c in 0..3 {
            let mut sum = Lanes::splat(s, 0.0);
            for (t, y) in transfer[c * size..(c + 1) * size].iter().zip(&basis) {
                sum = Lanes::load(s, &t[lane..]).mul_add(*y, sum);
            }
            let sum = config.activate_lanes(sum);
            (Lanes::load(s, &sums[c][lane..]) + sum).store(&mut sums[c][lane..]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::encoding::{LightDistanceInput, ResidualInputs};
    use crate::residual::ResidualNetworkConfig;
    use crate::transfer::{TransferActivation, transfer_radiance};
    use glam::Quat;

    fn random(seed: u32) -> impl FnMut() -> f32 {
        let mut state = seed;
        move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / 16_777_216.0
        }
    }

    /// [eq:residual-network] Lights prepared for give what the whole network gives, and a part of the rows gives the same
    /// bits as all of them.
    #[test]
    fn many_lights_agree_with_one_at_a_time() {
        let config = ResidualNetworkConfig { code_size: 3, ..ResidualNetworkConfig::sss_3dgs() };
        let mut uniform = random(7);
        let network = ResidualNetwork::initialise(&config, &mut uniform).unwrap();
        let (rows, width) = (230, config.inputs());
        let mut inputs: Vec<f32> = (0..rows * width).map(|_| 2.0 * uniform() - 1.0).collect();
        let prepared = network.many_lights(&inputs, rows).unwrap();
        let half = network.many_lights(&inputs[100 * width..], rows - 100).unwrap();
        for _ in 0..3 {
            let light: Vec<f32> = (0..rows * 5).map(|_| 2.0 * uniform() - 1.0).collect();
            for (row, light) in inputs.chunks_exact_mut(width).zip(light.chunks_exact(5)) {
                LIGHT_COLUMNS.iter().zip(light).for_each(|(&c, v)| row[c] = *v);
            }
            let (expected, _) = network.forward(&inputs, rows).unwrap();
            let found = prepared.forward(&light).unwrap();
            let pairs =
                expected.residual.iter().zip(&found.residual).chain(expected.incident.iter().zip(&found.incident));
            for (a, b) in pairs {
                assert!((a - b).abs() <= 2e-6 * (1.0 + a.abs()), "{a} {b}");
            }
            assert_eq!(half.forward(&light[500..]).unwrap().residual, found.residual[300..]);
        }
        assert!(prepared.forward(&[0.0; 4]).is_err() && network.many_lights(&inputs[1..], rows).is_err());
    }

    fn task_rows(rows: &LitRows, lights: &[(OlatLight, &[f32])], channels: &LightChannels, level: Level) -> Vec<f32> {
        let width = lights.len() * channels.per_light;
        let mut out = vec![f32::NAN; rows.len() * width];
        for task in 0..rows.len().div_ceil(LitRows::TASK_ROWS) {
            let put = |row: usize, values: &[f32]| out[row * width..(row + 1) * width].copy_from_slice(values);
            rows.task(task, level, lights, channels, put).unwrap();
        }
        out
    }

    /// [eq:residual-network] [eq:light-transfer] [eq:residual-inputs] Rows under lights, near, distant and at infinity: what
    /// the functions that are made for one light say, and the same bits whatever other lights and rows there are.
    #[test]
    fn rows_under_lights_agree_with_one_light_at_a_time() {
        let mut uniform = random(3);
        let n = 300;
        let mut vector = || 2.0 * Vec3::new(uniform(), uniform(), uniform()) - 1.0;
        let positions: Vec<Vec3> = (0..n).map(|_| vector()).collect();
        let normals: Vec<Vec3> = (0..n).map(|_| vector().normalize()).collect();
        let config = ResidualNetworkConfig::sss_3dgs();
        let network = ResidualNetwork::initialise(&config, &mut uniform).unwrap();
        let mut scaling = InputScaling::of_bounds(Vec3::NEG_ONE, Vec3::ONE);
        let intensity = Vec3::ONE;
        let lights = [
            OlatLight::Point { position: Vec3::new(2.0, -1.0, 3.0), intensity },
            OlatLight::Directional { direction: Vec3::new(0.6, 0.0, 0.8), irradiance: intensity },
            OlatLight::Point { position: positions[7], intensity },
            OlatLight::Point { position: Vec3::new(-300.0, 10.0, 3.0), intensity },
        ];
        let visibility: Vec<Vec<f32>> = lights.iter().map(|_| (0..n).map(|_| uniform()).collect()).collect();
        let softplus = TransferActivation::Softplus { sharpness: 5.0 };
        let modes = [
            (LightDistanceInput::Linear, 2, TransferActivation::Linear),
            (LightDistanceInput::Bounded { reference: 3.0 }, 3, TransferActivation::Linear),
            (LightDistanceInput::Bounded { reference: 3.0 }, 1, softplus),
        ];
        for (light_distance, degree, activation) in modes {
            scaling.light_distance = light_distance;
            let transfer_config = TransferConfig { degree, activation };
            let width = 3 * transfer_config.coefficients();
            let transfer: Vec<f32> = (0..n * width).map(|_| uniform() - 0.5).collect();
            let (zeros, scales) = (vec![0.0; n], vec![Vec3::ONE; n]);
            let inputs = ResidualInputs {
                positions: &positions,
                rotations: &vec![Quat::IDENTITY; n],
                scales: &scales,
                view_directions: &normals,
                light_directions: &normals,
                normals: &normals,
                visibility: &zeros,
                light_distances: &zeros,
                codes: &[],
                code_size: 0,
            };
            let (matrix, _) = inputs.assemble(&scaling).unwrap();
            let many = network.many_lights(&matrix, n).unwrap();
            let rows = LitRows::new(&positions, Some(many), Some((&transfer, transfer_config)), &scaling).unwrap();
            let places = TransportChannels { residual: Some(1), incident: Some(0), visibility: Some(4) };
            let channels = LightChannels { places, per_light: 5 };
            let lit: Vec<(OlatLight, &[f32])> =
                lights.iter().zip(&visibility).map(|(light, v)| (*light, v.as_slice())).collect();
            let found = task_rows(&rows, &lit, &channels, Level::current());
            for (k, light) in lights.iter().enumerate() {
                let incidence: Vec<_> = positions.iter().map(|p| light.incidence(*p, Falloff::None)).collect();
                let directions: Vec<Vec3> = incidence.iter().map(|i| i.direction).collect();
                let distances: Vec<f32> = incidence.iter().map(|i| i.distance).collect();
                let inputs = ResidualInputs {
                    light_directions: &directions,
                    light_distances: &distances,
                    visibility: &visibility[k],
                    ..inputs
                };
                let (matrix, _) = inputs.assemble(&scaling).unwrap();
                let (expected, _) = network.forward(&matrix, n).unwrap();
                let (transported, _) = transfer_radiance(&transfer, &directions, transfer_config).unwrap();
                for i in 0..n {
                    let found = &found[(i * lights.len() + k) * 5..][..5];
                    let residual = |c: usize| expected.residual[3 * i + c] + transported[3 * i + c];
                    let all = [expected.incident[i], residual(0), residual(1), residual(2), visibility[k][i]];
                    for (a, b) in all.iter().zip(found) {
                        assert!((a - b).abs() <= 4e-6 * (1.0 + a.abs()), "light {k} row {i}: {a} {b}");
                    }
                }
                let alone = task_rows(&rows, &lit[k..k + 1], &channels, Level::current());
                let among: Vec<f32> = found.chunks(20).flat_map(|row| row[5 * k..5 * k + 5].to_vec()).collect();
                assert_eq!(alone, among);
                let fewer = TransportChannels { residual: Some(0), incident: None, visibility: None };
                let few = LightChannels { places: fewer, per_light: 3 };
                let residuals: Vec<f32> = among.chunks(5).flat_map(|row| row[1..4].to_vec()).collect();
                assert_eq!(task_rows(&rows, &lit[k..k + 1], &few, Level::current()), residuals);
            }
            let mut fused: Option<Vec<f32>> = None;
            for level in Level::testable().into_iter().filter(|level| level.is_fused()) {
                let found = task_rows(&rows, &lit, &channels, level);
                assert_eq!(*fused.get_or_insert_with(|| found.clone()), found, "{level:?}");
            }
        }
    }

    #[test]
    fn rows_that_do_not_fit_are_refused() {
        let scaling = InputScaling::of_bounds(Vec3::NEG_ONE, Vec3::ONE);
        let config = TransferConfig { degree: 2, activation: TransferActivation::Linear };
        assert!(LitRows::new(&[Vec3::ZERO], None, Some((&[0.0; 26], config)), &scaling).is_err());
        let rows = LitRows::new(&[Vec3::ZERO], None, None, &scaling).unwrap();
        let light = OlatLight::Directional { direction: Vec3::Z, irradiance: Vec3::ONE };
        let places = TransportChannels { residual: Some(0), incident: None, visibility: None };
        let task = |visibility: &[f32], per_light: usize| {
            let channels = LightChannels { places, per_light };
            rows.task(0, Level::current(), &[(light, visibility)], &channels, |_, _| ())
        };
        assert!(task(&[1.0], 3).is_ok() && task(&[], 3).is_ok());
        assert!(task(&[1.0, 1.0], 3).is_err() && task(&[1.0], 2).is_err());
    }
}
