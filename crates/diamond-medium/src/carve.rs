//! A closed surface from what a reconstruction knows of the shape: points with normals, and silhouettes.
//!
//! Near points the field is the distance to the planes through them, averaged with Gaussian weights (implicit moving least squares,
//! Shen, O'Brien and Shewchuk 2004); what a silhouette does not cover is outside. Where there are no points a place is on the side on which the
//! nearest place is that points decide. Without points the surface is the visual hull.
//! Of several pieces, those that are small beside the largest are left out.
use crate::near::Near;
use crate::{MediumError, Surface};
use diamond_camera::Camera;
use diamond_image::{Image, Mask};
use diamond_pathtrace::{RepairOptions, polygonise};
use glam::{UVec3, Vec2, Vec3};
use rayon::prelude::*;

/// A point of the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrientedPoint {
    /// World.
    pub position: Vec3,
    /// Outward, unit length.
    pub normal: Vec3,
    /// Counts as so many points, > 0: little where it is uncertain, so that it matters only where there are no others.
    pub weight: f32,
}

/// The outline of the object in one view.
#[derive(Debug, Clone)]
pub struct Silhouette {
    camera: Camera,
    /// Signed distance to the outline, pixels, positive outside.
    outline: Image,
}

impl Silhouette {
    /// Of a mask of the camera's size.
    pub fn new(camera: Camera, mask: &Mask) -> Self {
        Self { camera, outline: mask.outline_distance() }
    }

    /// How far outside of the view's cone a point lies, scene units at its depth; `None` beyond the picture.
    fn distance(&self, p: Vec3) -> Option<f32> {
        let (pixel, z) = self.camera.project(p)?;
        let size = Vec2::new(self.outline.width() as f32, self.outline.height() as f32);
        if !(pixel.cmpge(Vec2::ZERO).all() && pixel.cmple(size).all()) {
            return None;
        }
        let mut d = [0.0];
        self.outline.sample(pixel.x, pixel.y, &mut d);
        Some(d[0] * z / self.camera.intrinsics.fx)
    }
}

/// How a surface is made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CarveOptions {
    /// Cells along the longest side of the object, 8 … 512.
    pub resolution: u32,
    /// Standard deviation of the weight of a point, cells: larger is smoother.
    pub smoothing: f32,
    /// The same standard deviation is at least this, scene units: points that are far apart need a wide one.
    pub least_width: f32,
    /// Surfels that the surface is cut into, about.
    pub surfels: usize,
    /// Move the surface of the points in or out until it covers as many pixels as the silhouettes.
    pub match_silhouettes: bool,
}

impl Default for CarveOptions {
    fn default() -> Self {
        Self { resolution: 80, smoothing: 1.0, least_width: 0.0, surfels: 6000, match_silhouettes: true }
    }
}

/// Beyond so many standard deviations a point has no weight.
const REACH: f32 = 2.5;
/// A place where the weights add up to less than this part of a certain point's is unknown.
const MIN_WEIGHT: f32 = 1e-5;
/// Distances are known up to so many cells.
const FAR: f32 = 4.0;
/// Pieces smaller than this part of the largest are left out.
const MIN_PIECE: f32 = 0.05;

/// The field on a grid.
struct Grid {
    low: Vec3,
    cell: f32,
    size: UVec3,
    values: Vec<f32>,
}

impl Grid {
    fn at(&self, v: UVec3) -> Vec3 {
        self.low + v.as_vec3() * self.cell
    }

    fn index(&self, v: UVec3) -> usize {
        ((v.z * self.size.y + v.y) * self.size.x + v.x) as usize
    }

    fn node(&self, i: usize) -> UVec3 {
        let (x, y) = (self.size.x as usize, self.size.y as usize);
        UVec3::new((i % x) as u32, (i / x % y) as u32, (i / (x * y)) as u32)
    }

    /// Calls `see` with the neighbours of a node along the axes.
    fn around(&self, i: usize, mut see: impl FnMut(usize)) {
        let v = self.node(i);
        for axis in 0..3 {
            let stride = [1, self.size.x as usize, (self.size.x * self.size.y) as usize][axis];
            if v[axis] > 0 {
                see(i - stride);
            }
            if v[axis] + 1 < self.size[axis] {
                see(i + stride);
            }
        }
    }

    /// Trilinear; positive outside of the grid.
    fn value(&self, p: Vec3) -> f32 {
        let x = (p - self.low) / self.cell;
        let last = (self.size - 1).as_vec3();
        if !(x.cmpge(Vec3::ZERO).all() && x.cmplt(last).all()) {
            return FAR * self.cell;
        }
        let v = x.floor();
        let (t, v) = (x - v, v.as_uvec3());
        let mut sum = 0.0;
        for k in 0..8u32 {
            let corner = UVec3::new(k & 1, k >> 1 & 1, k >> 2);
            let w = Vec3::select(corner.cmpeq(UVec3::ONE), t, 1.0 - t);
            sum += w.x * w.y * w.z * self.values[self.index(v + corner)];
        }
        sum
    }
}

/// How far outside of any silhouette a point is; −∞ where no view sees it.
fn hull_distance(silhouettes: &[Silhouette], p: Vec3) -> f32 {
    silhouettes.iter().filter_map(|s| s.distance(p)).fold(f32::NEG_INFINITY, f32::max)
}

/// Signed distance to the planes through the points around, averaged; NaN where there are none. Normals that disagree cancel.
fn plane_distance(points: &[OrientedPoint], near: &Near, width: f32, p: Vec3) -> f32 {
    let (mut weights, mut sum) = (0.0f32, 0.0f32);
    near.within(p, REACH * width, |j| {
        let apart = p - points[j].position;
        let r2 = apart.length_squared() / (width * width);
        if r2 <= REACH * REACH {
            let w = points[j].weight * libm::expf(-0.5 * r2);
            weights += w;
            sum += w * points[j].normal.dot(apart);
        }
    });
    if weights > MIN_WEIGHT { sum / weights } else { f32::NAN }
}

/// Pixels of a view that a shift is found from, about.
const SHIFT_PIXELS: usize = 4000;
/// Most that a surface is moved to match its outlines, cells.
const MOST_SHIFT: f32 = 3.0;

/// How far outward the surface must move so that it covers as many pixels as the silhouettes do: the median over the views. Depth that is
/// blended from translucent Gaussians lies too deep, everywhere by about as much.
fn shift_to_match(grid: &Grid, silhouettes: &[Silhouette]) -> f32 {
    let mut shifts: Vec<f32> = silhouettes
        .par_iter()
        .filter_map(|s| {
            let (w, h) = (s.outline.width(), s.outline.height());
            let stride = ((w * h) as f32 / SHIFT_PIXELS as f32).sqrt().ceil().max(1.0) as usize;
            let pixels: Vec<(usize, usize)> =
                (0..h).step_by(stride).flat_map(|y| (0..w).step_by(stride).map(move |x| (x, y))).collect();
            let mut near: Vec<(f32, bool)> = pixels
                .iter()
                .map(|(x, y)| (least_along(grid, &s.camera, *x, *y), s.outline.pixel(*x, *y)[0] < 0.0))
                // What is deep inside and not covered is where no points are, and the silhouettes cut it off.
                .filter(|(least, covered)| least.abs() < MOST_SHIFT * grid.cell || (*covered && *least > 0.0))
                .collect();
            near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
            // With this shift as many rays wrongly meet the object as wrongly miss it.
            let mut missed = near.iter().filter(|n| n.1).count();
            let mut met = 0;
            for (least, covered) in near {
                if covered {
                    missed -= 1;
                } else {
                    met += 1;
                }
                if met >= missed {
                    return Some(least);
                }
            }
            None
        })
        .collect();
    shifts.sort_unstable_by(f32::total_cmp);
    let middle = shifts.get(shifts.len() / 2).copied().unwrap_or(0.0);
    middle.clamp(-MOST_SHIFT * grid.cell, MOST_SHIFT * grid.cell)
}

/// The least value of the field along a pixel's ray.
fn least_along(grid: &Grid, camera: &Camera, x: usize, y: usize) -> f32 {
    let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
    let high = grid.low + (grid.size - 1).as_vec3() * grid.cell;
    let (a, b) = ((grid.low - ray.origin) / ray.direction, (high - ray.origin) / ray.direction);
    let (near, far) = (a.min(b).max_element().max(0.0), a.max(b).min_element());
    let steps = ((far - near) / (0.7 * grid.cell)).ceil();
    let mut least = FAR * grid.cell;
    if steps > 0.0 && steps < 1e4 {
        for k in 0..steps as usize {
            least = least.min(grid.value(ray.at(near + (k as f32 + 0.5) * 0.7 * grid.cell)));
        }
    }
    least
}

/// The surface of what lies behind `points` and within `silhouettes`, in the box from `low` to `high`; either list may be empty.
/// Deterministic. Errors where nothing is enclosed.
pub fn carve(
    points: &[OrientedPoint],
    silhouettes: &[Silhouette],
    (low, high): (Vec3, Vec3),
    options: &CarveOptions,
) -> Result<Surface, MediumError> {
    let side = (high - low).max_element();
    if !(low.is_finite() && high.is_finite() && side > 0.0 && (8..=512).contains(&options.resolution)) {
        return Err(MediumError::Value {
            what: "box and resolution of a surface",
            expected: "finite corners, low below high, 8 to 512 cells",
            found: format!("{low} to {high}, {} cells", options.resolution),
        });
    }
    if points.is_empty() && silhouettes.is_empty() {
        return Err(MediumError::Unusable {
            detail: "a surface needs points or silhouettes; give some of either".into(),
        });
    }
    let cell = side / options.resolution as f32;
    // Two nodes all around are outside.
    let size = ((high - low) / cell).ceil().as_uvec3() + 5;
    let mut grid = Grid { low: low - 2.0 * cell, cell, size, values: Vec::new() };
    let width = options.smoothing.max(0.1) * cell;
    let width = width.max(options.least_width);
    let positions: Vec<Vec3> = points.iter().map(|p| p.position).collect();
    let near = Near::new(&positions, REACH * width);
    let total = (size.x * size.y * size.z) as usize;
    let hull: Vec<f32> = (0..total)
        .into_par_iter()
        .with_min_len(1024)
        .map(|i| {
            let v = grid.node(i);
            let rim = v.cmplt(UVec3::splat(2)).any() || v.cmpge(size - 2).any();
            let distance = if rim { f32::INFINITY } else { hull_distance(silhouettes, grid.at(v)) };
            distance.clamp(-FAR * cell, FAR * cell)
        })
        .collect();
    if points.is_empty() {
        grid.values = hull;
    } else {
        grid.values = (0..total)
            .into_par_iter()
            .with_min_len(1024)
            .map(|i| {
                if hull[i] >= FAR * cell {
                    FAR * cell
                } else {
                    plane_distance(points, &near, width, grid.at(grid.node(i)))
                }
            })
            .collect();
        let by_points: Vec<bool> = grid.values.iter().zip(&hull).map(|(v, h)| !v.is_nan() && *h < FAR * cell).collect();
        spread_signs(&mut grid, &by_points);
        let shift = if options.match_silhouettes { shift_to_match(&grid, silhouettes) } else { 0.0 };
        grid.values.iter_mut().zip(&hull).for_each(|(v, h)| *v = (*v - shift).max(*h));
    }
    fill_pockets(&mut grid);
    keep_large_pieces(&mut grid);
    if !grid.values.iter().any(|v| *v < 0.0) {
        return Err(MediumError::Unusable {
            detail: format!(
                "no surface is enclosed by {} points and {} silhouettes; look at the masks and at the point cloud",
                points.len(),
                silhouettes.len()
            ),
        });
    }
    let mesh = polygonise(|p| grid.value(p), low, high, options.resolution)?;
    let (mesh, _) = mesh.repair(&RepairOptions::default())?;
    Surface::new(mesh.with_smooth_normals(), options.surfels)
}

/// Unknown places take the side of the nearest place that points decide, counted in steps along the axes.
fn spread_signs(grid: &mut Grid, by_points: &[bool]) {
    let mut queue: std::collections::VecDeque<usize> = (0..by_points.len()).filter(|&i| by_points[i]).collect();
    while let Some(i) = queue.pop_front() {
        let value = if grid.values[i] < 0.0 { -FAR * grid.cell } else { FAR * grid.cell };
        let mut reached = [usize::MAX; 6];
        let mut count = 0;
        grid.around(i, |j| {
            if grid.values[j].is_nan() {
                reached[count] = j;
                count += 1;
            }
        });
        for &j in &reached[..count] {
            grid.values[j] = value;
            queue.push_back(j);
        }
    }
    let rest = FAR * grid.cell;
    grid.values.iter_mut().filter(|v| v.is_nan()).for_each(|v| *v = rest);
}

/// What is outside but not connected with the border of the box is inside: opinions of points in the depth of the object are noise.
fn fill_pockets(grid: &mut Grid) {
    let mut outside = vec![false; grid.values.len()];
    let mut stack = vec![0usize];
    outside[0] = true;
    while let Some(i) = stack.pop() {
        grid.around(i, |j| {
            if !outside[j] && grid.values[j] >= 0.0 {
                outside[j] = true;
                stack.push(j);
            }
        });
    }
    let inside = -grid.cell;
    for (value, outside) in grid.values.iter_mut().zip(outside) {
        if *value >= 0.0 && !outside {
            *value = inside;
        }
    }
}

fn keep_large_pieces(grid: &mut Grid) {
    let mut piece = vec![u32::MAX; grid.values.len()];
    let mut sizes: Vec<usize> = Vec::new();
    for start in 0..piece.len() {
        if piece[start] != u32::MAX || grid.values[start] >= 0.0 {
            continue;
        }
        let name = sizes.len() as u32;
        let (mut stack, mut count) = (vec![start], 0);
        piece[start] = name;
        while let Some(i) = stack.pop() {
            count += 1;
            grid.around(i, |j| {
                if piece[j] == u32::MAX && grid.values[j] < 0.0 {
                    piece[j] = name;
                    stack.push(j);
                }
            });
        }
        sizes.push(count);
    }
    let least = sizes.iter().copied().max().unwrap_or(0) as f32 * MIN_PIECE;
    let (cell, pieces) = (grid.cell, piece);
    for (value, piece) in grid.values.iter_mut().zip(pieces) {
        if piece != u32::MAX && (sizes[piece as usize] as f32) < least {
            *value = 0.5 * cell;
        }
    }
}

/// The box of what several silhouettes have in common within a ball, from a coarse grid; `None` where they have nothing in common.
pub fn hull_bounds(silhouettes: &[Silhouette], centre: Vec3, radius: f32) -> Option<(Vec3, Vec3)> {
    const CELLS: i32 = 48;
    let cell = 2.0 * radius / CELLS as f32;
    let inside = (0..CELLS.pow(3)).into_par_iter().filter_map(|i| {
        let v = Vec3::new((i % CELLS) as f32, (i / CELLS % CELLS) as f32, (i / (CELLS * CELLS)) as f32);
        let p = centre - radius + (v + 0.5) * cell;
        let within = p.distance(centre) < radius && hull_distance(silhouettes, p) < cell;
        within.then_some((p, p))
    });
    let (low, high) = inside.reduce_with(|a, b| (a.0.min(b.0), a.1.max(b.1)))?;
    Some((low - 1.5 * cell, high + 1.5 * cell))
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_camera::{Intrinsics, Pose};
    use diamond_pathtrace::Facing;

    fn sphere(count: usize, part: impl Fn(Vec3) -> bool) -> Vec<OrientedPoint> {
        let golden = 2.399_963_2f32;
        let each = (0..count).map(|i| {
            let z = 1.0 - 2.0 * (i as f32 + 0.5) / count as f32;
            let (s, c) = libm::sincosf(golden * i as f32);
            let r = (1.0 - z * z).sqrt();
            Vec3::new(r * c, r * s, z)
        });
        each.filter(|n| part(*n)).map(|n| OrientedPoint { position: n * 0.8, normal: n, weight: 1.0 }).collect()
    }

    fn view(from: Vec3) -> Silhouette {
        let camera =
            Camera { intrinsics: Intrinsics::from_fov_x(0.7, 64, 64), pose: Pose::look_at(from, Vec3::ZERO, Vec3::Z) };
        let mut coverage = vec![0.0; 64 * 64];
        for (i, c) in coverage.iter_mut().enumerate() {
            let ray = camera.ray(Vec2::new((i % 64) as f32 + 0.5, (i / 64) as f32 + 0.5));
            let nearest = ray.origin - ray.direction * ray.origin.dot(ray.direction);
            *c = f32::from(u8::from(nearest.length() < 0.8));
        }
        Silhouette::new(camera, &Mask::from_vec(64, 64, coverage).unwrap())
    }

    fn radii(surface: &Surface) -> (f32, f32) {
        let each = surface.patches().iter().map(|p| p.position.length());
        each.fold((f32::INFINITY, 0.0), |(a, b), r| (a.min(r), b.max(r)))
    }

    #[test]
    fn points_all_around_give_their_surface() {
        let options = CarveOptions { resolution: 32, ..Default::default() };
        let surface = carve(&sphere(4000, |_| true), &[], (Vec3::NEG_ONE, Vec3::ONE), &options).unwrap();
        let (least, most) = radii(&surface);
        assert!(least > 0.77 && most < 0.82, "{least} {most}");
        assert!(surface.patches().iter().all(|p| p.normal.dot(p.position.normalize()) > 0.9));
    }

    #[test]
    fn silhouettes_close_what_points_leave_open() {
        let options = CarveOptions { resolution: 40, ..Default::default() };
        let points = sphere(4000, |n| n.x > 0.0);
        let box_ = (Vec3::NEG_ONE, Vec3::ONE);
        let eyes =
            [Vec3::new(0.0, 4.0, 0.3), Vec3::new(0.0, 0.4, 4.0), Vec3::new(0.3, 2.8, 2.8), Vec3::new(0.2, -2.8, 2.8)];
        let views: Vec<Silhouette> = eyes.iter().map(|e| view(*e)).collect();
        let surface = carve(&points, &views, box_, &options).unwrap();
        let (least, most) = radii(&surface);
        assert!(least > 0.6 && most < 0.95, "{least} {most}");
        // Seen from the side that points know it is exact.
        let hit = surface.geometry().closest_hit(Vec3::X * 3.0, Vec3::NEG_X, 10.0, Facing::Entering, u32::MAX).unwrap();
        assert!((hit.position.x - 0.8).abs() < 0.02, "{}", hit.position);
        let hull = carve(&[], &views, box_, &options).unwrap();
        assert!(radii(&hull).1 > most - 0.05 && radii(&hull).0 > 0.75);
        assert!(hull_bounds(&views, Vec3::ZERO, 1.2).unwrap().0.cmple(Vec3::splat(-0.8)).all());
    }

    #[test]
    fn specks_are_left_out_and_nothing_is_an_error() {
        let options = CarveOptions { resolution: 32, ..Default::default() };
        let mut points = sphere(4000, |_| true);
        let speck: Vec<OrientedPoint> = sphere(200, |_| true)
            .into_iter()
            .map(|p| OrientedPoint { position: Vec3::splat(0.85) + 0.1 * p.position, ..p })
            .collect();
        points.extend(speck);
        let surface = carve(&points, &[], (Vec3::NEG_ONE, Vec3::ONE), &options).unwrap();
        assert!(radii(&surface).1 < 0.85);
        assert!(carve(&[], &[], (Vec3::NEG_ONE, Vec3::ONE), &options).is_err());
        assert!(carve(&points, &[], (Vec3::ONE, Vec3::NEG_ONE), &options).is_err());
    }
}
