//! Traced visibility of every Gaussian toward every light, traced again only when it is old and something has moved.
//!
//! Toward the end of a run the Gaussians hardly move, and a trace would give what the last one gave. So they are compared
//! with where they were at a reference step: while no more than [`MOVED_SHARE`] of them have moved, grown, turned or
//! changed in opacity by `visibility.moved`, a light that was traced since the reference step keeps its visibility however
//! old it is. Otherwise the reference moves up to the present and every old light is traced again. Between the trace of
//! a light and its use lie two such distances at most.
//!
//! The Gaussians are prepared once for all lights traced in a step. Where a light lies among them and a hierarchy is
//! needed, it is not refitted from step to step: the order in which a ray meets the Gaussians, and with it the last bit
//! of its transmittance, would depend on when the tree was first built, and an interrupted run could not go on with the
//! same bits.
use crate::Visibility;
use crate::{ReconstructError, TensorFile, error};
use diamond_light::OlatLight;
use diamond_splat::{GaussianBvh, Gaussians, LightGrid, VisibilityConfig};
use glam::{Quat, Vec3};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::OnceLock;

/// Bits that identify a light: position or direction. Intensity does not change visibility.
pub(crate) type LightKey = [u32; 4];

/// Visibility toward one light.
#[derive(Debug, Clone, PartialEq)]
struct Entry {
    /// Step of the trace.
    step: u64,
    /// Number of the reference at the trace.
    reference: u64,
    values: Vec<f32>,
}

/// The Gaussians at the reference step.
#[derive(Debug, Clone, Default, PartialEq)]
struct Reference {
    /// How many references there have been.
    number: u64,
    means: Vec<Vec3>,
    scales: Vec<Vec3>,
    rotations: Vec<Quat>,
    opacities: Vec<f32>,
}

/// Visibility per light, with the step at which it was traced.
#[derive(Default)]
pub struct VisibilityCache {
    entries: BTreeMap<LightKey, Entry>,
    reference: Reference,
    /// Prepared for the step.
    tracer: Option<(u64, Tracer)>,
    /// The step whose Gaussians were last compared with the reference.
    compared: Option<u64>,
    /// Lights traced so far.
    pub traced: u64,
    /// Look-ups so far.
    pub lookups: u64,
    /// Look-ups of old visibility that was kept since nothing had moved.
    pub kept: u64,
    /// Times that the Gaussians were prepared so far.
    pub built: u64,
}

/// Entries beyond this many lights are dropped, oldest first: turntable captures have one light per image.
const MAX_LIGHTS: usize = 512;

/// Share of the Gaussians that may have moved farther before visibility counts as changed.
pub const MOVED_SHARE: f64 = 0.01;

pub(crate) fn key(light: &OlatLight) -> LightKey {
    let (kind, v) = match *light {
        OlatLight::Point { position, .. } => (0, position),
        OlatLight::Directional { direction, .. } => (1, direction),
    };
    [kind, v.x.to_bits(), v.y.to_bits(), v.z.to_bits()]
}

/// The Gaussians as they stand, for the visibility of any number of lights: seen from the light where it lies outside of
/// them, else by rays through a hierarchy that is built when the first such light comes.
pub struct Tracer {
    grid: LightGrid,
    hierarchy: OnceLock<GaussianBvh>,
}

impl Tracer {
    /// Prepares the Gaussians and their outward normals.
    pub fn new(gaussians: &Gaussians, normals: &[Vec3]) -> Result<Self, ReconstructError> {
        let grid = LightGrid::new(gaussians, Some(normals), &VisibilityConfig::default());
        Ok(Self { grid: grid.map_err(error::stage("visibility"))?, hierarchy: OnceLock::new() })
    }

    /// Visibility of every Gaussian toward one light. `gaussians` and `normals` are those that were prepared.
    pub fn trace(
        &self,
        gaussians: &Gaussians,
        normals: &[Vec3],
        light: &OlatLight,
    ) -> Result<Vec<f32>, ReconstructError> {
        let all: Vec<u32> = (0..gaussians.len() as u32).collect();
        self.trace_rows(gaussians, normals, light, &all)
    }

    /// Visibility of the Gaussians `rows` toward one light.
    pub fn trace_rows(
        &self,
        gaussians: &Gaussians,
        normals: &[Vec3],
        light: &OlatLight,
        rows: &[u32],
    ) -> Result<Vec<f32>, ReconstructError> {
        let fail = error::stage("visibility");
        if let Some(found) = self.grid.visibility(light, rows).map_err(&fail)? {
            return Ok(found);
        }
        let hierarchy = match self.hierarchy.get() {
            Some(hierarchy) => hierarchy,
            None => {
                let built = GaussianBvh::build(gaussians).map_err(&fail)?;
                self.hierarchy.get_or_init(|| built)
            }
        };
        let config = VisibilityConfig::default();
        hierarchy.visibility_subset(gaussians, Some(normals), light, &config, rows).map_err(fail)
    }
}

impl Reference {
    fn of(gaussians: &Gaussians, number: u64) -> Self {
        Self {
            number,
            means: gaussians.means.clone(),
            scales: gaussians.scales.clone(),
            rotations: gaussians.rotations.clone(),
            opacities: gaussians.opacities.clone(),
        }
    }

    /// Whether more than [`MOVED_SHARE`] of the Gaussians differ from the reference by more than `tolerance`.
    fn moved(&self, gaussians: &Gaussians, tolerance: f32) -> bool {
        if self.means.len() != gaussians.len() {
            return true;
        }
        let moved = (0..gaussians.len()).filter(|&i| {
            let size = self.scales[i].max_element();
            let shift = (gaussians.means[i] - self.means[i]).length();
            let growth = (gaussians.scales[i] - self.scales[i]).abs() / self.scales[i];
            let (p, q) = (self.rotations[i].normalize(), gaussians.rotations[i].normalize());
            let turn = 2.0 * (1.0 - p.dot(q).abs()).max(0.0).sqrt() * std::f32::consts::SQRT_2;
            let opacity = (gaussians.opacities[i] - self.opacities[i]).abs();
            // Comparisons that NaN fails count as moved.
            let still = shift <= tolerance * size
                && growth.max_element() <= tolerance
                && turn <= tolerance
                && opacity <= tolerance;
            !still
        });
        moved.count() as f64 > MOVED_SHARE * gaussians.len() as f64
    }
}

impl VisibilityCache {
    /// Visibility of all Gaussians toward `light` at `step`, traced anew if older than the configuration allows; with
    /// `keep` only if the Gaussians have moved as well.
    pub fn get(
        &mut self,
        config: &Visibility,
        keep: bool,
        gaussians: &Gaussians,
        normals: &[Vec3],
        light: &OlatLight,
        step: u64,
    ) -> Result<&[f32], ReconstructError> {
        self.lookups += 1;
        let key = key(light);
        let entry = self.entries.get(&key).filter(|e| e.values.len() == gaussians.len());
        let young = entry.is_some_and(|e| step.saturating_sub(e.step) < config.every_steps);
        let reference = entry.map(|e| e.reference);
        let mut fresh = young;
        if !young {
            if keep && self.compared != Some(step) {
                self.compared = Some(step);
                if self.reference.moved(gaussians, config.moved) {
                    self.reference = Reference::of(gaussians, self.reference.number + 1);
                }
            }
            if keep && reference == Some(self.reference.number) {
                self.kept += 1;
                fresh = true;
            }
        }
        if !fresh {
            self.traced += 1;
            if self.tracer.as_ref().is_none_or(|(at, _)| *at != step) {
                self.built += 1;
                self.tracer = Some((step, Tracer::new(gaussians, normals)?));
            }
            let values = match &self.tracer {
                Some((_, tracer)) => tracer.trace(gaussians, normals, light)?,
                None => Vec::new(),
            };
            self.entries.insert(key, Entry { step, reference: self.reference.number, values });
            if self.entries.len() > MAX_LIGHTS
                && let Some(oldest) = self.entries.iter().min_by_key(|(k, e)| (e.step, **k)).map(|(k, _)| *k)
            {
                self.entries.remove(&oldest);
            }
        }
        Ok(self.entries.get(&key).map_or(&[], |e| &e.values))
    }

    /// Visibility of `gaussians` Gaussians toward `light`, if it was traced less than so many steps ago.
    pub fn young(&mut self, every_steps: u64, gaussians: usize, light: &OlatLight, step: u64) -> Option<&[f32]> {
        let entry = self.entries.get(&key(light)).filter(|e| e.values.len() == gaussians)?;
        if step.saturating_sub(entry.step) >= every_steps {
            return None;
        }
        self.lookups += 1;
        Some(&entry.values)
    }

    /// Follows a change of the set of Gaussians.
    pub fn gather(&mut self, sources: &[(u32, bool)]) {
        for entry in self.entries.values_mut() {
            entry.values = sources.iter().map(|&(s, _)| entry.values.get(s as usize).copied().unwrap_or(1.0)).collect();
        }
        self.reference = Reference { number: self.reference.number + 1, ..Default::default() };
        (self.tracer, self.compared) = (None, None);
    }

    /// Writes everything that later look-ups depend on into a checkpoint.
    pub(crate) fn store(&self, file: &mut TensorFile) {
        for (key, entry) in &self.entries {
            let name = key.iter().map(|k| format!("{k:08x}")).collect::<Vec<_>>().join("-");
            file.insert(format!("visibility.{name}"), &[entry.values.len()], entry.values.clone());
            file.metadata.insert(format!("visibility.{name}.step"), entry.step.to_string());
            file.metadata.insert(format!("visibility.{name}.reference"), entry.reference.to_string());
        }
        let r = &self.reference;
        let n = r.means.len();
        let of3 = |v: &[Vec3]| v.iter().flat_map(|v| v.to_array()).collect::<Vec<f32>>();
        file.metadata.insert("reference.number".into(), r.number.to_string());
        file.metadata.insert("reference.gaussians".into(), n.to_string());
        file.insert("reference.mean", &[n, 3], of3(&r.means));
        file.insert("reference.scale", &[n, 3], of3(&r.scales));
        file.insert("reference.rotation", &[n, 4], r.rotations.iter().flat_map(|q| q.to_array()).collect());
        file.insert("reference.opacity", &[n], r.opacities.clone());
    }

    /// Takes out of a checkpoint of `n` Gaussians what [`VisibilityCache::store`] wrote.
    pub(crate) fn restore(path: &Path, file: &mut TensorFile, n: usize) -> Result<Self, ReconstructError> {
        let mut out = Self::default();
        let names: Vec<String> = file.tensors.keys().filter(|k| k.starts_with("visibility.")).cloned().collect();
        for name in names {
            let bad = || ReconstructError::Checkpoint {
                path: path.to_owned(),
                detail: format!("tensor `{name}`: its name does not identify a light"),
            };
            let fields: Vec<u32> = name["visibility.".len()..]
                .split('-')
                .map(|h| u32::from_str_radix(h, 16).map_err(|_| bad()))
                .collect::<Result<_, _>>()?;
            let key: LightKey = fields.try_into().map_err(|_| bad())?;
            let step = file.metadata_value(path, &format!("{name}.step"))?;
            let reference = file.metadata_value(path, &format!("{name}.reference"))?;
            let values = file.take(path, &name, n)?;
            out.entries.insert(key, Entry { step, reference, values });
        }
        let count: usize = file.metadata_value(path, "reference.gaussians")?;
        let vec3s = |v: Vec<f32>| v.chunks_exact(3).map(Vec3::from_slice).collect();
        let triple = |k: usize| count.saturating_mul(k);
        out.reference = Reference {
            number: file.metadata_value(path, "reference.number")?,
            means: vec3s(file.take(path, "reference.mean", triple(3))?),
            scales: vec3s(file.take(path, "reference.scale", triple(3))?),
            rotations: file
                .take(path, "reference.rotation", triple(4))?
                .chunks_exact(4)
                .map(|q| Quat::from_xyzw(q[0], q[1], q[2], q[3]))
                .collect(),
            opacities: file.take(path, "reference.opacity", count)?,
        };
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Random};

    fn cloud(n: usize) -> (Gaussians, Vec<Vec3>) {
        let mut random = Random::new(5, Purpose::Initial, 0);
        let mut gaussians = Gaussians::default();
        let mut normals = Vec::new();
        for _ in 0..n {
            let normal = random.direction();
            gaussians.push(normal, Vec3::new(0.1, 0.1, 0.02), Quat::from_rotation_arc(Vec3::Z, normal), 0.9);
            normals.push(normal);
        }
        (gaussians, normals)
    }

    fn config() -> Visibility {
        Visibility { traced: true, every_steps: 10, moved: 0.05, samples: 1 }
    }

    const LIGHT: OlatLight = OlatLight::Point { position: Vec3::new(3.0, 0.0, 1.0), intensity: Vec3::ONE };

    /// Nothing has moved: an old light is not traced again, and holds what a new trace gives, bit for bit.
    #[test]
    fn visibility_that_has_not_moved_is_kept() {
        let (gaussians, normals) = cloud(300);
        let mut cache = VisibilityCache::default();
        for step in 0..50 {
            cache.get(&config(), true, &gaussians, &normals, &LIGHT, step).unwrap();
        }
        assert_eq!((cache.lookups, cache.traced, cache.built), (50, 1, 1));
        assert_eq!(cache.kept, 40);
        let anew = Tracer::new(&gaussians, &normals).unwrap().trace(&gaussians, &normals, &LIGHT).unwrap();
        assert_eq!(cache.get(&config(), true, &gaussians, &normals, &LIGHT, 99).unwrap(), anew);
        // Without permission to keep it is traced whenever it is old.
        let mut cache = VisibilityCache::default();
        for step in 0..50 {
            cache.get(&config(), false, &gaussians, &normals, &LIGHT, step).unwrap();
        }
        assert_eq!((cache.traced, cache.kept), (5, 0));
    }

    /// Small movements are tolerated with a small error; large ones lead to a new trace; lights of one step share a tree.
    #[test]
    fn movement_leads_to_a_new_trace() {
        let (mut gaussians, normals) = cloud(300);
        let mut cache = VisibilityCache::default();
        cache.get(&config(), true, &gaussians, &normals, &LIGHT, 0).unwrap();
        let mut random = Random::new(6, Purpose::Initial, 0);
        gaussians.means.iter_mut().for_each(|m| *m += 0.049 * 0.1 * random.direction());
        let kept = cache.get(&config(), true, &gaussians, &normals, &LIGHT, 10).unwrap().to_vec();
        assert_eq!((cache.traced, cache.kept), (1, 1));
        let anew = Tracer::new(&gaussians, &normals).unwrap().trace(&gaussians, &normals, &LIGHT).unwrap();
        let error = kept.iter().zip(&anew).map(|(a, b)| (a - b).abs()).sum::<f32>() / 300.0;
        assert!(error < 0.02, "mean error of kept visibility {error}");
        gaussians.means.iter_mut().take(4).for_each(|m| m.x += 0.02);
        let again = cache.get(&config(), true, &gaussians, &normals, &LIGHT, 20).unwrap().to_vec();
        assert_eq!((cache.traced, cache.kept, cache.built), (2, 1, 2));
        assert!(again != kept);
        let other = OlatLight::Point { position: Vec3::new(0.0, 3.0, 1.0), intensity: Vec3::ONE };
        cache.get(&config(), true, &gaussians, &normals, &other, 20).unwrap();
        assert_eq!((cache.traced, cache.built), (3, 2));
    }

    #[test]
    fn a_checkpoint_holds_all_of_it() {
        let (gaussians, normals) = cloud(20);
        let mut cache = VisibilityCache::default();
        cache.get(&config(), true, &gaussians, &normals, &LIGHT, 3).unwrap();
        let mut file = TensorFile::default();
        cache.store(&mut file);
        let again = VisibilityCache::restore(Path::new("x"), &mut file, 20).unwrap();
        assert!(again.entries == cache.entries && again.reference == cache.reference);
    }
}
