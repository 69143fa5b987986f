//! Whether a mesh encloses a volume, and the repairs that make it do so.
//!
//! A path tracer needs one thing of a mesh: that every ray enters as often as it leaves. That is so exactly when each edge is run through
//! as often in one direction as in the other. Repairs are made where they are certain, and each is reported; what is not certain is
//! an error. Vertices are joined by position alone, so texture seams and hard edges keep their attributes.
use crate::repair_holes::fill_holes;
use crate::repair_nesting::turn_outward;
use crate::{Mesh, PathtraceError};
use std::collections::BTreeMap;
use std::fmt;

/// What may be repaired.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RepairOptions {
    /// Vertices nearer than this, relative to the bounding box's diagonal, are one.
    pub weld_distance: f32,
    /// Holes whose rim is at most this long, relative to the bounding box's diagonal, are filled; longer ones are an error.
    pub max_hole: f32,
}

impl Default for RepairOptions {
    fn default() -> Self {
        Self { weld_distance: 1e-6, max_hole: 0.5 }
    }
}

/// What was repaired. All zero but `components` for a mesh that was in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RepairReport {
    /// Vertices moved onto another at (nearly) the same place. Seams are such vertices: joining them changes no position.
    pub joined_vertices: usize,
    /// Triangles with two corners at one place, removed.
    pub degenerate_triangles: usize,
    /// Triangles that were there twice, removed.
    pub duplicate_triangles: usize,
    /// Pairs of triangles back to back, removed: an inner wall, or a flap.
    pub opposite_pairs: usize,
    /// Triangles turned to agree with their neighbours.
    pub turned_triangles: usize,
    /// Holes that were filled.
    pub filled_holes: usize,
    /// Triangles that fill them.
    pub added_triangles: usize,
    /// Closed surfaces that were inside out.
    pub turned_components: usize,
    /// Solids wholly inside another, removed: they are part of it.
    pub enclosed_components: usize,
    /// Closed surfaces that remain.
    pub components: usize,
}

impl RepairReport {
    /// Whether the shape was changed; joining vertices at one place does not.
    pub fn changed(&self) -> bool {
        let unchanged = Self { joined_vertices: self.joined_vertices, components: self.components, ..Self::default() };
        *self != unchanged
    }
}

impl fmt::Display for RepairReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let parts = [
            (self.joined_vertices, "vertices joined"),
            (self.degenerate_triangles, "degenerate triangles removed"),
            (self.duplicate_triangles, "duplicate triangles removed"),
            (self.opposite_pairs, "pairs of opposite triangles removed"),
            (self.turned_triangles, "triangles turned"),
            (self.filled_holes, "holes filled"),
            (self.turned_components, "surfaces turned outward"),
            (self.enclosed_components, "enclosed solids removed"),
        ];
        let said: Vec<String> = parts.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!("{n} {what}")).collect();
        let said = if said.is_empty() { "nothing to repair".into() } else { said.join(", ") };
        write!(f, "{said}; {} closed surfaces", self.components)
    }
}

/// Triangles over joined vertices, on their way to a closed surface.
pub(crate) struct Soup {
    pub mesh: Mesh,
    /// The vertex that stands for all at its place.
    pub place: Vec<u32>,
}

impl Soup {
    /// A triangle's corners as places.
    pub fn places(&self, t: usize) -> [u32; 3] {
        self.mesh.triangles[t].map(|v| self.place[v as usize])
    }
}

/// Directed edges of a triangle.
pub(crate) fn edges([a, b, c]: [u32; 3]) -> [(u32, u32); 3] {
    [(a, b), (b, c), (c, a)]
}

impl Mesh {
    /// The mesh as a closed surface that faces outward, and what was done for it. Errors where that takes a guess: large holes, a
    /// surface with one side, parts that cut through each other.
    ///
    /// ```
    /// use diamond_pathtrace::{Mesh, RepairOptions};
    /// use glam::Vec3;
    /// let mut cube = Mesh::cuboid(Vec3::ZERO, Vec3::ONE);
    /// cube.triangles.iter_mut().for_each(|t| t.swap(1, 2)); // inside out
    /// let (cube, report) = cube.repair(&RepairOptions::default())?;
    /// assert!(cube.signed_volume() > 0.0 && report.turned_components == 1);
    /// # Ok::<(), diamond_pathtrace::PathtraceError>(())
    /// ```
    pub fn repair(self, options: &RepairOptions) -> Result<(Mesh, RepairReport), PathtraceError> {
        self.validate()?;
        let mut report = RepairReport::default();
        let mut soup = join(self, options.weld_distance, &mut report);
        remove_doubles(&mut soup, &mut report);
        if soup.mesh.triangles.is_empty() {
            return Err(PathtraceError::Mesh {
                problem: "every triangle is degenerate or lies back to back with another".into(),
                advice: "give a mesh that encloses a volume",
            });
        }
        agree(&mut soup, &mut report)?;
        fill_holes(&mut soup, options.max_hole, &mut report)?;
        turn_outward(&mut soup, &mut report)?;
        let mut mesh = soup.mesh;
        face_normals_outward(&mut mesh);
        Ok((mesh, report))
    }

    /// Whether each edge, by position, is run through as often in one direction as in the other: then every ray enters as often as
    /// it leaves.
    pub fn is_closed(&self) -> bool {
        let soup = join(self.clone(), 0.0, &mut RepairReport::default());
        open_edges(&soup).is_empty()
    }
}

/// Joins vertices nearer than `distance` times the diagonal: each is moved to the first of its kind.
fn join(mut mesh: Mesh, distance: f32, report: &mut RepairReport) -> Soup {
    let (low, high) = mesh.bounds();
    let reach = distance * (high - low).length();
    let cell = reach.max(f32::MIN_POSITIVE);
    let mut grid: BTreeMap<[i64; 3], Vec<u32>> = BTreeMap::new();
    let mut place: Vec<u32> = Vec::with_capacity(mesh.positions.len());
    for v in 0..mesh.positions.len() {
        let p = mesh.positions[v];
        let key = (p - low).to_array().map(|c| (f64::from(c) / f64::from(cell)) as i64);
        let mut found = None;
        'search: for x in -1..=1 {
            for y in -1..=1 {
                for z in -1..=1 {
                    let near = [key[0].saturating_add(x), key[1].saturating_add(y), key[2].saturating_add(z)];
                    for &other in grid.get(&near).into_iter().flatten() {
                        if (mesh.positions[other as usize] - p).length() <= reach {
                            found = Some(other);
                            break 'search;
                        }
                    }
                }
            }
        }
        if let Some(first) = found {
            mesh.positions[v] = mesh.positions[first as usize];
            place.push(first);
            report.joined_vertices += 1;
        } else {
            grid.entry(key).or_default().push(v as u32);
            place.push(v as u32);
        }
    }
    Soup { mesh, place }
}

/// Removes degenerate and repeated triangles, and pairs that lie back to back.
fn remove_doubles(soup: &mut Soup, report: &mut RepairReport) {
    // For each set of corners: triangles of one orientation, and of the other.
    let mut seen: BTreeMap<[u32; 3], [Vec<usize>; 2]> = BTreeMap::new();
    let mut keep = vec![false; soup.mesh.triangles.len()];
    for t in 0..keep.len() {
        let [a, b, c] = soup.places(t);
        if a == b || b == c || c == a {
            report.degenerate_triangles += 1;
            continue;
        }
        let mut sorted = [a, b, c];
        sorted.sort_unstable();
        let even = [[a, b, c], [b, c, a], [c, a, b]].contains(&sorted);
        seen.entry(sorted).or_default()[usize::from(even)].push(t);
    }
    for [odd, even] in seen.into_values() {
        let (a, b) = (odd.first(), even.first());
        report.duplicate_triangles += odd.len().saturating_sub(1) + even.len().saturating_sub(1);
        match (a, b) {
            (Some(_), Some(_)) => report.opposite_pairs += 1,
            (Some(t), None) | (None, Some(t)) => keep[*t] = true,
            (None, None) => {}
        }
    }
    let mut kept = keep.iter();
    soup.mesh.triangles.retain(|_| kept.next().copied().unwrap_or(false));
}

/// Turns triangles so that neighbours agree, over edges that two triangles share.
fn agree(soup: &mut Soup, report: &mut RepairReport) -> Result<(), PathtraceError> {
    let count = soup.mesh.triangles.len();
    let mut users: BTreeMap<(u32, u32), Vec<(usize, bool)>> = BTreeMap::new();
    for t in 0..count {
        for (a, b) in edges(soup.places(t)) {
            users.entry((a.min(b), a.max(b))).or_default().push((t, a < b));
        }
    }
    let mut turned: Vec<Option<bool>> = vec![None; count];
    for seed in 0..count {
        if turned[seed].is_some() {
            continue;
        }
        turned[seed] = Some(false);
        let (mut stack, mut members) = (vec![seed], vec![seed]);
        while let Some(t) = stack.pop() {
            let mine = turned[t] == Some(true);
            for (a, b) in edges(soup.places(t)) {
                let Some([first, second]) = users.get(&(a.min(b), a.max(b))).map(Vec::as_slice) else { continue };
                let other = if first.0 == t { *second } else { *first };
                // Neighbours run through their edge in opposite directions.
                let wanted = mine ^ (other.1 == (a < b));
                match turned[other.0] {
                    None => {
                        turned[other.0] = Some(wanted);
                        stack.push(other.0);
                        members.push(other.0);
                    }
                    Some(found) if found != wanted => {
                        return Err(PathtraceError::Mesh {
                            problem: format!("the surface around triangle {t} has only one side (as a Möbius strip)"),
                            advice: "such a surface encloses no volume; separate or remove that part",
                        });
                    }
                    Some(_) => {}
                }
            }
        }
        // The majority keeps its direction.
        let flips = members.iter().filter(|t| turned[**t] == Some(true)).count();
        let invert = 2 * flips > members.len();
        for t in members {
            if (turned[t] == Some(true)) != invert {
                soup.mesh.triangles[t].swap(1, 2);
                report.turned_triangles += 1;
            }
        }
    }
    Ok(())
}

/// Directed edges that are run through more often than their opposites, with by how much.
pub(crate) fn open_edges(soup: &Soup) -> BTreeMap<(u32, u32), i32> {
    let mut balance: BTreeMap<(u32, u32), i32> = BTreeMap::new();
    for t in 0..soup.mesh.triangles.len() {
        for (a, b) in edges(soup.places(t)) {
            if a != b {
                *balance.entry((a.min(b), a.max(b))).or_default() += if a < b { 1 } else { -1 };
            }
        }
    }
    let directed = |((a, b), n): ((u32, u32), i32)| if n > 0 { ((a, b), n) } else { ((b, a), -n) };
    balance.into_iter().filter(|(_, n)| *n != 0).map(directed).collect()
}

/// Turns vertex normals that point away from their triangles.
fn face_normals_outward(mesh: &mut Mesh) {
    let Some(mut normals) = mesh.normals.take() else { return };
    let mut sums = vec![glam::DVec3::ZERO; normals.len()];
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        let normal = mesh.area_vector(t).normalize_or_zero();
        triangle.iter().for_each(|v| sums[*v as usize] += normal);
    }
    for (normal, sum) in normals.iter_mut().zip(sums) {
        if sum.dot(normal.as_dvec3()) < 0.0 {
            *normal = -*normal;
        }
    }
    mesh.normals = Some(normals);
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    fn cube() -> Mesh {
        Mesh::cuboid(Vec3::ZERO, Vec3::ONE)
    }

    fn repaired(mesh: Mesh) -> (Mesh, RepairReport) {
        let (mesh, report) = mesh.repair(&RepairOptions::default()).unwrap();
        assert!(mesh.is_closed() && mesh.signed_volume() > 0.0);
        (mesh, report)
    }

    fn plus(mut a: Mesh, b: Mesh) -> Mesh {
        let n = a.positions.len() as u32;
        a.positions.extend(b.positions);
        a.triangles.extend(b.triangles.iter().map(|t| t.map(|v| v + n)));
        a.normals = None;
        a
    }

    fn inside_out(mut mesh: Mesh) -> Mesh {
        mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
        mesh
    }

    #[test]
    fn a_mesh_in_order_is_left_alone() {
        let (mesh, report) = repaired(cube());
        assert_eq!(mesh, cube());
        assert!(!report.changed() && report.components == 1, "{report}");
        assert_eq!(report.to_string(), "nothing to repair; 1 closed surfaces");
    }

    #[test]
    fn corners_of_their_own_are_joined_and_keep_their_attributes() {
        let whole = cube();
        let positions: Vec<Vec3> = whole.triangles.iter().flatten().map(|v| whole.positions[*v as usize]).collect();
        let nudged = positions.iter().enumerate().map(|(i, p)| *p + 1e-7 * (i % 3) as f32).collect();
        let triangles = (0..12).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        let soup = Mesh { positions: nudged, triangles, normals: None, uvs: None }.with_smooth_normals();
        assert!(!soup.is_closed());
        let (mesh, report) = repaired(soup.clone());
        assert_eq!((report.joined_vertices, report.changed()), (28, false));
        assert_eq!(mesh.normals, soup.normals);
    }

    #[test]
    fn inside_out_and_mixed_meshes_are_turned() {
        assert_eq!(repaired(inside_out(cube())).1.turned_components, 1);
        let mut mixed = cube();
        mixed.triangles[3].swap(0, 1);
        mixed.triangles[8].swap(0, 1);
        assert_eq!(repaired(mixed).1.turned_triangles, 2);
    }

    #[test]
    fn degenerate_repeated_and_opposite_triangles_go() {
        let mut mesh = cube();
        let first = mesh.triangles[0];
        mesh.triangles.extend([first, [1, 1, 2], [4, 7, 4]]);
        let (mesh, report) = repaired(mesh);
        assert_eq!((report.duplicate_triangles, report.degenerate_triangles, mesh.triangles.len()), (1, 2, 12));
        // Two cubes on one wall become one block.
        let two = plus(cube(), Mesh::cuboid(Vec3::X, Vec3::new(2.0, 1.0, 1.0)));
        let (block, report) = repaired(two);
        assert_eq!((report.opposite_pairs, report.components), (2, 1), "{report}");
        assert!((block.signed_volume() - 2.0).abs() < 1e-6);
    }

    #[test]
    fn small_holes_are_filled_and_large_ones_refused() {
        let mut ball = Mesh::icosphere(Vec3::ZERO, 1.0, 3);
        let full = ball.signed_volume();
        let corner = ball.triangles[100][0];
        ball.triangles.retain(|t| !t.contains(&corner));
        assert!(!ball.is_closed());
        let (ball, report) = repaired(ball);
        assert_eq!(report.filled_holes, 1);
        assert!((ball.signed_volume() / full - 1.0).abs() < 0.01);
        assert_eq!(ball.normals.as_ref().map(Vec::len), Some(ball.positions.len()));
        let mut open = cube();
        open.triangles.truncate(10);
        let error = open.repair(&RepairOptions::default()).unwrap_err().to_string();
        assert!(error.contains("hole"), "{error}");
    }

    #[test]
    fn nested_surfaces_are_cavities_or_parts() {
        let inner = || Mesh::cuboid(Vec3::splat(0.3), Vec3::splat(0.7));
        let hollow = plus(cube(), inside_out(inner()));
        let (mesh, report) = repaired(hollow.clone());
        assert!(!report.changed() && report.components == 2);
        assert!((mesh.signed_volume() - (1.0 - 0.064)).abs() < 1e-6);
        // The same, all of it inside out.
        let (mesh, report) = repaired(inside_out(hollow));
        assert_eq!(report.turned_components, 2);
        assert!((mesh.signed_volume() - (1.0 - 0.064)).abs() < 1e-6);
        let (mesh, report) = repaired(plus(cube(), inner()));
        assert_eq!((report.enclosed_components, report.components), (1, 1));
        assert!((mesh.signed_volume() - 1.0).abs() < 1e-6);
        let crossing = plus(cube(), Mesh::cuboid(Vec3::splat(0.5), Vec3::splat(1.5)));
        assert!(crossing.repair(&RepairOptions::default()).unwrap_err().to_string().contains("cut through"));
    }

    #[test]
    fn one_sided_and_flat_things_are_refused() {
        let n = 8;
        let positions = (0..n)
            .flat_map(|i| {
                let phi = i as f32 / n as f32 * std::f32::consts::TAU;
                let across = Vec3::new(phi.cos() * (0.5 * phi).cos(), phi.sin() * (0.5 * phi).cos(), (0.5 * phi).sin());
                let middle = Vec3::new(phi.cos(), phi.sin(), 0.0) * 2.0;
                [middle - 0.4 * across, middle + 0.4 * across]
            })
            .collect();
        let triangles = (0..n as u32)
            .flat_map(|i| {
                let (a, b) = (2 * i, 2 * i + 1);
                let (c, d) = if i + 1 < n as u32 { (a + 2, b + 2) } else { (1, 0) };
                [[a, b, c], [b, d, c]]
            })
            .collect();
        let strip = Mesh { positions, triangles, normals: None, uvs: None };
        assert!(strip.repair(&RepairOptions::default()).unwrap_err().to_string().contains("one side"));
        let mut flat = cube();
        flat.triangles = vec![[0, 1, 2], [0, 2, 1]];
        assert!(flat.repair(&RepairOptions::default()).is_err());
    }
}
