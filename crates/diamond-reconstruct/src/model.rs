//! The model: Gaussians with materials, the residual network, the scene that they live in; and its files.
use crate::adam::Moments;
use crate::random::{Purpose, Random};
use crate::scene::InitialPoints;
use crate::{
    Attribute, Config, Covariance, Exposure, ExposureFile, ExposureMode, GaussianParameters, InitialNormals, Layout,
    MediumTerm, MetalVariant, ReconstructError, Renderer, Rendering, Scene, TensorFile, error, logit, write_atomically,
};
use diamond_camera::Camera;
use diamond_light::OlatLight;
use diamond_medium::{Medium, Surface};
use diamond_shading::{Activation, Mlp, ResidualNetwork, ResidualNetworkConfig};
use diamond_splat::{PlyFormat, PlyTable, ScalarType, mean_squared_distance_to_nearest, ply_bytes, read_ply};
use glam::{Quat, Vec3};
use std::path::Path;

/// A relightable model.
#[derive(Debug, Clone)]
pub struct Model {
    /// Raw parameters of the Gaussians, with Adam moments.
    pub parameters: GaussianParameters,
    /// The residual network, if the configuration uses one.
    pub network: Option<ResidualNetwork>,
    /// Adam moments of the network: trunk, residual head, incident head.
    pub network_moments: [Moments; 3],
    /// The medium inside, once one was fitted.
    pub medium: Option<MediumTerm>,
    /// Gains of the photographs.
    pub exposure: Exposure,
    /// Where the object is and how bright the lights are.
    pub scene: Scene,
    /// The configuration that it was made with.
    pub config: Config,
}

/// Smallest initial standard deviation, × scene radius: coincident points would otherwise start at 0.
const MIN_INITIAL_SCALE: f32 = 1e-4;
/// Largest initial standard deviation, × scene radius: lone points would otherwise cover the image.
const MAX_INITIAL_SCALE: f32 = 0.1;

/// The fitted medium, in a run's folder.
pub(crate) const MEDIUM_FILE: &str = "medium.toml";
/// The surface that it fills, in a run's folder.
pub(crate) const SURFACE_FILE: &str = "surface.ply";

/// Gains of the photographs, in a run's folder.
const EXPOSURE_FILE: &str = "exposure.toml";

/// The network's shape under a configuration.
pub(crate) fn network_config(config: &Config) -> ResidualNetworkConfig {
    let mut out = ResidualNetworkConfig::sss_3dgs();
    out.trunk = config.residual.hidden.clone();
    out.hidden =
        if config.residual.leak > 0.0 { Activation::LeakyRelu(config.residual.leak) } else { Activation::Relu };
    out.code_size = config.residual.codes;
    out.incident_bias = config.residual.incident_bias;
    if config.shading.incident != crate::IncidentVariant::Learned {
        out.incident_head = None;
    }
    out
}

impl Model {
    /// The model before the first step.
    pub fn initial(config: &Config, scene: Scene, points: &InitialPoints) -> Result<Self, ReconstructError> {
        let n = points.positions.len();
        let mut parameters = GaussianParameters::zeros(n, &Layout::of(config));
        let mut random = Random::new(config.seed, Purpose::Initial, 1);
        let distances = mean_squared_distance_to_nearest(&points.positions, 3);
        for i in 0..n {
            let p = points.positions[i];
            let outward =
                points.normals[i].try_normalize().or_else(|| (p - scene.centre()).try_normalize()).unwrap_or(Vec3::Z);
            let width = distances[i].sqrt().clamp(MIN_INITIAL_SCALE * scene.radius, MAX_INITIAL_SCALE * scene.radius);
            let flat = config.initial.flatness < 1.0;
            let rotation = if flat { Quat::from_rotation_arc(Vec3::Z, outward) } else { Quat::IDENTITY };
            let normal = match config.initial.normals {
                InitialNormals::Outward => outward,
                InitialNormals::Random => random.direction(),
            };
            let mut set = |a: Attribute, v: &[f32]| {
                let w = v.len();
                parameters.values_mut(a)[i * w..(i + 1) * w].copy_from_slice(v);
            };
            set(Attribute::Mean, &p.to_array());
            set(Attribute::Opacity, &[logit(config.initial.opacity)]);
            set(Attribute::Normal, &normal.to_array());
            if config.shading.metal == MetalVariant::No {
                set(Attribute::Metalness, &[logit(0.0)]);
            }
            let (mut scales, mut orientation) =
                (Vec3::new(width, width, width * config.initial.flatness.max(1e-3)), rotation);
            if let Some(splats) = &points.splats {
                (scales, orientation) = (splats.scales[i], splats.rotations[i]);
                parameters.values_mut(Attribute::Opacity)[i] = splats.opacity_logits[i];
            }
            parameters.set_covariance(i, scales, orientation);
        }
        let network = match config.residual.network {
            true => {
                let mut weights = Random::new(config.seed, Purpose::Network, 0);
                Some(
                    ResidualNetwork::initialise(&network_config(config), &mut || weights.uniform())
                        .map_err(error::stage("network"))?,
                )
            }
            false => None,
        };
        let network_moments = network_moments(network.as_ref());
        let exposure = Exposure::default();
        Ok(Self { parameters, network, network_moments, medium: None, exposure, scene, config: config.clone() })
    }

    /// Renders one camera under each light, with all maps. For several cameras or for the radiance alone see [`Renderer`].
    pub fn render(&self, camera: &Camera, lights: &[OlatLight]) -> Result<Vec<Rendering>, ReconstructError> {
        Renderer::new(self).renderings(camera, lights)
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.parameters.len()
    }

    /// Whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.parameters.is_empty()
    }

    /// Writes `model.ply` (standard 3DGS attributes and ours), `network.safetensors`, `scene.toml`,
    /// `config.toml`, and `exposure.toml` where gains were learned.
    pub fn save(&self, folder: &Path) -> Result<(), ReconstructError> {
        std::fs::create_dir_all(folder).map_err(|source| ReconstructError::Io {
            path: folder.to_owned(),
            action: "create the folder",
            source,
        })?;
        let table = ply_bytes(&self.to_ply(), PlyFormat::BinaryLittleEndian).map_err(error::stage("model.ply"))?;
        write_atomically(&folder.join("model.ply"), &table)?;
        write_atomically(&folder.join("config.toml"), self.config.to_toml()?.as_bytes())?;
        let scene = toml::to_string_pretty(&self.scene)
            .map_err(|e| ReconstructError::Config { origin: "scene".into(), detail: e.to_string() })?;
        write_atomically(&folder.join("scene.toml"), scene.as_bytes())?;
        if self.config.exposure.mode != ExposureMode::Fixed {
            let text = toml::to_string_pretty(&self.exposure.to_file())
                .map_err(|e| ReconstructError::Config { origin: "exposure".into(), detail: e.to_string() })?;
            write_atomically(&folder.join(EXPOSURE_FILE), text.as_bytes())?;
        }
        let mut file = TensorFile::default();
        for (name, values) in self.network_tensors() {
            file.insert(name, &[values.len()], values.to_vec());
        }
        file.write(&folder.join("network.safetensors"))?;
        self.save_medium(folder)
    }

    fn save_medium(&self, folder: &Path) -> Result<(), ReconstructError> {
        let Some(term) = &self.medium else { return Ok(()) };
        let text = term.medium().to_toml().map_err(error::stage("medium"))?;
        write_atomically(&folder.join(SURFACE_FILE), &term.surface().mesh().to_ply())?;
        write_atomically(&folder.join(MEDIUM_FILE), text.as_bytes())
    }

    /// What the network adds to a medium may be less than nothing, and begins at nothing: its last layer is then linear, where a sigmoid would begin at ½.
    pub(crate) fn match_residual_output(&mut self) {
        if let Some(network) = &mut self.network {
            network.residual_head.shape.output = match self.medium {
                Some(_) => Activation::Linear,
                None => Activation::Sigmoid,
            };
        }
    }

    fn load_medium(&mut self, folder: &Path) -> Result<(), ReconstructError> {
        let (medium, surface) = (folder.join(MEDIUM_FILE), folder.join(SURFACE_FILE));
        if !self.config.subsurface.model.has_medium() || !medium.exists() {
            return Ok(());
        }
        let fail = |path: &Path, detail: String| ReconstructError::Checkpoint { path: path.to_owned(), detail };
        let mesh = diamond_pathtrace::read_ply(&surface).map_err(|e| fail(&surface, e.to_string()))?;
        let surface = Surface::new(mesh, self.config.subsurface.surfels).map_err(|e| fail(&surface, e.to_string()))?;
        let medium = Medium::read(&medium).map_err(|e| fail(&medium, e.to_string()))?;
        let activated = self.parameters.activate();
        let falloff = self.scene.falloff(&self.config);
        let (means, normals) = (&activated.gaussians.means, &activated.normals);
        self.medium = Some(MediumTerm::new(surface, medium, falloff, means, normals)?);
        Ok(())
    }

    /// Reads what [`Model::save`] wrote. Adam moments are zero.
    pub fn load(folder: &Path) -> Result<Self, ReconstructError> {
        let read = |name: &str| {
            let path = folder.join(name);
            std::fs::read_to_string(&path).map_err(|source| ReconstructError::Io {
                path,
                action: "read (is this the folder of a finished reconstruction?)",
                source,
            })
        };
        let origin = folder.join("config.toml").display().to_string();
        let config = Config::parse(&read("config.toml")?, &origin)?;
        let scene: Scene = toml::from_str(&read("scene.toml")?)
            .map_err(|e| ReconstructError::Config { origin: "scene.toml".into(), detail: error::brief(e) })?;
        let path = folder.join("model.ply");
        let table =
            read_ply(&path).map_err(|e| ReconstructError::Checkpoint { path: path.clone(), detail: e.to_string() })?;
        let parameters = from_ply(&table, &config, &path)?;
        let mut model = Self {
            parameters,
            network: None,
            network_moments: Default::default(),
            medium: None,
            exposure: Exposure::default(),
            scene,
            config: config.clone(),
        };
        if config.exposure.mode != ExposureMode::Fixed {
            let file: ExposureFile = toml::from_str(&read(EXPOSURE_FILE)?)
                .map_err(|e| ReconstructError::Config { origin: EXPOSURE_FILE.into(), detail: e.to_string() })?;
            model.exposure = Exposure::from_file(&file);
        }
        if config.residual.network {
            let mut network =
                ResidualNetwork::initialise(&network_config(&config), &mut || 0.5).map_err(error::stage("network"))?;
            let path = folder.join("network.safetensors");
            let mut file = TensorFile::read(&path)?;
            for (name, values) in network_parts_mut(&mut network) {
                let n = values.len();
                *values = file.take(&path, name, n)?;
            }
            model.network_moments = network_moments(Some(&network));
            model.network = Some(network);
        }
        model.load_medium(folder)?;
        model.match_residual_output();
        Ok(model)
    }

    /// The networks' parameters by name.
    pub(crate) fn network_tensors(&self) -> Vec<(&'static str, &[f32])> {
        let Some(network) = &self.network else { return Vec::new() };
        let mut out: Vec<(&'static str, &[f32])> = vec![
            ("trunk", network.trunk.parameters.as_slice()),
            ("residual_head", network.residual_head.parameters.as_slice()),
        ];
        if let Some(head) = &network.incident_head {
            out.push(("incident_head", head.parameters.as_slice()));
        }
        out
    }

    fn to_ply(&self) -> PlyTable {
        let p = &self.parameters;
        let mut table = PlyTable::new(p.len());
        table.comments.push("diamond-sss: raw values, before activation".into());
        let mut push = |name: String, attribute: Attribute, column: usize| {
            let group = p.group(attribute);
            let values = group.values.iter().skip(column).step_by(group.width).copied().collect();
            table.push(name, ScalarType::F32, values);
        };
        let axes = ["x", "y", "z"];
        for (k, name) in axes.iter().enumerate() {
            push((*name).into(), Attribute::Mean, k);
        }
        for (k, name) in axes.iter().enumerate() {
            push(format!("n{name}"), Attribute::Normal, k);
        }
        for k in 0..3 {
            push(format!("base_color_{k}"), Attribute::BaseColor, k);
        }
        if p.covariance() == Covariance::RotationScale {
            (0..3).for_each(|k| push(format!("scale_{k}"), Attribute::Scale, k));
            (0..4).for_each(|k| push(format!("rot_{k}"), Attribute::Rotation, k));
        } else {
            // What we read back; other programs find the decomposition below.
            (0..3).for_each(|k| push(format!("cholesky_{k}"), Attribute::Scale, k));
            (0..3).for_each(|k| push(format!("cholesky_{}", 3 + k), Attribute::Shear, k));
        }
        for attribute in [Attribute::Opacity, Attribute::Roughness, Attribute::Metalness, Attribute::Subsurfaceness] {
            push(attribute.name().into(), attribute, 0);
        }
        for (prefix, attribute) in SEQUENCES {
            for k in 0..p.group(attribute).width {
                push(format!("{prefix}_{k}"), attribute, k);
            }
        }
        // Other programs show f_dc as base + ½ over the degree-0 harmonic: give them the base colour.
        let activated = p.activate();
        if p.covariance() == Covariance::Cholesky {
            let g = &activated.gaussians;
            for k in 0..3 {
                let values = g.scales.iter().map(|s| libm::logf(s[k].max(f32::MIN_POSITIVE))).collect();
                table.push(format!("scale_{k}"), ScalarType::F32, values);
            }
            for (k, component) in [3, 0, 1, 2].into_iter().enumerate() {
                let values = g.rotations.iter().map(|q| q.to_array()[component]).collect();
                table.push(format!("rot_{k}"), ScalarType::F32, values);
            }
        }
        for k in 0..3 {
            let values = activated.base_color.iter().map(|c| (c[k] - 0.5) / SH_DEGREE_0).collect();
            table.push(format!("f_dc_{k}"), ScalarType::F32, values);
        }
        table
    }
}

/// The degree-0 real spherical harmonic, 1 / (2√π).
const SH_DEGREE_0: f32 = 0.282_094_8;

/// Column prefixes of the attributes that are numbered sequences.
const SEQUENCES: [(&str, Attribute); 3] =
    [("vis_sh", Attribute::VisibilitySh), ("transfer", Attribute::Transfer), ("code", Attribute::Codes)];

fn from_ply(table: &PlyTable, config: &Config, path: &Path) -> Result<GaussianParameters, ReconstructError> {
    let n = table.len;
    let mut parameters = GaussianParameters::zeros(n, &Layout::of(config));
    let mut fill = |name: &str, attribute: Attribute, column: usize| -> Result<(), ReconstructError> {
        let values = table.column(name).ok_or_else(|| ReconstructError::Checkpoint {
            path: path.to_owned(),
            detail: format!("property `{name}` is missing; expected a model that `diamond reconstruct` wrote"),
        })?;
        let group = parameters.group_mut(attribute);
        for (i, &v) in values.iter().enumerate() {
            group.values[i * group.width + column] = v;
        }
        Ok(())
    };
    for (k, name) in ["x", "y", "z"].iter().enumerate() {
        fill(name, Attribute::Mean, k)?;
        fill(&format!("n{name}"), Attribute::Normal, k)?;
        fill(&format!("base_color_{k}"), Attribute::BaseColor, k)?;
    }
    if config.model.covariance == Covariance::RotationScale {
        (0..3).try_for_each(|k| fill(&format!("scale_{k}"), Attribute::Scale, k))?;
        (0..4).try_for_each(|k| fill(&format!("rot_{k}"), Attribute::Rotation, k))?;
    } else {
        (0..3).try_for_each(|k| fill(&format!("cholesky_{k}"), Attribute::Scale, k))?;
        (0..3).try_for_each(|k| fill(&format!("cholesky_{}", 3 + k), Attribute::Shear, k))?;
    }
    for attribute in [Attribute::Opacity, Attribute::Roughness, Attribute::Metalness, Attribute::Subsurfaceness] {
        fill(attribute.name(), attribute, 0)?;
    }
    for (prefix, attribute) in SEQUENCES {
        let width = match attribute {
            Attribute::VisibilitySh => diamond_light::spherical_harmonics::COEFFICIENTS,
            Attribute::Transfer => config.residual.transfer_width(),
            _ => config.residual.codes,
        };
        for k in 0..width {
            fill(&format!("{prefix}_{k}"), attribute, k)?;
        }
    }
    Ok(parameters)
}

/// The networks' parameter vectors by name, mutable.
pub(crate) fn network_parts_mut(network: &mut ResidualNetwork) -> Vec<(&'static str, &mut Vec<f32>)> {
    let mut out =
        vec![("trunk", &mut network.trunk.parameters), ("residual_head", &mut network.residual_head.parameters)];
    if let Some(head) = &mut network.incident_head {
        out.push(("incident_head", &mut head.parameters));
    }
    out
}

fn network_moments(network: Option<&ResidualNetwork>) -> [Moments; 3] {
    let Some(network) = network else { return Default::default() };
    let of = |m: &Mlp| Moments::zeros(m.parameters.len());
    [of(&network.trunk), of(&network.residual_head), network.incident_head.as_ref().map(of).unwrap_or_default()]
}
