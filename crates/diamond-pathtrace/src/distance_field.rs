//! Procedural objects: signed distances blended into each other, with noise on top.
//!
//! A field is negative inside. Parts are united one after the other with a smooth minimum, or cut away with a smooth maximum, so that
//! they flow together over the blending distance. Noise moves the surface along its normal by up to its amplitude.
use crate::Rng;
use crate::noise::fractal_noise;
use glam::{Mat3, Quat, Vec2, Vec3};

/// A solid with a known distance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Solid {
    /// A ball.
    Sphere {
        /// Centre.
        centre: Vec3,
        /// Radius.
        radius: f32,
    },
    /// A box with rounded edges.
    Cuboid {
        /// Centre.
        centre: Vec3,
        /// Half of each side, rounding included.
        half: Vec3,
        /// Radius of edges and corners.
        rounding: f32,
        /// Turns the box's axes into the world's.
        rotation: Quat,
    },
    /// All points within `radius` of a segment.
    Capsule {
        /// One end of the segment.
        a: Vec3,
        /// The other.
        b: Vec3,
        /// Radius.
        radius: f32,
    },
    /// A ring.
    Torus {
        /// Centre.
        centre: Vec3,
        /// Unit axis of the ring.
        axis: Vec3,
        /// Distance of the ring's middle from the axis.
        major: f32,
        /// Radius of its cross-section.
        minor: f32,
    },
    /// An ellipsoid (a bound of the distance, exact on its surface).
    Ellipsoid {
        /// Centre.
        centre: Vec3,
        /// Semi-axes.
        radii: Vec3,
        /// Turns the ellipsoid's axes into the world's.
        rotation: Quat,
    },
}

/// What a part does to what is there already.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Operation {
    /// It is added.
    Union,
    /// It is cut away.
    Difference,
}

/// Noise on the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceNoise {
    /// Largest displacement, scene units; 0 is none.
    pub amplitude: f32,
    /// Bumps of the coarsest octave per scene unit.
    pub frequency: f32,
    /// Octaves, each twice as fine and half as high, 1 … 8.
    pub octaves: u32,
    /// Which noise.
    pub seed: u64,
}

/// A blended object.
#[derive(Debug, Clone, PartialEq)]
pub struct DistanceField {
    /// Parts in the order in which they are applied.
    pub parts: Vec<(Operation, Solid)>,
    /// Distance over which parts flow into each other, scene units; 0 keeps creases.
    pub blend: f32,
    /// Noise on top.
    pub noise: Option<SurfaceNoise>,
}

impl Solid {
    /// Signed distance of a point, negative inside.
    pub fn distance(&self, p: Vec3) -> f32 {
        match *self {
            Solid::Sphere { centre, radius } => (p - centre).length() - radius,
            Solid::Cuboid { centre, half, rounding, rotation } => {
                let local = Mat3::from_quat(rotation).transpose() * (p - centre);
                let rounding = rounding.clamp(0.0, half.min_element().max(0.0));
                let q = local.abs() - (half - rounding);
                q.max(Vec3::ZERO).length() + q.max_element().min(0.0) - rounding
            }
            Solid::Capsule { a, b, radius } => {
                let (along, offset) = (b - a, p - a);
                let t = (offset.dot(along) / along.length_squared().max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
                (offset - along * t).length() - radius
            }
            Solid::Torus { centre, axis, major, minor } => {
                let offset = p - centre;
                let height = offset.dot(axis);
                let around = (offset - axis * height).length();
                Vec2::new(around - major, height).length() - minor
            }
            Solid::Ellipsoid { centre, radii, rotation } => {
                let local = Mat3::from_quat(rotation).transpose() * (p - centre);
                let (k0, k1) = ((local / radii).length(), (local / (radii * radii)).length());
                if k1 > 0.0 { k0 * (k0 - 1.0) / k1 } else { -radii.min_element() }
            }
        }
    }

    /// A ball that holds the solid: centre and radius.
    pub fn ball(&self) -> (Vec3, f32) {
        match *self {
            Solid::Sphere { centre, radius } => (centre, radius),
            Solid::Cuboid { centre, half, .. } => (centre, half.length()),
            Solid::Capsule { a, b, radius } => (0.5 * (a + b), 0.5 * (b - a).length() + radius),
            Solid::Torus { centre, major, minor, .. } => (centre, major + minor),
            Solid::Ellipsoid { centre, radii, .. } => (centre, radii.max_element()),
        }
    }
}

/// The polynomial smooth minimum: at most k/4 below the smaller one, equal to it where they differ by k or more.
/// `[eq:smooth-minimum]`
pub fn smooth_minimum(a: f32, b: f32, k: f32) -> f32 {
    if k <= 0.0 {
        return a.min(b);
    }
    let h = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - 0.25 * h * h * k
}

impl DistanceField {
    /// The field at a point: negative inside, near the surface about the distance.
    pub fn distance(&self, p: Vec3) -> f32 {
        let mut field = f32::INFINITY;
        for (operation, solid) in &self.parts {
            let d = solid.distance(p);
            field = match operation {
                Operation::Union if field == f32::INFINITY => d,
                Operation::Union => smooth_minimum(field, d, self.blend),
                Operation::Difference => -smooth_minimum(-field, d, self.blend),
            };
        }
        match self.noise {
            Some(n) if n.amplitude != 0.0 => field - n.amplitude * fractal_noise(p * n.frequency, n.octaves, n.seed),
            _ => field,
        }
    }

    /// A box that holds the surface.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        let margin = 0.25 * self.blend.max(0.0) + self.noise.map_or(0.0, |n| n.amplitude.abs());
        let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for (operation, solid) in &self.parts {
            if *operation == Operation::Union {
                let (centre, radius) = solid.ball();
                low = low.min(centre - radius);
                high = high.max(centre + radius);
            }
        }
        (low - margin, high + margin)
    }

    /// A random object of two to six parts about the origin, in one piece, some with a piece cut out; the same for equal seeds.
    pub fn random(seed: u64) -> Self {
        let mut rng = Rng::new(seed, 0x0b1ec7);
        let range = |rng: &mut Rng, low: f32, high: f32| low + (high - low) * rng.uniform();
        let first = Solid::Ellipsoid {
            centre: Vec3::ZERO,
            radii: Vec3::from([0; 3].map(|_| range(&mut rng, 0.35, 0.6))),
            rotation: random_rotation(&mut rng),
        };
        let mut parts = vec![(Operation::Union, first)];
        let more = 1 + rng.bits() % 5;
        for _ in 0..more {
            // Centred in the skin of a part that is there, so that everything hangs together.
            let (_, host) = parts[(rng.bits() as usize) % parts.len()];
            let (middle, reach) = host.ball();
            let centre = middle + crate::sampling::uniform_sphere(&mut rng) * (0.6 * reach.min(0.6));
            let solid = random_solid(&mut rng, centre);
            parts.push((Operation::Union, solid));
        }
        if rng.uniform() < 0.35 {
            let direction = crate::sampling::uniform_sphere(&mut rng);
            let radius = range(&mut rng, 0.15, 0.3);
            parts.push((Operation::Difference, Solid::Sphere { centre: direction * 0.6, radius }));
        }
        let blend = range(&mut rng, 0.05, 0.35);
        let noise = (rng.uniform() < 0.7).then(|| SurfaceNoise {
            amplitude: range(&mut rng, 0.005, 0.05),
            frequency: range(&mut rng, 1.5, 5.0),
            octaves: 1 + rng.bits() % 3,
            seed: u64::from(rng.bits()),
        });
        Self { parts, blend, noise }
    }
}

/// A rotation, every one as likely as any other (Shoemake 1992).
fn random_rotation(rng: &mut Rng) -> Quat {
    let u = rng.uniform();
    let (s1, c1) = (std::f32::consts::TAU * rng.uniform()).sin_cos();
    let (s2, c2) = (std::f32::consts::TAU * rng.uniform()).sin_cos();
    let (a, b) = ((1.0 - u).sqrt(), u.sqrt());
    Quat::from_xyzw(a * s1, a * c1, b * s2, b * c2).normalize()
}

fn random_solid(rng: &mut Rng, centre: Vec3) -> Solid {
    let range = |rng: &mut Rng, low: f32, high: f32| low + (high - low) * rng.uniform();
    match rng.bits() % 5 {
        0 => Solid::Sphere { centre, radius: range(rng, 0.2, 0.45) },
        1 => {
            let half = Vec3::from([0; 3].map(|_| range(rng, 0.15, 0.4)));
            Solid::Cuboid { centre, half, rounding: range(rng, 0.02, 0.12), rotation: random_rotation(rng) }
        }
        2 => {
            let end = crate::sampling::uniform_sphere(rng) * range(rng, 0.3, 0.7);
            Solid::Capsule { a: centre, b: centre + end, radius: range(rng, 0.1, 0.25) }
        }
        3 => {
            let axis = crate::sampling::uniform_sphere(rng);
            Solid::Torus { centre, axis, major: range(rng, 0.3, 0.5), minor: range(rng, 0.08, 0.16) }
        }
        _ => {
            let radii = Vec3::from([0; 3].map(|_| range(rng, 0.15, 0.5)));
            Solid::Ellipsoid { centre, radii, rotation: random_rotation(rng) }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[eq:smooth-minimum]`
    #[test]
    fn the_smooth_minimum_is_a_minimum_with_a_rounded_corner() {
        assert_eq!(smooth_minimum(1.0, 3.0, 0.5), 1.0);
        assert_eq!(smooth_minimum(2.0, 2.0, 0.4), 1.9);
        assert_eq!(smooth_minimum(2.0, 1.0, 0.0), 1.0);
    }

    /// Distances are zero on the surface, grow at most as fast as one walks, and have the right sign.
    #[test]
    fn solids_know_their_distance() {
        let mut rng = Rng::new(7, 7);
        for kind in 0..200 {
            let solid = random_solid(&mut rng, Vec3::new(0.1, -0.2, 0.3));
            let (centre, radius) = solid.ball();
            let direction = crate::sampling::uniform_sphere(&mut rng);
            assert!(solid.distance(centre + direction * radius * 1.01) > 0.0, "{kind}: {solid:?}");
            let p = centre + direction * radius * rng.uniform() * 1.5;
            let step = crate::sampling::uniform_sphere(&mut rng) * 1e-2;
            let change = (solid.distance(p + step) - solid.distance(p)).abs();
            let exact = !matches!(solid, Solid::Ellipsoid { .. });
            assert!(!exact || change <= 1.0001e-2, "{solid:?} {change}");
        }
        let cube = Solid::Cuboid { centre: Vec3::ONE, half: Vec3::ONE, rounding: 0.0, rotation: Quat::IDENTITY };
        assert_eq!(cube.distance(Vec3::ONE), -1.0);
        assert_eq!(cube.distance(Vec3::new(3.0, 1.0, 1.0)), 1.0);
    }
}
