//! For each light a picture of the object as the light sees it, with every surface along each line of sight: how much of a
//! point's way to the light lies inside the object is then a look-up instead of a ray.
//!
//! A texel keeps triangles, not depths. Their planes are intersected with the point's own ray, so the surface is not cut into steps,
//! and a flat or gently curved one is exact. Where entries and exits do not balance (near outlines and edges, where the texel's line meets
//! other triangles than the point's), the ray is traced after all. What is left is an error near shadow boundaries of the size of
//! a texel's width times what the triangles there differ by.
use super::lamps::{Lamps, Shine};
use crate::{Frame, Geometry, NO_PRIMITIVE};
use glam::{Vec2, Vec3};
use rayon::prelude::*;

/// Maps of all lights; none for shapes whose rays cost no more than a look-up.
#[derive(Debug)]
pub(crate) struct LightMaps<'a> {
    geometry: &'a Geometry,
    /// What each light's map is a map of; `None` where its rays are traced.
    views: Vec<Option<LightView>>,
    side: usize,
    /// For each light, for each texel, the start of its triangles, and the end of the last's, from the light's `first` on.
    starts: Vec<u32>,
    first: Vec<usize>,
    triangles: Vec<u32>,
    /// Normal and offset of each triangle's plane, relative to `centre`.
    planes: Vec<[f32; 4]>,
    centre: Vec3,
    diameter: f32,
    /// Ways that cross a surface at a smaller cosine than this are traced: there the triangles of a texel are most often others than the point's.
    /// 0 traces none for that.
    pub min_cosine: f32,
}

/// Ways from one point to all lights. Memory that is kept between points.
#[derive(Debug, Default)]
pub(crate) struct Ways {
    /// How each light shines on the point.
    pub shines: Vec<Shine>,
    /// How much of the way to each light lies inside the object, scene units.
    pub lengths: Vec<f32>,
    texels: Vec<usize>,
    spans: Vec<[u32; 2]>,
    nearest: Vec<[f32; 4]>,
}

/// What one light sees: starts of texels' triangles with the end of the last's, and the triangles.
type LightMap = (LightView, Vec<u32>, Vec<u32>);

/// No texel.
const OUTSIDE: usize = usize::MAX;

/// Points → the square [−1, 1]² of a map.
#[derive(Debug, Clone, Copy)]
enum LightView {
    /// Parallel rays.
    Parallel { frame: Frame, scale: f32 },
    /// Rays from a point; `eye` relative to the centre.
    Perspective { frame: Frame, eye: Vec3, scale: f32 },
}

impl LightView {
    /// From a position relative to the centre.
    #[inline]
    fn project(self, p: Vec3) -> Vec2 {
        match self {
            LightView::Parallel { frame, scale } => Vec2::new(frame.x.dot(p), frame.y.dot(p)) * scale,
            LightView::Perspective { frame, eye, scale } => {
                let q = p - eye;
                Vec2::new(frame.x.dot(q), frame.y.dot(q)) * (scale / frame.z.dot(q))
            }
        }
    }

    /// A ray from the light through a point of the map: origin relative to the centre, and direction.
    fn ray(self, at: Vec2, radius: f32) -> (Vec3, Vec3) {
        match self {
            LightView::Parallel { frame, scale } => {
                let p = (frame.x * at.x + frame.y * at.y) / scale;
                (p - frame.z * (2.0 * radius), frame.z)
            }
            LightView::Perspective { frame, eye, scale } => {
                (eye, (frame.z + (frame.x * at.x + frame.y * at.y) / scale).normalize())
            }
        }
    }
}

impl<'a> LightMaps<'a> {
    /// Maps of `side`² texels; with `side` 0 there are none and every ray is traced.
    pub fn new(geometry: &'a Geometry, lamps: &Lamps, side: u32) -> Self {
        let (low, high) = geometry.bounds();
        let (centre, radius) = (0.5 * (low + high), 0.5 * (high - low).length());
        let mut planes = Vec::new();
        let mut maps: Vec<Option<LightMap>> = (0..lamps.len()).map(|_| None).collect();
        if let Geometry::Mesh(mesh) = geometry
            && side > 0
        {
            planes = (0..mesh.mesh().triangles.len())
                .map(|t| {
                    let normal = mesh.normal(t as u32);
                    normal.extend(normal.dot(mesh.mesh().corners(t)[0] - centre)).to_array()
                })
                .collect();
            // A margin, so that points on the object never fall outside.
            let radius = 1.001 * radius;
            maps = (0..lamps.len())
                .into_par_iter()
                .map(|l| {
                    let view = match lamps.position(l) {
                        None => {
                            let frame = Frame::new(-lamps.shine(l, centre).direction);
                            LightView::Parallel { frame, scale: 1.0 / radius }
                        }
                        Some(position) => {
                            let eye = position - centre;
                            let distance = eye.length();
                            // So near or inside, the map would be mostly of what lies at its edge.
                            if distance < 1.2 * radius {
                                return None;
                            }
                            let tan = radius / (distance * distance - radius * radius).sqrt();
                            LightView::Perspective { frame: Frame::new(-eye / distance), eye, scale: 1.0 / tan }
                        }
                    };
                    let side = side as usize;
                    let mut starts = Vec::with_capacity(side * side + 1);
                    let mut triangles = Vec::new();
                    for i in 0..side * side {
                        starts.push(triangles.len() as u32);
                        let cell = Vec2::new((i % side) as f32 + 0.5, (i / side) as f32 + 0.5);
                        let at = cell * (2.0 / side as f32) - 1.0;
                        if at.length_squared() > 1.02 {
                            continue;
                        }
                        let (origin, direction) = view.ray(at, radius);
                        mesh.each_crossing(centre + origin, direction, |triangle| triangles.push(triangle));
                    }
                    starts.push(triangles.len() as u32);
                    Some((view, starts, triangles))
                })
                .collect();
        }
        let side = side as usize;
        let (mut views, mut first) = (Vec::new(), Vec::new());
        let (mut starts, mut triangles) = (Vec::new(), Vec::new());
        for map in maps {
            first.push(triangles.len());
            views.push(map.as_ref().map(|map| map.0));
            match map {
                Some((_, from, list)) => {
                    starts.extend(from);
                    triangles.extend(list);
                }
                // Never read: it keeps the places of the others.
                None if !planes.is_empty() => starts.resize(starts.len() + side * side + 1, 0),
                None => {}
            }
        }
        Self {
            geometry,
            views,
            side,
            starts,
            first,
            triangles,
            planes,
            centre,
            diameter: 2.0 * radius,
            min_cosine: 0.0,
        }
    }

    /// How all lights shine on `point`, which lies inside the object, and how much of each way lies inside.
    ///
    /// A map is larger than what a processor keeps at hand, so each look-up waits for memory three times. In loops of their
    /// own the look-ups of all lights wait at the same time.
    pub fn look_up(&self, lamps: &Lamps, point: Vec3, ways: &mut Ways) {
        let lights = lamps.len();
        let p = point - self.centre;
        ways.shines.clear();
        ways.shines.extend((0..lights).map(|l| lamps.shine(l, point)));
        ways.texels.clear();
        ways.texels.extend(self.views.iter().map(|view| {
            let Some(view) = view else { return OUTSIDE };
            let at = (view.project(p) * 0.5 + 0.5) * self.side as f32;
            let (x, y) = (at.x as usize, at.y as usize);
            if x < self.side && y < self.side { y * self.side + x } else { OUTSIDE }
        }));
        ways.spans.clear();
        let stride = self.side * self.side + 1;
        ways.spans.extend(ways.texels.iter().enumerate().map(|(l, texel)| match *texel {
            OUTSIDE => [0, 0],
            texel => [self.starts[l * stride + texel], self.starts[l * stride + texel + 1]],
        }));
        ways.nearest.clear();
        ways.nearest.extend(ways.spans.iter().zip(&self.first).map(|([from, to], first)| {
            if from == to { [0.0; 4] } else { self.planes[self.triangles[first + *from as usize] as usize] }
        }));
        ways.lengths.clear();
        for l in 0..lights {
            let ([from, to], shine) = (ways.spans[l].map(|i| i as usize), &ways.shines[l]);
            let (mut length, mut exits, mut grazing) = (0.0, 0, false);
            let mut cross = |[nx, ny, nz, offset]: [f32; 4]| {
                let normal = Vec3::new(nx, ny, nz);
                let slope = normal.dot(shine.direction);
                let distance = (offset - normal.dot(p)) / slope;
                if distance > 0.0 && distance < shine.distance.min(self.diameter) {
                    let sign = if slope > 0.0 { 1 } else { -1 };
                    grazing |= slope.abs() < self.min_cosine;
                    exits += sign;
                    length += sign as f32 * distance;
                }
            };
            if from < to {
                cross(ways.nearest[l]);
                let list = &self.triangles[self.first[l]..][from + 1..to];
                list.iter().for_each(|triangle| cross(self.planes[*triangle as usize]));
            }
            ways.lengths.push(match exits == 1 && length > 0.0 && !grazing {
                true => length,
                false => self.geometry.inside_length(point, shine.direction, shine.distance, true, NO_PRIMITIVE),
            });
        }
    }

    /// Bytes that the maps hold.
    pub fn bytes(&self) -> usize {
        4 * (self.starts.len() + self.triangles.len())
    }

    /// Mean and largest |error| of look-ups against rays, over random inside points, as a fraction of the object's diameter.
    #[cfg(test)]
    fn error(&self, lamps: &Lamps, count: usize) -> (f32, f32) {
        let mut rng = crate::Rng::new(3, 3);
        let (low, high) = self.geometry.bounds();
        let (mut sum, mut worst, mut n) = (0.0, 0.0f32, 0);
        let mut ways = Ways::default();
        while n < count {
            let u = Vec3::new(rng.uniform(), rng.uniform(), rng.uniform());
            let point = low + (high - low) * u;
            if !self.geometry.contains(point) {
                continue;
            }
            self.look_up(lamps, point, &mut ways);
            for (shine, length) in ways.shines.iter().zip(&ways.lengths) {
                let exact = self.geometry.inside_length(point, shine.direction, shine.distance, true, NO_PRIMITIVE);
                let error = (length - exact).abs() / self.diameter;
                sum += error;
                worst = worst.max(error);
            }
            n += 1;
        }
        (sum / (n * lamps.len()) as f32, worst)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Light, Material, Medium, Mesh, Scene};

    #[test]
    fn look_ups_are_rays_up_to_texels() {
        let mut mesh = Mesh::icosphere(Vec3::ZERO, 1.0, 4);
        for p in &mut mesh.positions {
            *p *= 0.8 + 0.2 * (4.0 * p.x).sin() * (3.0 * p.y).cos();
        }
        let geometry = Geometry::from_mesh(mesh).unwrap();
        let lights = vec![
            Light::directional(Vec3::new(0.6, 0.0, 0.8), Vec3::ONE),
            Light::point(Vec3::new(1.0, 2.0, -3.0), Vec3::ONE),
        ];
        let material = Material::index_matched(Medium::gray(1.0, 0.5, 0.0));
        let scene = Scene { geometry: geometry.clone(), material, lights };
        let lamps = Lamps::new(&scene.lights).unwrap();
        let (traced, _) = LightMaps::new(&geometry, &lamps, 0).error(&lamps, 200);
        let (coarse, _) = LightMaps::new(&geometry, &lamps, 32).error(&lamps, 2000);
        let (fine, worst) = LightMaps::new(&geometry, &lamps, 256).error(&lamps, 2000);
        assert_eq!(traced, 0.0);
        assert!(coarse < 2e-3 && fine < 2e-4 && worst < 0.2, "{coarse} {fine} {worst}");
    }
}
