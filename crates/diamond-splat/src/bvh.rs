//! A bounding volume hierarchy over axis-aligned boxes: which of many boxes does a ray meet?
//!
//! A binary tree is built top down with the surface area heuristic over binned centres, and then flattened so that
//! each node has up to eight children and each leaf is a packet of up to eight boxes: a vector register compares all of
//! them at once. After the boxes have moved a little the tree can be refitted: same topology, new bounds.
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

/// A binary node, while building.
#[derive(Debug, Clone, Copy)]
struct Node {
    bounds: Aabb,
    /// Leaf: first place in the order of items. Inner: index of the right child; the left one follows its parent.
    first: u32,
    /// Number of boxes in a leaf; 0 for inner nodes.
    count: u32,
}

/// Children of a node, and boxes of a leaf: as many as a vector of `f32` has lanes.
pub(crate) const WIDTH: usize = 8;
/// Marks a link to a packet; the other links lead to nodes.
const PACKET: u32 = 1 << 31;
/// A packet's place that holds no box.
pub(crate) const NO_BOX: u32 = u32::MAX;

/// Up to eight children: their boxes, one coordinate after the other, and where they lead.
#[derive(Debug, Clone)]
#[repr(align(64))]
struct WideNode {
    min: [[f32; WIDTH]; 3],
    max: [[f32; WIDTH]; 3],
    /// Index of a node, behind this one, or with [`PACKET`] set of a packet. Without meaning where the box is empty.
    links: [u32; WIDTH],
    /// Number of children.
    count: u32,
}

impl WideNode {
    fn set_bounds(&mut self, lane: usize, bounds: Aabb) {
        for axis in 0..3 {
            self.min[axis][lane] = bounds.min[axis];
            self.max[axis][lane] = bounds.max[axis];
        }
    }

    fn bounds(&self) -> Aabb {
        let fold = |v: &[f32; WIDTH], f: fn(f32, f32) -> f32, from| v.iter().copied().fold(from, f);
        let min = std::array::from_fn(|axis| fold(&self.min[axis], f32::min, f32::INFINITY));
        let max = std::array::from_fn(|axis| fold(&self.max[axis], f32::max, f32::NEG_INFINITY));
        Aabb { min: Vec3A::from_array(min), max: Vec3A::from_array(max) }
    }
}

/// The hierarchy: wide nodes over packets of boxes.
#[derive(Debug, Clone)]
pub(crate) struct Bvh {
    nodes: Vec<WideNode>,
    /// Indices of the boxes in each leaf, [`NO_BOX`] where there are fewer than [`WIDTH`].
    packets: Vec<[u32; WIDTH]>,
}

/// Bins of the surface area heuristic per axis.
const BINS: usize = 12;
/// Cost of visiting a node relative to testing the content of a packet.
const NODE_COST: f32 = 0.5;
/// From this depth on ranges are halved by count, which bounds the depth whatever the boxes are (a geometric
/// progression of centres would otherwise lose one box per level).
const HALVE_FROM: usize = 40;
/// Room for the traversal: `HALVE_FROM` levels and as many halvings as a `u32` allows, each leaving all children but one.
const STACK: usize = (HALVE_FROM + 32) * (WIDTH - 1) + 1;
/// Ranges beyond this are built by two threads.
const PARALLEL_FROM: usize = 4096;

struct Item {
    bounds: Aabb,
    centre: Vec3A,
    index: u32,
}

/// `f32::max` without its care for NaN: one instruction.
#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// `f32::min` without its care for NaN: one instruction.
#[inline(always)]
fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// What happens at a leaf. A trait and not a closure, since closures cannot be inlined by force, and one that is not
/// is compiled without the vector instructions of its caller.
pub(crate) trait Visitor {
    /// Looks at a packet; false ends the traversal.
    fn packet(&mut self, packet: usize) -> bool;
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
        let mut bvh = Self { nodes: Vec::new(), packets: Vec::new() };
        if items.is_empty() {
            return bvh;
        }
        // A range of n boxes has 2n − 1 places; most leaves hold several boxes and leave places unused.
        let mut binary = vec![Node { bounds: Aabb::EMPTY, first: 0, count: 0 }; 2 * items.len() - 1];
        build_range(&mut items, 0, &mut binary, 0, 0);
        bvh.widen(&binary, 0, &items);
        bvh
    }

    /// Appends the wide node that stands for binary node `root`, and all below it; gives its index.
    fn widen(&mut self, binary: &[Node], root: usize, items: &[Item]) -> u32 {
        // The child with the largest box is replaced by its own two children while there is room.
        let mut children = [root; WIDTH];
        let mut count = 1;
        while count < WIDTH {
            let inner = (0..count).filter(|&i| binary[children[i]].count == 0);
            let area = |i: usize| binary[children[i]].bounds.half_area();
            let Some(largest) = inner.reduce(|a, b| if area(b) > area(a) { b } else { a }) else { break };
            let opened = children[largest];
            children[largest] = opened + 1;
            children[count] = binary[opened].first as usize;
            count += 1;
        }
        let (inf, neg) = ([f32::INFINITY; WIDTH], [f32::NEG_INFINITY; WIDTH]);
        let mut node = WideNode { min: [inf; 3], max: [neg; 3], links: [0; WIDTH], count: count as u32 };
        let at = self.nodes.len();
        self.nodes.push(node.clone());
        for (lane, &child) in children[..count].iter().enumerate() {
            let Node { bounds, first, count } = binary[child];
            node.set_bounds(lane, bounds);
            node.links[lane] = if count > 0 {
                let mut packet = [NO_BOX; WIDTH];
                let leaf = &items[first as usize..(first + count) as usize];
                packet.iter_mut().zip(leaf).for_each(|(place, item)| *place = item.index);
                self.packets.push(packet);
                (self.packets.len() - 1) as u32 | PACKET
            } else {
                self.widen(binary, child, items)
            };
        }
        self.nodes[at] = node;
        at as u32
    }

    /// Indices of the boxes in each leaf, [`NO_BOX`] where there are fewer.
    pub fn packets(&self) -> &[[u32; WIDTH]] {
        &self.packets
    }

    /// New bounds for boxes that have moved; as many as at building.
    pub fn refit(&mut self, boxes: &[Aabb]) {
        for at in (0..self.nodes.len()).rev() {
            for lane in 0..self.nodes[at].count as usize {
                let link = self.nodes[at].links[lane];
                let bounds = if link & PACKET != 0 {
                    let packet = self.packets[(link & !PACKET) as usize];
                    let present = packet.iter().filter(|&&i| i != NO_BOX);
                    present.fold(Aabb::EMPTY, |all, &i| all.union(boxes[i as usize]))
                } else {
                    self.nodes[link as usize].bounds()
                };
                self.nodes[at].set_bounds(lane, bounds);
            }
        }
    }

    /// Shows `visitor` the index of each packet in whose box the ray may be between `t_min` and `t_max`, in an
    /// order that depends on the tree and the ray alone, until it returns false.
    #[inline(always)]
    pub fn visit(&self, origin: Vec3, direction: Vec3, t_min: f32, t_max: f32, visitor: &mut impl Visitor) {
        if self.nodes.is_empty() {
            return;
        }
        // A component of zero would make 0·∞ below; this one's inverse is finite and the ray as good as parallel.
        const PARALLEL: f32 = 1e-20;
        let inverse = direction.to_array().map(|v| 1.0 / if v.abs() < PARALLEL { PARALLEL.copysign(v) } else { v });
        let origin = origin.to_array();
        let mut stack = [0u32; STACK];
        let mut top = 1;
        while top > 0 {
            top -= 1;
            let link = stack[top];
            if link & PACKET != 0 {
                if !visitor.packet((link & !PACKET) as usize) {
                    return;
                }
                continue;
            }
            let node = &self.nodes[link as usize];
            // By the sign of the direction, not by comparing: so an empty box (∞, −∞) is never met.
            let planes = |axis: usize| match inverse[axis] < 0.0 {
                false => (&node.min[axis], &node.max[axis]),
                true => (&node.max[axis], &node.min[axis]),
            };
            let ((enter_x, leave_x), (enter_y, leave_y), (enter_z, leave_z)) = (planes(0), planes(1), planes(2));
            let mut met = 0u32;
            for lane in 0..WIDTH {
                let (ax, bx) = ((enter_x[lane] - origin[0]) * inverse[0], (leave_x[lane] - origin[0]) * inverse[0]);
                let (ay, by) = ((enter_y[lane] - origin[1]) * inverse[1], (leave_y[lane] - origin[1]) * inverse[1]);
                let (az, bz) = ((enter_z[lane] - origin[2]) * inverse[2], (leave_z[lane] - origin[2]) * inverse[2]);
                let near = larger(larger(ax, ay), larger(az, t_min));
                let far = smaller(smaller(bx, by), smaller(bz, t_max));
                met |= ((near <= far) as u32) << lane;
            }
            while met != 0 {
                let lane = met.trailing_zeros() as usize;
                met &= met - 1;
                stack[top] = node.links[lane];
                top += 1;
            }
        }
    }
}

/// Builds the node `nodes[0]` (number `node_base` of all) over `items` (which begin at place `item_base`).
fn build_range(items: &mut [Item], item_base: u32, nodes: &mut [Node], node_base: u32, depth: usize) {
    let n = items.len();
    let bounds = items.iter().fold(Aabb::EMPTY, |all, item| all.union(item.bounds));
    nodes[0].bounds = bounds;
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
        return if n <= WIDTH { None } else { halve(items) };
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
    // The cost of a range is that of its packets, as if they were packed half full.
    let packets = |count: usize| (count as f32 / (0.5 * WIDTH as f32)).max(1.0);
    let mut best = (f32::INFINITY, 0, 0);
    for axis in 0..3 {
        let mut right_cost = [0.0; BINS];
        let (mut all, mut count) = (Aabb::EMPTY, 0);
        for i in (1..BINS).rev() {
            all = all.union(bins[axis][i].0);
            count += bins[axis][i].1;
            right_cost[i] = if count == 0 { f32::INFINITY } else { all.half_area() * packets(count) };
        }
        let (mut all, mut count) = (Aabb::EMPTY, 0);
        for i in 0..BINS - 1 {
            all = all.union(bins[axis][i].0);
            count += bins[axis][i].1;
            let cost = all.half_area() * packets(count) + right_cost[i + 1];
            if count > 0 && cost < best.0 {
                best = (cost, axis, i);
            }
        }
    }
    let (cost, axis, last_left) = best;
    if !cost.is_finite() {
        return if n <= WIDTH { None } else { halve(items) };
    }
    let area = bounds.half_area();
    if n <= WIDTH && cost + NODE_COST * area >= area {
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
        struct Collect<'a>(&'a Bvh, Vec<u32>);
        impl Visitor for Collect<'_> {
            fn packet(&mut self, packet: usize) -> bool {
                self.1.extend(self.0.packets()[packet].iter().filter(|&&i| i != NO_BOX));
                true
            }
        }
        let mut collect = Collect(bvh, Vec::new());
        bvh.visit(origin, direction, 0.0, 5.0, &mut collect);
        let mut found = collect.1;
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
            let mut order: Vec<u32> = bvh.packets().iter().flatten().copied().filter(|&i| i != NO_BOX).collect();
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
