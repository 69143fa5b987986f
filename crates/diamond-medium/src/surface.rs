//! The surface that light goes through: a closed mesh, its surfels, and who lies near which of them.
use crate::MediumError;
use crate::near::Near;
use diamond_light::{Falloff, OlatLight};
use diamond_pathtrace::{Facing, Geometry, Mesh, NO_PRIMITIVE, Patch};
use glam::Vec3;
use rayon::prelude::*;

/// Surfels from which a place takes its value.
const NEIGHBOURS: usize = 6;
/// Surfels that are looked at to find them: on a thin part many of the nearest lie on the other side.
const CANDIDATES: usize = 24;
/// A shadow ray starts this part of a surfel's width above it: bumps of a reconstructed surface that are smaller cast no shadow.
const SHADOW_OFFSET: f32 = 0.5;
/// Standard deviation of the weights of neighbours, widths of a surfel.
const SPREAD: f32 = 0.6;

/// A closed surface with surfels of about equal area.
#[derive(Debug, Clone)]
pub struct Surface {
    mesh: Mesh,
    geometry: Geometry,
    patches: Vec<Patch>,
    spacing: f32,
    near: Near,
    positions: Vec<Vec3>,
}

/// Which surfels each of many places takes its value from.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Attachment {
    surfels: Vec<[u32; NEIGHBOURS]>,
    /// ≥ 0, 1 together.
    weights: Vec<[f32; NEIGHBOURS]>,
}

impl Attachment {
    /// Surfels of a place.
    pub const NEIGHBOURS: usize = NEIGHBOURS;

    /// Surfels and weights, places × [`Attachment::NEIGHBOURS`] each, for a file of numbers.
    pub fn to_columns(&self) -> (Vec<f32>, Vec<f32>) {
        // Surfels are far below 2²⁴, so f32 holds their numbers exactly.
        (self.surfels.iter().flatten().map(|j| *j as f32).collect(), self.weights.iter().flatten().copied().collect())
    }

    /// What [`Attachment::to_columns`] gave; `None` where a surfel is not one of so many, a weight not finite or negative, or the lists do not fit.
    pub fn from_columns(surfels: &[f32], weights: &[f32], count: usize) -> Option<Self> {
        let valid = surfels.iter().all(|j| *j >= 0.0 && (*j as usize) < count)
            && weights.iter().all(|w| *w >= 0.0 && w.is_finite())
            && surfels.len() == weights.len();
        let (of, rest) = surfels.as_chunks::<NEIGHBOURS>();
        valid.then_some(())?;
        rest.is_empty().then(|| Self {
            surfels: of.iter().map(|row| row.map(|j| j as u32)).collect(),
            weights: weights.as_chunks::<NEIGHBOURS>().0.to_vec(),
        })
    }

    /// Number of places.
    pub fn len(&self) -> usize {
        self.surfels.len()
    }

    /// Whether there are no places.
    pub fn is_empty(&self) -> bool {
        self.surfels.is_empty()
    }

    /// The surfels of a place with their weights.
    pub fn of(&self, place: usize) -> impl Iterator<Item = (usize, f32)> + '_ {
        self.surfels[place].iter().zip(&self.weights[place]).map(|(j, w)| (*j as usize, *w))
    }

    /// Linear RGB of a place, from values of surfels × 3.
    #[inline]
    pub fn rgb(&self, place: usize, values: &[f32]) -> Vec3 {
        self.of(place).map(|(j, w)| w * Vec3::from_slice(&values[3 * j..3 * j + 3])).sum()
    }
}

impl Surface {
    /// Of a closed mesh (see [`Mesh::repair`]), cut into about `surfels` pieces. Without vertex normals it gets smooth ones. Errors where the
    /// mesh is none.
    pub fn new(mesh: Mesh, surfels: usize) -> Result<Self, MediumError> {
        mesh.validate()?;
        let mesh = if mesh.normals.is_some() { mesh } else { mesh.with_smooth_normals() };
        let area: f32 = (0..mesh.triangles.len())
            .map(|t| {
                let [a, b, c] = mesh.corners(t);
                0.5 * (b - a).cross(c - a).length()
            })
            .sum();
        let mut patches = merged(&mesh.patches(area / surfels.max(1) as f32)?, surfels);
        let spacing = (area / patches.len().max(1) as f32).sqrt();
        let positions: Vec<Vec3> = patches.iter().map(|p| p.position).collect();
        let near = Near::new(&positions, 2.0 * spacing);
        smooth_normals(&mut patches, &near, spacing);
        let geometry = Geometry::from_mesh(mesh.clone())?;
        Ok(Self { mesh, geometry, patches, spacing, near, positions })
    }

    /// The mesh.
    pub fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// The mesh, for rays.
    pub fn geometry(&self) -> &Geometry {
        &self.geometry
    }

    /// The surfels.
    pub fn patches(&self) -> &[Patch] {
        &self.patches
    }

    /// World positions of the surfels.
    pub fn positions(&self) -> &[Vec3] {
        &self.positions
    }

    /// Width of a surfel: the root of the mean area, scene units.
    pub fn spacing(&self) -> f32 {
        self.spacing
    }

    /// Half the longest side of the bounds, scene units.
    pub fn radius(&self) -> f32 {
        let (low, high) = self.mesh.bounds();
        0.5 * (high - low).max_element()
    }

    /// The surface cut into about `count` other pieces.
    pub fn cut(&self, count: usize) -> Result<Vec<Patch>, MediumError> {
        let area: f32 = self.patches.iter().map(|p| p.area).sum();
        let mut patches = merged(&self.mesh.patches(area / count.max(1) as f32)?, count);
        let positions: Vec<Vec3> = patches.iter().map(|p| p.position).collect();
        let spacing = (area / patches.len().max(1) as f32).sqrt();
        smooth_normals(&mut patches, &Near::new(&positions, 2.0 * spacing), self.spacing);
        Ok(patches)
    }

    /// Whether each light reaches each place, 0 or 1: places × lights. `normals` are outward.
    pub fn visibility(&self, positions: &[Vec3], normals: &[Vec3], lights: &[OlatLight]) -> Vec<f32> {
        let lift = SHADOW_OFFSET * self.spacing;
        let each = positions.par_iter().zip(normals).flat_map_iter(|(p, n)| {
            lights.iter().map(move |light| {
                let arriving = light.incidence(*p, Falloff::None);
                let faces = n.dot(arriving.direction) > 0.0;
                let from = *p + *n * lift;
                let reach = arriving.distance;
                let hidden = || self.geometry.occluded(from, arriving.direction, reach, Facing::Any, NO_PRIMITIVE);
                f32::from(u8::from(faces && !hidden()))
            })
        });
        each.collect()
    }

    /// Finds for each place the surfels around it that face its way; with a zero normal any.
    pub fn attach(&self, positions: &[Vec3], normals: &[Vec3]) -> Attachment {
        let each = positions.par_iter().zip(normals).map(|(p, n)| {
            let mut found = self.near.nearest(&self.positions, *p, CANDIDATES);
            let first = found.first().map_or(0.0, |f| f.1);
            let scale = 0.5 / (SPREAD * self.spacing).powi(2);
            let weight = |&(j, d2): &(usize, f32)| {
                let cosine = self.patches[j].normal.dot(*n);
                let facing = if *n == Vec3::ZERO { 1.0 } else { (0.05 + cosine.max(0.0)).powi(2) };
                facing * libm::expf(-(d2 - first) * scale)
            };
            let mut weighed: Vec<(usize, f32)> = found.drain(..).map(|f| (f.0, weight(&f))).collect();
            weighed.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
            let (mut surfels, mut weights) = ([0u32; NEIGHBOURS], [0.0f32; NEIGHBOURS]);
            for (k, (j, w)) in weighed.into_iter().take(NEIGHBOURS).enumerate() {
                (surfels[k], weights[k]) = (j as u32, w);
            }
            let sum: f32 = weights.iter().sum();
            weights.iter_mut().for_each(|w| *w /= sum.max(f32::MIN_POSITIVE));
            (surfels, weights)
        });
        let (surfels, weights) = each.unzip();
        Attachment { surfels, weights }
    }
}

/// Patches of finely cut meshes put together by cells of a grid and the side that they face, so that about `count` are left.
fn merged(patches: &[Patch], count: usize) -> Vec<Patch> {
    if 4 * patches.len() <= 5 * count || count == 0 {
        return patches.to_vec();
    }
    let area: f32 = patches.iter().map(|p| p.area).sum();
    let cell = (area / count as f32).sqrt();
    let low = patches.iter().map(|p| p.position).reduce(Vec3::min).unwrap_or(Vec3::ZERO);
    let mut keyed: Vec<([i32; 4], usize)> = patches
        .iter()
        .enumerate()
        .map(|(i, p)| {
            let c = ((p.position - low) / cell).floor().as_ivec3();
            let axis = if p.normal.abs().max_element() == p.normal.x.abs() {
                0
            } else if p.normal.abs().max_element() == p.normal.y.abs() {
                1
            } else {
                2
            };
            let side = 2 * axis + i32::from(p.normal[axis as usize] < 0.0);
            ([c.z, c.y, c.x, side], i)
        })
        .collect();
    keyed.sort_unstable();
    let group = |group: &[([i32; 4], usize)]| {
        let (mut position, mut normal, mut area) = (Vec3::ZERO, Vec3::ZERO, 0.0f32);
        for &(_, i) in group {
            let p = &patches[i];
            position += p.position * p.area;
            normal += p.normal * p.area;
            area += p.area;
        }
        Patch { position: position / area, normal: normal.try_normalize().unwrap_or(Vec3::Z), area }
    };
    keyed.chunk_by(|a, b| a.0 == b.0).map(group).filter(|p| p.area > 0.0 && p.position.is_finite()).collect()
}

/// Normals averaged over the surfels around that do not face away.
fn smooth_normals(patches: &mut [Patch], near: &Near, spacing: f32) {
    let scale = 0.5 / (spacing * spacing);
    let normals: Vec<Vec3> = (0..patches.len())
        .into_par_iter()
        .map(|i| {
            let (p, mut sum) = (&patches[i], Vec3::ZERO);
            near.within(p.position, 2.0 * spacing, |j| {
                let q = &patches[j];
                let cosine = q.normal.dot(p.normal).max(0.0);
                let d2 = q.position.distance_squared(p.position);
                sum += q.normal * (q.area * cosine * libm::expf(-d2 * scale));
            });
            sum.try_normalize().unwrap_or(p.normal)
        })
        .collect();
    patches.iter_mut().zip(normals).for_each(|(p, n)| p.normal = n);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ball() -> Surface {
        Surface::new(Mesh::icosphere(Vec3::ZERO, 1.0, 5), 1500).unwrap()
    }

    #[test]
    fn surfels_cover_the_mesh() {
        let surface = ball();
        let n = surface.patches().len();
        assert!((700..4000).contains(&n), "{n}");
        let area: f32 = surface.patches().iter().map(|p| p.area).sum();
        assert!((area - 4.0 * std::f32::consts::PI).abs() < 0.05, "{area}");
        assert!(surface.patches().iter().all(|p| p.normal.dot(p.position.normalize()) > 0.99));
    }

    #[test]
    fn places_take_the_values_around_them() {
        let surface = ball();
        let values: Vec<f32> = surface.positions().iter().flat_map(|p| [p.x, p.y, 1.0]).collect();
        let places: Vec<Vec3> =
            (0..40).map(|i| Vec3::new((i as f32).sin(), (2.1 * i as f32).cos(), 0.7).normalize()).collect();
        let attachment = surface.attach(&places, &places);
        for (i, p) in places.iter().enumerate() {
            let v = attachment.rgb(i, &values);
            assert!((v - Vec3::new(p.x, p.y, 1.0)).abs().max_element() < 0.05, "{v} at {p}");
        }
        let thin = Surface::new(Mesh::cuboid(Vec3::new(-1.0, -1.0, -0.01), Vec3::new(1.0, 1.0, 0.01)), 800).unwrap();
        let upper: Vec<f32> = thin.patches().iter().flat_map(|p| [p.normal.z.max(0.0); 3]).collect();
        let found = thin.attach(&[Vec3::new(0.1, 0.2, 0.01)], &[Vec3::Z]).rgb(0, &upper);
        assert!(found.x > 0.95, "{found}");
    }

    #[test]
    fn the_far_side_is_dark() {
        let surface = ball();
        let light = [OlatLight::Point { position: Vec3::Z * 3.0, intensity: Vec3::ONE }];
        let places = [Vec3::Z, Vec3::NEG_Z, Vec3::new(0.8, 0.0, 0.6)];
        assert_eq!(surface.visibility(&places, &places, &light), [1.0, 0.0, 1.0]);
    }
}
