//! A bounding volume hierarchy over axis-aligned boxes: which of many boxes does a ray meet?
//!
//! Built top down with the surface area heuristic over binned centres. Nodes lie in depth-first order, the left child
//! right behind its parent. After the boxes have moved a little the tree can be refitted: same topology, new bounds.
//! Building uses threads for large ranges; the tree does not depend on their number.
use glam::{Vec3, Vec3A};

/// An axis-aligned box; empty where `min > max`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Aabb {
    pub min: Vec3A,
    pub max: Vec3A,
}

impl Aabb {
    /// Contains nothing and is neutral in unions.
    pub const EMPTY: Aabb = Aabb { min: Vec3A::INFINITY, max: Vec3A::NEG_INFINITY };

    pub fn union(self, other: Aabb) -> Aabb {
        Aabb { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// Half of the surface area; 0 for the empty box. Finite for finite boxes of sane size, saturated beyond.
    fn half_area(self) -> f32 {
        let d = (self.max - self.min).max(Vec3A::ZERO);
        (d.x * d.y + d.y * d.z + d.z * d.x).min(f32::MAX)
    }
}

/// A box and what hangs from it, 32 bytes.
#[derive(Debug, Clone, Copy)]
struct Node {
    min: Vec3,
    /// Leaf: first place in `order`. Inner: index of the right child; the left one follows its parent.
    first: u32,
    max: Vec3,
    /// Number of boxes in a leaf; 0 for inner nodes.
    count: u32,
}

impl Node {
    fn bounds(&self) -> Aabb {
        Aabb { min: self.min.into(), max: self.max.into() }
    }

    fn set_bounds(&mut self, bounds: Aabb) {
        (self.min, self.max) = (bounds.min.into(), bounds.max.into());
    }
}

/// The hierarchy.
#[derive(Debug, Clone)]
pub(crate) struct Bvh {
    nodes: Vec<Node>,
    /// Indices of the boxes, leaf by leaf.
    order: Vec<u32>,
}

/// Most boxes in a leaf, where the heuristic has no better idea.
const MAX_LEAF: usize = 4;
/// Bins of the surface area heuristic per axis.
const BINS: usize = 12;
/// Cost of visiting a node relative to testing a box's content.
const NODE_COST: f32 = 1.0;
/// From this depth on ranges are halved by count, which bounds the depth whatever the boxes are (a geometric
/// progression of centres would otherwise lose one box per level).
const HALVE_FROM: usize = 40;
/// Room for the traversal: `HALVE_FROM` levels and as many halvings as a `u32` allows.
const STACK: usize = HALVE_FROM + 32;
/// Ranges beyond this are built by two threads.
const PARALLEL_FROM: usize = 4096;

struct Item {
    bounds: Aabb,
    centre: Vec3A,
    index: u32,
}

impl Bvh {
    /// Builds over `boxes`. `centre` stands in for the centre of an empty box, so that refitting with a box
    /// there later gives a reasonable tree; it must be finite.
    pub fn build(boxes: &[Aabb], centre: impl Fn(usize) -> Vec3) -> Self {
        let mut items: Vec<Item> = boxes
            .iter()
            .enumerate()
            .map(|(i, &bounds)| Item { bounds, centre: centre(i).into(), index: i as u32 })
            .collect();
        if items.is_empty() {
            return Self { nodes: Vec::new(), order: Vec::new() };
        }
        let empty = Node { min: Vec3::INFINITY, first: u32::MAX, max: Vec3::NEG_INFINITY, count: 0 };
        let mut sparse = vec![empty; 2 * items.len() - 1];
        build_range(&mut items, 0, &mut sparse, 0, 0);
        // A range of n boxes had 2n − 1 places; most leaves hold several boxes and leave places unused.
        let mut place = vec![0u32; sparse.len()];
        let mut used = 0;
        for (node, place) in sparse.iter().zip(&mut place) {
            *place = used;
            used += (node.first != u32::MAX) as u32;
        }
        let nodes = sparse
            .iter()
            .filter(|node| node.first != u32::MAX)
            .map(|&node| Node { first: if node.count == 0 { place[node.first as usize] } else { node.first }, ..node })
            .collect();
        Self { nodes, order: items.iter().map(|item| item.index).collect() }
    }

    /// Indices of the boxes in the order in which [`Bvh::visit`] numbers places.
    pub fn order(&self) -> &[u32] {
        &self.order
    }

    /// New bounds for boxes that have moved; as many as at building.
    pub fn refit(&mut self, boxes: &[Aabb]) {
        for at in (0..self.nodes.len()).rev() {
            let node = self.nodes[at];
            let bounds = if node.count > 0 {
                let range = node.first as usize..(node.first + node.count) as usize;
                self.order[range].iter().fold(Aabb::EMPTY, |all, &i| all.union(boxes[i as usize]))
            } else {
                self.nodes[at + 1].bounds().union(self.nodes[node.first as usize].bounds())
            };
            self.nodes[at].set_bounds(bounds);
        }
    }

    /// Calls `visit` with ranges of places in [`Bvh::order`] whose boxes the ray may meet between `t_min` and
    /// `t_max`, in an order that depends on the tree and the ray alone, until it returns false.
    #[inline]
    pub fn visit(
        &self,
        origin: Vec3,
        direction: Vec3,
        t_min: f32,
        t_max: f32,
        mut visit: impl FnMut(std::ops::Range<usize>) -> bool,
    ) {
        if self.nodes.is_empty() {
            return;
        }
        let origin = Vec3A::from(origin);
        // A component of zero would make 0·∞ below; this one's inverse is finite and the ray as good as parallel.
        const PARALLEL: f32 = 1e-20;
        let safe = |v: f32| if v.abs() < PARALLEL { PARALLEL.copysign(v) } else { v };
        let inverse = Vec3A::new(1.0 / safe(direction.x), 1.0 / safe(direction.y), 1.0 / safe(direction.z));
        let met = |node: &Node| {
            let a = (Vec3A::from(node.min) - origin) * inverse;
            let b = (Vec3A::from(node.max) - origin) * inverse;
            let (near, far) = (a.min(b), a.max(b));
            near.max_element().max(t_min) <= far.min_element().min(t_max)
        };
        let mut stack = [0u32; STACK];
        let mut top = 0;
        let mut at = 0u32;
        if !met(&self.nodes[0]) {
            return;
        }
        loop {
            let node = &self.nodes[at as usize];
            if node.count > 0 {
                if !visit(node.first as usize..(node.first + node.count) as usize) {
                    return;
                }
            } else {
                let (left, right) = (at + 1, node.first);
                let (meets_left, meets_right) = (met(&self.nodes[left as usize]), met(&self.nodes[right as usize]));
                if meets_left || meets_right {
                    if meets_left && meets_right {
                        stack[top] = right;
                        top += 1;
                    }
                    at = if meets_left { left } else { right };
                    continue;
                }
            }
            if top == 0 {
                return;
            }
            top -= 1;
            at = stack[top];
        }
    }
}

/// Builds the node `nodes[0]` (number `node_base` of all) over `items` (which begin at place `item_base`).
fn build_range(items: &mut [Item], item_base: u32, nodes: &mut [Node], node_base: u32, depth: usize) {
    let n = items.len();
    let bounds = items.iter().fold(Aabb::EMPTY, |all, item| all.union(item.bounds));
    nodes[0].set_bounds(bounds);
    let middle = match choose_split(items, bounds, depth) {
        Some(middle) => middle,
        None => {
            (nodes[0].first, nodes[0].count) = (item_base, n as u32);
            return;
        }
    };
    let right = 2 * middle as u32;
    (nodes[0].first, nodes[0].count) = (node_base + right, 0);
    let (left_items, right_items) = items.split_at_mut(middle);
    let (left_nodes, right_nodes) = nodes[1..].split_at_mut(2 * middle - 1);
    let mut build_left = || build_range(left_items, item_base, left_nodes, node_base + 1, depth + 1);
    let mut build_right =
        || build_range(right_items, item_base + middle as u32, right_nodes, node_base + right, depth + 1);
    if n > PARALLEL_FROM {
        rayon::join(build_left, build_right);
    } else {
        build_left();
        build_right();
    }
}

/// Sorts `items` into two sides and gives the size of the left one, or `None` for a leaf.
fn choose_split(items: &mut [Item], bounds: Aabb, depth: usize) -> Option<usize> {
    let n = items.len();
    if n <= 1 {
        return None;
    }
    let (low, high) = items.iter().fold((Vec3A::INFINITY, Vec3A::NEG_INFINITY), |(low, high), item| {
        (low.min(item.centre), high.max(item.centre))
    });
    let extent = high - low;
    let axis = extent.max_position();
    let halve = |items: &mut [Item]| {
        let middle = n / 2;
        items.select_nth_unstable_by(middle, |a, b| {
            a.centre[axis].total_cmp(&b.centre[axis]).then(a.index.cmp(&b.index))
        });
        Some(middle)
    };
    // Equal centres (or ones whose distance overflows) cannot be binned.
    if depth >= HALVE_FROM || !(extent[axis] > 0.0 && extent[axis].is_finite()) {
        return if n <= MAX_LEAF { None } else { halve(items) };
    }
    let scale = Vec3A::splat(BINS as f32) / extent.max(Vec3A::splat(f32::MIN_POSITIVE));
    let bin = |centre: Vec3A, axis: usize| ((((centre - low) * scale)[axis]) as usize).min(BINS - 1);
    let mut bins = [[(Aabb::EMPTY, 0usize); BINS]; 3];
    for item in items.iter() {
        for axis in 0..3 {
            let (all, count) = &mut bins[axis][bin(item.centre, axis)];
            *all = all.union(item.bounds);
            *count += 1;
        }
    }
    let mut best = (f32::INFINITY, 0, 0);
    for axis in 0..3 {
        let mut right_cost = [0.0; BINS];
        let (mut all, mut count) = (Aabb::EMPTY, 0);
        for i in (1..BINS).rev() {
            all = all.union(bins[axis][i].0);
            count += bins[axis][i].1;
            right_cost[i] = if count == 0 { f32::INFINITY } else { all.half_area() * count as f32 };
        }
        let (mut all, mut count) = (Aabb::EMPTY, 0);
        for i in 0..BINS - 1 {
            all = all.union(bins[axis][i].0);
            count += bins[axis][i].1;
            let cost = all.half_area() * count as f32 + right_cost[i + 1];
            if count > 0 && cost < best.0 {
                best = (cost, axis, i);
            }
        }
    }
    let (cost, axis, last_left) = best;
    if !cost.is_finite() {
        return if n <= MAX_LEAF { None } else { halve(items) };
    }
    let area = bounds.half_area();
    if n <= MAX_LEAF && cost + NODE_COST * area >= n as f32 * area {
        return None;
    }
    let mut left = 0;
    for i in 0..n {
        if bin(items[i].centre, axis) <= last_left {
            items.swap(i, left);
            left += 1;
        }
    }
    Some(left)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn boxes() -> impl Strategy<Value = Vec<Aabb>> {
        let number =
            prop_oneof![-1.0f32..1.0, (-3i32..3).prop_map(|v| v as f32), (0.0f32..30.0).prop_map(|e| (-e).exp2())];
        let one = ([number.clone(), number.clone(), number.clone()], [number.clone(), number.clone(), number], 0..10u8);
        let one = one.prop_map(|(a, b, kind)| match kind {
            0 => Aabb::EMPTY,
            1 => Aabb { min: Vec3A::from(a), max: Vec3A::from(a) },
            _ => Aabb { min: Vec3A::from(a), max: Vec3A::from(a) + 0.1 * Vec3A::from(b).abs() },
        });
        prop::collection::vec(one, 0..150)
    }

    fn centre(boxes: &[Aabb]) -> impl Fn(usize) -> Vec3 {
        |i| if boxes[i] == Aabb::EMPTY { Vec3::ZERO } else { (0.5 * (boxes[i].min + boxes[i].max)).into() }
    }

    fn visited(bvh: &Bvh, origin: Vec3, direction: Vec3) -> Vec<u32> {
        let mut found = Vec::new();
        bvh.visit(origin, direction, 0.0, 5.0, |places| {
            found.extend(&bvh.order()[places]);
            true
        });
        found.sort_unstable();
        found
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(96))]

        #[test]
        fn every_box_that_a_ray_meets_is_visited_once(
            boxes in boxes(),
            moved in boxes(),
            origin in [-2.0f32..2.0, -2.0f32..2.0, -2.0f32..2.0],
            target in [-1.0f32..1.0, -1.0f32..1.0, -1.0f32..1.0],
            axis in 0usize..6,
        ) {
            let mut bvh = Bvh::build(&boxes, centre(&boxes));
            let mut order = bvh.order().to_vec();
            order.sort_unstable();
            prop_assert_eq!(order, (0..boxes.len() as u32).collect::<Vec<_>>());
            let origin = Vec3::from(origin);
            let direction = if axis < 3 { Vec3::AXES[axis] } else { (Vec3::from(target) - origin).normalize_or(Vec3::X) };
            let check = |bvh: &Bvh, boxes: &[Aabb]| {
                let found = visited(bvh, origin, direction);
                assert!(found.windows(2).all(|w| w[0] < w[1]), "a box twice");
                for (i, b) in boxes.iter().enumerate() {
                    // Slabs in f64.
                    let (mut near, mut far) = (0.0f64, 5.0f64);
                    for k in 0..3 {
                        let (o, d) = (origin[k] as f64, direction[k] as f64);
                        let (lo, hi) = (b.min[k] as f64, b.max[k] as f64);
                        if d == 0.0 {
                            if o < lo || o > hi { far = -1.0; }
                        } else {
                            near = near.max(((lo - o) / d).min((hi - o) / d));
                            far = far.min(((lo - o) / d).max((hi - o) / d));
                        }
                    }
                    // A margin for rounding, which a caller with narrow needs adds to its boxes.
                    let meets = *b != Aabb::EMPTY && near + 1e-5 < far;
                    assert!(!meets || found.contains(&(i as u32)), "box {i} missed");
                }
            };
            check(&bvh, &boxes);
            // Refitted to other boxes: bad, but never wrong.
            let mut moved = moved;
            moved.resize(boxes.len(), Aabb::EMPTY);
            bvh.refit(&moved);
            check(&bvh, &moved);
        }
    }

    #[test]
    fn a_geometric_progression_does_not_overflow_the_stack() {
        let boxes: Vec<Aabb> = (0..20_000)
            .map(|i| {
                let at = Vec3A::splat((-(i as f32) * 0.005).exp2());
                Aabb { min: at, max: at * 1.001 }
            })
            .collect();
        let bvh = Bvh::build(&boxes, centre(&boxes));
        let found = visited(&bvh, Vec3::ZERO, Vec3::ONE.normalize());
        assert_eq!(found.len(), 20_000);
    }

    #[test]
    fn an_empty_tree_is_visited_in_peace() {
        assert!(visited(&Bvh::build(&[], |_| Vec3::ZERO), Vec3::ZERO, Vec3::X).is_empty());
    }
}
