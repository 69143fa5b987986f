//! Light from all directions: a constant, half a sky, or a picture of the surroundings.
use crate::Rng;
use crate::error::{PathtraceError, check_rgb};
use diamond_image::Image;
use glam::{Mat3, Vec3};
use std::f32::consts::{PI, TAU};

/// Radiance that arrives from infinity.
#[derive(Debug, Clone, PartialEq)]
pub enum Environment {
    /// The same from everywhere: the furnace.
    Constant {
        /// Linear RGB radiance.
        radiance: Vec3,
    },
    /// Constant on one side of a plane and none on the other.
    Hemisphere {
        /// Unit direction of the bright hemisphere's middle.
        axis: Vec3,
        /// Linear RGB radiance.
        radiance: Vec3,
    },
    /// A picture.
    Map(EnvironmentMap),
}

/// An equirectangular picture of the surroundings, constant over each pixel, sampled in proportion to what its pixels shine.
#[derive(Debug, Clone, PartialEq)]
pub struct EnvironmentMap {
    image: Image,
    /// World → map; the map's z points to row 0.
    rotation: Mat3,
    /// Cumulative weight of rows, and of the pixels of each row; last entries are 1.
    rows: Vec<f32>,
    columns: Vec<f32>,
    /// Σ weight · solid angle, for the density.
    total: f64,
}

impl EnvironmentMap {
    /// From linear RGB radiance, row 0 towards the map's +z, column 0 beginning at its +x and going on towards +y. `rotation` takes
    /// world directions to the map. Errors unless there are 3 channels, numbers are finite and ≥ 0, and something shines.
    pub fn new(image: Image, rotation: Mat3) -> Result<Self, PathtraceError> {
        let (width, height, channels) = image.shape();
        if channels != 3 || width == 0 || height == 0 {
            return Err(PathtraceError::Shape {
                what: "an environment map",
                expected: "a picture with 3 channels".into(),
                found: format!("{width}×{height}×{channels}"),
            });
        }
        if let Some(bad) = image.data().iter().find(|v| !(v.is_finite() && **v >= 0.0 && **v <= 1e12)) {
            return Err(PathtraceError::Value {
                what: "radiance of an environment map".into(),
                expected: "finite numbers from 0 to 10¹²",
                found: format!("{bad}"),
            });
        }
        let weight = |x: usize, y: usize| f64::from(image.pixel(x, y).iter().sum::<f32>());
        let mut rows = Vec::with_capacity(height);
        let mut columns = Vec::with_capacity(width * height);
        let mut total = 0.0;
        for y in 0..height {
            let sum: f64 = (0..width).map(|x| weight(x, y)).sum();
            let mut running = 0.0;
            columns.extend((0..width).map(|x| {
                running += weight(x, y);
                if sum > 0.0 { (running / sum) as f32 } else { (x + 1) as f32 / width as f32 }
            }));
            total += sum * solid_angle(width, height, y);
            rows.push(total);
        }
        if total <= 0.0 {
            return Err(PathtraceError::Value {
                what: "an environment map".into(),
                expected: "at least one pixel that shines",
                found: "only zeros".into(),
            });
        }
        let rows = rows.into_iter().map(|v| (v / total) as f32).collect();
        Ok(Self { image, rotation, rows, columns, total })
    }

    fn pixel_of(&self, direction: Vec3) -> (usize, usize) {
        let d = self.rotation * direction;
        let (width, height, _) = self.image.shape();
        let theta = d.z.clamp(-1.0, 1.0).acos();
        let phi = d.y.atan2(d.x).rem_euclid(TAU);
        let cell = |v: f32, n: usize| ((v * n as f32) as usize).min(n - 1);
        (cell(phi / TAU, width), cell(theta / PI, height))
    }

    fn pdf_of(&self, x: usize, y: usize) -> f32 {
        (f64::from(self.image.pixel(x, y).iter().sum::<f32>()) / self.total) as f32
    }

    fn radiance(&self, direction: Vec3) -> Vec3 {
        let (x, y) = self.pixel_of(direction);
        Vec3::from_slice(self.image.pixel(x, y))
    }

    fn sample(&self, rng: &mut Rng) -> (Vec3, Vec3, f32) {
        let (width, height, _) = self.image.shape();
        let (u, v) = (rng.uniform(), rng.uniform());
        let y = self.rows.partition_point(|c| *c <= u).min(height - 1);
        let row = &self.columns[y * width..(y + 1) * width];
        let x = row.partition_point(|c| *c <= v).min(width - 1);
        // Uniform in solid angle within the pixel: cos θ is uniform.
        let edge = |k: usize| (PI * k as f32 / height as f32).cos();
        let z = edge(y) + (edge(y + 1) - edge(y)) * rng.uniform();
        let phi = TAU * (x as f32 + rng.uniform()) / width as f32;
        let r = (1.0 - z * z).max(0.0).sqrt();
        let direction = self.rotation.transpose() * Vec3::new(r * phi.cos(), r * phi.sin(), z);
        (direction, Vec3::from_slice(self.image.pixel(x, y)), self.pdf_of(x, y))
    }
}

/// Steradians of a pixel in row `y`.
fn solid_angle(width: usize, height: usize, y: usize) -> f64 {
    let edge = |k: usize| (std::f64::consts::PI * k as f64 / height as f64).cos();
    (edge(y) - edge(y + 1)) * std::f64::consts::TAU / width as f64
}

impl Environment {
    /// `Err` where a number is negative or not finite, or an axis has no unit length.
    pub fn validate(&self) -> Result<(), PathtraceError> {
        let strength = |v| check_rgb("radiance of an environment", v, "a finite number ≥ 0", |v| v >= 0.0);
        match self {
            Environment::Constant { radiance } => strength(*radiance),
            Environment::Hemisphere { axis, radiance } => {
                strength(*radiance)?;
                crate::light::check_unit("axis of an environment", *axis)
            }
            Environment::Map(_) => Ok(()),
        }
    }

    /// Linear RGB radiance that arrives from `direction` (unit, towards the environment).
    #[inline]
    pub fn radiance(&self, direction: Vec3) -> Vec3 {
        match self {
            Environment::Constant { radiance } => *radiance,
            Environment::Hemisphere { axis, radiance } => {
                if axis.dot(direction) > 0.0 {
                    *radiance
                } else {
                    Vec3::ZERO
                }
            }
            Environment::Map(map) => map.radiance(direction),
        }
    }

    /// Density of [`Environment::sample`]; `None` for environments that are left to be found by chance.
    #[inline]
    pub fn pdf(&self, direction: Vec3) -> Option<f32> {
        let Environment::Map(map) = self else { return None };
        let (x, y) = map.pixel_of(direction);
        Some(map.pdf_of(x, y))
    }

    /// A direction in proportion to what it shines, its radiance and density per steradian. `None` for smooth environments, which
    /// paths find as well without.
    pub fn sample(&self, rng: &mut Rng) -> Option<(Vec3, Vec3, f32)> {
        let Environment::Map(map) = self else { return None };
        Some(map.sample(rng))
    }
}
