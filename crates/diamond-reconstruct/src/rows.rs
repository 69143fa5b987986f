//! The visible Gaussians row by row: what the residual reads of them, and the feature rows that the rasteriser blends.
use crate::channel_layout::ChannelLayout;
use crate::medium_term::MediumRows;
use crate::{Activated, Attribute, Model, ReconstructError, error};
use diamond_camera::Camera;
use diamond_light::{OlatLight, spherical_harmonics};
use diamond_shading::{InputScaling, LightDistanceInput, ResidualInputs, TransferActivation, TransferConfig, channel};
use diamond_splat::Features;
use glam::{Quat, Vec3};

/// The light-independent inputs of the visible Gaussians' residual, row by row.
pub(crate) struct Rows {
    /// Indices of the Gaussians, ascending.
    pub visible: Vec<u32>,
    /// World.
    pub positions: Vec<Vec3>,
    /// Unit.
    pub rotations: Vec<Quat>,
    /// Standard deviations, scene units.
    pub scales: Vec<Vec3>,
    /// Unit, world.
    pub normals: Vec<Vec3>,
    /// Unit, toward the camera.
    pub view_directions: Vec<Vec3>,
    /// Rows × code size.
    pub codes: Vec<f32>,
    /// Rows × transfer width.
    pub transfer: Vec<f32>,
}

fn gather(values: &[f32], width: usize, rows: &[u32]) -> Vec<f32> {
    rows.iter().flat_map(|&i| values[i as usize * width..(i as usize + 1) * width].iter().copied()).collect()
}

impl Rows {
    /// Of the Gaussians `visible` from `camera`.
    pub fn new(model: &Model, activated: &Activated, camera: &Camera, visible: &[u32]) -> Self {
        let eye = camera.pose.centre();
        let toward = |i: &u32| (eye - activated.gaussians.means[*i as usize]).try_normalize().unwrap_or(Vec3::Z);
        Self::with_view_directions(model, activated, visible.iter().map(toward).collect(), visible)
    }

    /// Of the Gaussians `visible`, each seen from a direction of its own.
    pub fn with_view_directions(
        model: &Model,
        activated: &Activated,
        view_directions: Vec<Vec3>,
        visible: &[u32],
    ) -> Self {
        let pick = |v: &[Vec3]| visible.iter().map(|&i| v[i as usize]).collect::<Vec<Vec3>>();
        let g = &activated.gaussians;
        let positions = pick(&g.means);
        let residual = &model.config.residual;
        Self {
            view_directions,
            rotations: visible.iter().map(|&i| unit(g.rotations[i as usize])).collect(),
            scales: pick(&g.scales),
            normals: pick(&activated.normals),
            codes: gather(model.parameters.values(Attribute::Codes), residual.codes, visible),
            transfer: gather(model.parameters.values(Attribute::Transfer), residual.transfer_width(), visible),
            positions,
            visible: visible.to_vec(),
        }
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.visible.len()
    }
}

/// Quaternions shorter than this have no direction.
const MIN_QUATERNION: f32 = 1e-12;

fn unit(q: Quat) -> Quat {
    let length = q.length();
    if length > MIN_QUATERNION { q / length } else { Quat::IDENTITY }
}

/// The light-dependent inputs, row by row.
pub(crate) struct LightRows {
    /// Visibility used for shading: traced where it was, else the SH fit; zeros where nothing reads it.
    pub visibility: Vec<f32>,
    /// Unit direction to the light.
    pub directions: Vec<Vec3>,
    /// Distance to the light, scene units; infinite for directional lights.
    pub distances: Vec<f32>,
}

/// Where the visibility of a row comes from.
#[derive(Clone, Copy)]
pub(crate) enum VisibilitySource<'a> {
    /// One traced value per Gaussian.
    Traced(&'a [f32]),
    /// The SH fit.
    Fitted,
    /// Nothing reads it.
    Unread,
}

impl LightRows {
    /// `rows` rows without a light, for what does not depend on it.
    pub fn dark(rows: usize) -> Self {
        Self { visibility: vec![0.0; rows], directions: vec![Vec3::ZERO; rows], distances: vec![0.0; rows] }
    }

    /// Of `rows` under `light`.
    pub fn new(
        model: &Model,
        rows: &Rows,
        light: &OlatLight,
        source: VisibilitySource<'_>,
    ) -> Result<Self, ReconstructError> {
        let incidence: Vec<_> =
            rows.positions.iter().map(|p| light.incidence(*p, diamond_light::Falloff::None)).collect();
        let directions: Vec<Vec3> = incidence.iter().map(|i| i.direction).collect();
        let visibility = match source {
            VisibilitySource::Traced(v) => rows.visible.iter().map(|&i| v[i as usize]).collect(),
            VisibilitySource::Unread => vec![0.0; rows.len()],
            VisibilitySource::Fitted => {
                let sh = gather(
                    model.parameters.values(Attribute::VisibilitySh),
                    spherical_harmonics::COEFFICIENTS,
                    &rows.visible,
                );
                diamond_shading::sh_visibility::visibilities(&sh, &directions).map_err(error::stage("visibility"))?
            }
        };
        Ok(Self { visibility, directions, distances: incidence.iter().map(|i| i.distance).collect() })
    }
}

/// What the network reads.
pub(crate) fn residual_inputs<'a>(model: &Model, rows: &'a Rows, lit: &'a LightRows) -> ResidualInputs<'a> {
    ResidualInputs {
        positions: &rows.positions,
        rotations: &rows.rotations,
        scales: &rows.scales,
        view_directions: &rows.view_directions,
        light_directions: &lit.directions,
        normals: &rows.normals,
        visibility: &lit.visibility,
        light_distances: &lit.distances,
        codes: &rows.codes,
        code_size: model.config.residual.codes,
    }
}

/// How the network's inputs are made dimensionless.
pub(crate) fn input_scaling(model: &Model) -> InputScaling {
    let (centre, half) = (model.scene.centre(), Vec3::splat(model.scene.radius));
    let mut scaling = InputScaling::of_bounds(centre - half, centre + half);
    scaling.light_distance = LightDistanceInput::Bounded { reference: model.scene.light_distance };
    scaling
}

/// The transfer vectors' shape, if the model has any.
pub(crate) fn transfer_config(model: &Model) -> Option<TransferConfig> {
    let residual = &model.config.residual;
    let degree = residual.transfer_degree as usize;
    residual.transfer.then_some(TransferConfig { degree, activation: TransferActivation::Linear })
}

/// Feature rows of the visible Gaussians with the light-independent channels filled in.
pub(crate) fn geometry_features(activated: &Activated, visible: &[u32], layout: &ChannelLayout) -> Features {
    let mut features = Features::zeros(activated.gaussians.len(), layout.count());
    for &i in visible {
        write_geometry(activated, i as usize, layout, features.row_mut(i as usize));
    }
    features
}

/// Writes the light-independent channels of a Gaussian.
pub(crate) fn write_geometry(activated: &Activated, i: usize, layout: &ChannelLayout, row: &mut [f32]) {
    for (c, v) in channel::BASE_COLOR.zip(activated.base_color[i].to_array()) {
        layout.put(row, c, v);
    }
    layout.put(row, channel::ROUGHNESS, activated.roughness[i]);
    layout.put(row, channel::METALNESS, activated.metalness[i]);
    layout.put(row, channel::SUBSURFACENESS, activated.subsurfaceness[i]);
    for (c, v) in channel::NORMAL.zip(activated.normals[i].to_array()) {
        layout.put(row, c, v);
    }
}

/// Residual and incident light of each row: network and transfer vectors together.
pub(crate) struct Transported<'a> {
    /// Of the network: residual (rows × 3) and incident light (rows, or empty).
    pub network: Option<(&'a [f32], &'a [f32])>,
    /// Of the transfer vectors, rows × 3.
    pub transfer: Option<&'a [f32]>,
    /// Of the medium.
    pub medium: Option<&'a MediumRows>,
    /// Visibility per row.
    pub visibility: &'a [f32],
}

impl Transported<'_> {
    /// Residual of a row.
    pub fn residual(&self, row: usize) -> [f32; 3] {
        std::array::from_fn(|k| {
            let network = self.network.map_or(0.0, |(residual, _)| residual[3 * row + k]);
            let medium = self.medium.map_or(0.0, |m| m.residual(row)[k]);
            network + self.transfer.map_or(0.0, |t| t[3 * row + k]) + medium
        })
    }

    /// Incident light of a row.
    pub fn incident(&self, row: usize) -> f32 {
        self.network.map_or(0.0, |(_, incident)| incident.get(row).copied().unwrap_or(0.0))
    }

    /// Writes the light-dependent channels of `layout` into the visible rows, `offset` channels further on.
    pub fn write(&self, features: &mut Features, offset: usize, visible: &[u32], layout: &ChannelLayout) {
        for (row, &i) in visible.iter().enumerate() {
            let out = &mut features.row_mut(i as usize)[offset..];
            for (c, v) in channel::RESIDUAL.zip(self.residual(row)) {
                layout.put(out, c, v);
            }
            layout.put(out, channel::INCIDENT, self.incident(row));
            layout.put(out, channel::VISIBILITY, self.visibility[row]);
        }
    }
}
