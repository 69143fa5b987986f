//! A bounding volume hierarchy whose nodes have eight boxes and whose leaves have eight triangles, tested together.
//!
//! `obvhs` builds a binary hierarchy; here it is folded into eight-wide nodes over the largest boxes, and every subtree of at most eight
//! triangles becomes one block. A node's test and a block's test cost about the same, some dozens of vector instructions. Boxes are
//! tested with distances widened by more than their rounding, so nothing that the triangle test would meet is missed.
use crate::triangle::{BlockHits, EIGHT, ShearedRay, TriangleBlock};
use diamond_simd::{Eight, Level, Octet, WithEight};
use glam::{Vec3, Vec3A};
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::reinsertion::ReinsertionOptimizer;
use obvhs::ploc::PlocBuilder;
use std::ops::ControlFlow;

/// Distances to the far sides of boxes are stretched by this: three roundings each on both sides (Ize 2013).
const STRETCH: f32 = 1.0 + 6.0 * f32::EPSILON;

/// Components of directions are at least this in size: 0 would make 0·∞ of a ray in a box's plane.
const MIN_COMPONENT: f32 = 1e-30;

/// Children that wait: with more, which a mesh of reasonable triangles never has, a list is allocated.
const STACK: usize = 64;

/// Marks a child that is a block.
const BLOCK: u32 = 1 << 31;

/// Eight boxes.
#[derive(Debug, Clone)]
#[repr(align(32))]
struct Node {
    /// Smallest and largest x, y, z; unused boxes contain nothing.
    bounds: [[[f32; EIGHT]; 2]; 3],
    children: [u32; EIGHT],
}

/// The hierarchy.
#[derive(Debug, Clone)]
pub(crate) struct Hierarchy {
    level: Level,
    nodes: Vec<Node>,
    blocks: Vec<TriangleBlock>,
}

/// A ray as the hierarchy wants it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct HierarchyRay {
    sheared: ShearedRay,
    origin: Vec3,
    inverse: Vec3,
    stretched: Vec3,
    /// Which side of boxes is the far one, for each axis.
    far: [usize; 3],
}

impl HierarchyRay {
    #[inline]
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        let guarded = |d: f32| 1.0 / if d.abs() < MIN_COMPONENT { MIN_COMPONENT.copysign(d) } else { d };
        let inverse = Vec3::new(guarded(direction.x), guarded(direction.y), guarded(direction.z));
        let far = inverse.to_array().map(|i| usize::from(i > 0.0));
        Self { sheared: ShearedRay::new(origin, direction), origin, inverse, stretched: inverse * STRETCH, far }
    }

    /// Which boxes the ray meets before `max`, and where it enters each.
    #[inline(always)]
    fn enters<E: Eight>(&self, e: E, node: &Node, max: f32) -> (u32, [f32; EIGHT]) {
        let (mut near, mut far) = (Octet::splat(e, 0.0), Octet::splat(e, max));
        for axis in 0..3 {
            let origin = Octet::splat(e, self.origin[axis]);
            let side = self.far[axis] & 1;
            let p = (Octet::load(e, &node.bounds[axis][1 - side]) - origin) * self.inverse[axis];
            let q = (Octet::load(e, &node.bounds[axis][side]) - origin) * self.stretched[axis];
            near = p.larger(near);
            far = q.smaller(far);
        }
        (near.at_most(far), near.store())
    }
}

/// Children that are still to be visited, each with the distance at which the ray enters it.
struct Waiting {
    count: usize,
    first: [(u32, f32); STACK],
    rest: Vec<(u32, f32)>,
}

impl Waiting {
    #[inline(always)]
    fn push(&mut self, child: u32, at: f32) {
        if self.count < STACK {
            self.first[self.count] = (child, at);
        } else {
            self.rest.push((child, at));
        }
        self.count += 1;
    }

    #[inline(always)]
    fn pop(&mut self) -> Option<(u32, f32)> {
        if self.count == 0 {
            return None;
        }
        self.count -= 1;
        if self.count < STACK { Some(self.first[self.count]) } else { self.rest.pop() }
    }
}

impl Hierarchy {
    /// From boxes and corners of triangles; boxes may be wider than the triangles.
    pub fn new(boxes: &[Aabb], corners: impl Fn(u32) -> [Vec3; 3]) -> Self {
        let parameters = BvhBuildParams::medium_build();
        let mut binary = PlocBuilder::with_capacity(boxes.len()).build(
            parameters.ploc_search_distance,
            boxes,
            (0..boxes.len() as u32).collect(),
            parameters.sort_precision,
            parameters.search_depth_threshold,
        );
        ReinsertionOptimizer::default().run(&mut binary, parameters.reinsertion_batch_ratio, None);
        let mut hierarchy = Self { level: Level::current(), nodes: Vec::new(), blocks: Vec::new() };
        hierarchy.fold(&binary, corners);
        hierarchy
    }

    fn fold(&mut self, binary: &Bvh2, corners: impl Fn(u32) -> [Vec3; 3]) {
        let plan = Plan::new(binary);
        // Binary nodes with the wide node and place in which they go.
        let mut open = vec![(0usize, None)];
        while let Some((root, parent)) = open.pop() {
            let index = self.nodes.len() as u32;
            if let Some((node, place)) = parent {
                let node: &mut Node = &mut self.nodes[node as usize];
                node.children[place] = index;
            }
            let nothing = [[f32::INFINITY; EIGHT], [f32::NEG_INFINITY; EIGHT]];
            let mut node = Node { bounds: [nothing; 3], children: [0; EIGHT] };
            for (place, child) in plan.children(binary, root).into_iter().enumerate() {
                let bounds = binary.nodes[child].aabb();
                for axis in 0..3 {
                    node.bounds[axis][0][place] = bounds.min[axis];
                    node.bounds[axis][1][place] = bounds.max[axis];
                }
                if plan.is_block[child] {
                    node.children[place] = BLOCK | self.blocks.len() as u32;
                    self.blocks.push(TriangleBlock::new(leaves(binary, child).into_iter().map(|t| (t, corners(t)))));
                } else {
                    open.push((child, Some((index, place))));
                }
            }
            self.nodes.push(node);
        }
    }

    /// Shows `visit` the blocks that the ray may meet before the limit: hits and names. It returns the new limit, or breaks the search off.
    /// Nearer ones come first where `ORDERED`.
    #[inline]
    pub fn visit<const ORDERED: bool>(
        &self,
        ray: &HierarchyRay,
        limit: f32,
        visit: impl FnMut(&BlockHits, &[u32; EIGHT]) -> ControlFlow<(), f32>,
    ) {
        self.level.dispatch_eight(Traversal::<ORDERED, _> { hierarchy: self, ray, limit, visit });
    }
}

struct Traversal<'a, const ORDERED: bool, V> {
    hierarchy: &'a Hierarchy,
    ray: &'a HierarchyRay,
    limit: f32,
    visit: V,
}

impl<const ORDERED: bool, V> WithEight for Traversal<'_, ORDERED, V>
where
    V: FnMut(&BlockHits, &[u32; EIGHT]) -> ControlFlow<(), f32>,
{
    type Output = ();

    #[inline(always)]
    fn with_eight<E: Eight>(mut self, e: E) {
        let (hierarchy, ray) = (self.hierarchy, self.ray);
        let mut waiting = Waiting { count: 0, first: [(0, 0.0); STACK], rest: Vec::new() };
        let mut child = 0;
        loop {
            if child & BLOCK == 0 {
                let node = &hierarchy.nodes[child as usize];
                let (mut met, near) = ray.enters(e, node, self.limit);
                let first = waiting.count;
                while met != 0 {
                    let i = met.trailing_zeros() as usize;
                    met &= met - 1;
                    waiting.push(node.children[i], near[i]);
                    if ORDERED && waiting.count <= STACK {
                        let mut at = waiting.count - 1;
                        while at > first && waiting.first[at - 1].1 < waiting.first[at].1 {
                            waiting.first.swap(at - 1, at);
                            at -= 1;
                        }
                    }
                }
            } else {
                let block = &hierarchy.blocks[(child & !BLOCK) as usize];
                if let Some(hits) = ray.sheared.meet(e, block) {
                    match (self.visit)(&hits, &block.names) {
                        ControlFlow::Continue(limit) => self.limit = limit,
                        ControlFlow::Break(()) => return,
                    }
                }
            }
            loop {
                let Some((next, at)) = waiting.pop() else { return };
                if !ORDERED || at < self.limit {
                    child = next;
                    break;
                }
            }
        }
    }
}

/// How a binary hierarchy is folded at the least cost: the sum over wide nodes and blocks of the areas of their boxes, which is how often
/// a ray meets them (Ylitie, Karras and Laine 2017, with their triangles replaced by blocks).
struct Plan {
    /// For each binary node: the least cost if 1 … 8 places of a wide node are spent on what is below it.
    cost: Vec<[f32; EIGHT]>,
    /// Of how many places the left child gets how many.
    left: Vec<[u8; EIGHT]>,
    /// Whether a node that has one place becomes a block.
    is_block: Vec<bool>,
}

impl Plan {
    fn new(binary: &Bvh2) -> Self {
        let n = binary.nodes.len();
        let mut plan = Self { cost: vec![[0.0; EIGHT]; n], left: vec![[0; EIGHT]; n], is_block: vec![false; n] };
        let mut counts = vec![0u32; n];
        // Children after their parents, whatever order they are stored in.
        let (mut order, mut at) = (vec![0usize], 0);
        while let Some(&i) = order.get(at) {
            let node = &binary.nodes[i];
            if !node.is_leaf() {
                order.extend([node.first_index as usize, node.first_index as usize + 1]);
            }
            at += 1;
        }
        for &i in order.iter().rev() {
            let node = &binary.nodes[i];
            let area = node.aabb().half_area();
            if node.is_leaf() {
                counts[i] = node.prim_count;
                plan.is_block[i] = true;
                plan.cost[i] = [area; EIGHT];
                continue;
            }
            let (a, b) = (node.first_index as usize, node.first_index as usize + 1);
            counts[i] = counts[a] + counts[b];
            // With k + 1 places, 1 ≤ k ≤ 7.
            let mut spread = [f32::INFINITY; EIGHT];
            for k in 1..EIGHT {
                for l in 1..=k {
                    let cost = plan.cost[a][l - 1] + plan.cost[b][k - l];
                    if cost < spread[k] {
                        (spread[k], plan.left[i][k]) = (cost, l as u8);
                    }
                }
            }
            let inner = spread[EIGHT - 1] + area;
            plan.is_block[i] = counts[i] <= EIGHT as u32 && area <= inner;
            plan.cost[i][0] = if plan.is_block[i] { area } else { inner };
            for k in 1..EIGHT {
                plan.cost[i][k] = plan.cost[i][k - 1].min(spread[k]);
            }
        }
        plan
    }

    /// The binary nodes that the wide node made from `root` holds.
    fn children(&self, binary: &Bvh2, root: usize) -> Vec<usize> {
        if self.is_block[root] {
            return vec![root];
        }
        let (mut open, mut found) = (vec![(root, EIGHT, true)], Vec::new());
        while let Some((i, mut places, is_root)) = open.pop() {
            // As few places as cost no more.
            while !is_root && places > 1 && self.cost[i][places - 2] <= self.cost[i][places - 1] {
                places -= 1;
            }
            if places == 1 {
                found.push(i);
                continue;
            }
            let (a, l) = (binary.nodes[i].first_index as usize, usize::from(self.left[i][places - 1]));
            open.push((a + 1, places - l, false));
            open.push((a, l, false));
        }
        found
    }
}

/// The triangles below a node.
fn leaves(binary: &Bvh2, root: usize) -> Vec<u32> {
    let (mut open, mut found) = (vec![root], Vec::new());
    while let Some(i) = open.pop() {
        let node = &binary.nodes[i];
        let first = node.first_index as usize;
        if node.is_leaf() {
            found.extend_from_slice(&binary.primitive_indices[first..first + node.prim_count as usize]);
        } else {
            open.extend([first + 1, first]);
        }
    }
    found
}

/// A box around three corners, wider by `margin`.
pub(crate) fn triangle_box(corners: [Vec3; 3], margin: f32) -> Aabb {
    let [a, b, c] = corners.map(Vec3A::from);
    Aabb::new(a.min(b).min(c) - margin, a.max(b).max(c) + margin)
}
