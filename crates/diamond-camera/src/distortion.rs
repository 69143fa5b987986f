//! Lens distortion: where a lens puts what a pinhole would put elsewhere.
//!
//! A distortion maps normalised pinhole coordinates (x/z, y/z) to those at which the lens forms the image; the pixel is
//! then `f·x + c` as ever. Two models cover what calibration programs write: a polynomial in the radius with decentring,
//! and the equidistant fisheye. Everything is computed in `f64`: the polynomials cancel.
//!
//! ```
//! use diamond_camera::Distortion;
//! let barrel = Distortion::Brown { k1: -0.2, k2: 0.0, k3: 0.0, p1: 0.0, p2: 0.0 };
//! let [x, y] = barrel.distort([0.5, 0.0]);
//! assert!((x - 0.5 * (1.0 - 0.2 * 0.25)).abs() < 1e-12 && y == 0.0);
//! let back = barrel.undistort([x, y]).unwrap();
//! assert!((back[0] - 0.5).abs() < 1e-9);
//! ```
use crate::CameraError;

/// A lens distortion, in normalised coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Distortion {
    /// A pinhole.
    #[default]
    None,
    /// Radial polynomial with decentring: OpenCV's five coefficients, COLMAP's `SIMPLE_RADIAL`, `RADIAL` and `OPENCV`.
    Brown {
        /// Coefficient of r².
        k1: f64,
        /// Coefficient of r⁴.
        k2: f64,
        /// Coefficient of r⁶.
        k3: f64,
        /// Decentring, mostly along y.
        p1: f64,
        /// Decentring, mostly along x.
        p2: f64,
    },
    /// Equidistant fisheye with a polynomial in the angle: OpenCV's `fisheye`, COLMAP's `OPENCV_FISHEYE`.
    Fisheye {
        /// Coefficient of θ³.
        k1: f64,
        /// Coefficient of θ⁵.
        k2: f64,
        /// Coefficient of θ⁷.
        k3: f64,
        /// Coefficient of θ⁹.
        k4: f64,
    },
}

/// Steps in which a monotonic range is looked for, and its end: a normalised radius of 20 is 87° off the axis.
const SCAN_STEPS: usize = 4000;
const SCAN_END: f64 = 20.0;

/// Newton steps of the inverse; it converges in five where it converges.
const NEWTON_STEPS: usize = 40;

impl Distortion {
    /// `Err` where a coefficient is not finite.
    pub fn validate(&self) -> Result<(), CameraError> {
        let named: Vec<(&'static str, f64)> = match *self {
            Distortion::None => vec![],
            Distortion::Brown { k1, k2, k3, p1, p2 } => {
                vec![("k1", k1), ("k2", k2), ("k3", k3), ("p1", p1), ("p2", p2)]
            }
            Distortion::Fisheye { k1, k2, k3, k4 } => vec![("k1", k1), ("k2", k2), ("k3", k3), ("k4", k4)],
        };
        match named.into_iter().find(|(_, v)| !v.is_finite()) {
            Some((field, v)) => Err(CameraError::Intrinsics {
                field,
                expected: "a finite coefficient of lens distortion",
                found: v.to_string(),
            }),
            None => Ok(()),
        }
    }

    /// Whether this moves no point: a pinhole, or a polynomial with all coefficients 0. A fisheye always moves.
    pub fn is_none(&self) -> bool {
        match *self {
            Distortion::None => true,
            Distortion::Brown { k1, k2, k3, p1, p2 } => [k1, k2, k3, p1, p2] == [0.0; 5],
            Distortion::Fisheye { .. } => false,
        }
    }

    /// Normalised pinhole coordinates → normalised coordinates of the lens.
    ///
    /// With r² = x² + y² and `[eq:brown]` s = 1 + k1·r² + k2·r⁴ + k3·r⁶:
    /// (x·s + 2·p1·x·y + p2·(r² + 2x²), y·s + p1·(r² + 2y²) + 2·p2·x·y);
    /// fisheye `[eq:fisheye]`: (x, y)·θ(1 + k1·θ² + k2·θ⁴ + k3·θ⁶ + k4·θ⁸)/r with θ = atan r.
    pub fn distort(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let r2 = x * x + y * y;
        match *self {
            Distortion::None => [x, y],
            Distortion::Brown { k1, k2, k3, p1, p2 } => {
                let s = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                let xy = 2.0 * x * y;
                [x * s + p1 * xy + p2 * (r2 + 2.0 * x * x), y * s + p1 * (r2 + 2.0 * y * y) + p2 * xy]
            }
            Distortion::Fisheye { .. } => {
                let r = r2.sqrt();
                // θ/r → 1 on the axis.
                let s = if r > 1e-9 { self.radius(r) / r } else { 1.0 };
                [x * s, y * s]
            }
        }
    }

    /// The distorted radius of a radius, without decentring.
    fn radius(&self, r: f64) -> f64 {
        match *self {
            Distortion::None => r,
            Distortion::Brown { k1, k2, k3, .. } => {
                let r2 = r * r;
                r * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))
            }
            Distortion::Fisheye { k1, k2, k3, k4 } => {
                let theta = libm::atan(r);
                let t2 = theta * theta;
                theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
            }
        }
    }

    /// Derivative of [`Distortion::radius`].
    fn slope(&self, r: f64) -> f64 {
        match *self {
            Distortion::None => 1.0,
            Distortion::Brown { k1, k2, k3, .. } => {
                let r2 = r * r;
                1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3))
            }
            Distortion::Fisheye { k1, k2, k3, k4 } => {
                let theta = libm::atan(r);
                let t2 = theta * theta;
                (1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))) / (1.0 + r * r)
            }
        }
    }

    /// The radius up to which the distorted radius grows: beyond it the polynomial folds back and would show the
    /// picture a second time, mirrored. Infinite where it never does within 87° of the axis.
    pub fn monotonic_radius(&self) -> f64 {
        if matches!(self, Distortion::None) {
            return f64::INFINITY;
        }
        let step = SCAN_END / SCAN_STEPS as f64;
        match (1..=SCAN_STEPS).map(|i| i as f64 * step).find(|&r| self.slope(r).is_nan() || self.slope(r) <= 0.0) {
            Some(r) => r - step,
            None => f64::INFINITY,
        }
    }

    /// The inverse of [`Distortion::distort`] within the monotonic radius; `None` where no point of it maps there.
    pub fn undistort(&self, [u, v]: [f64; 2]) -> Option<[f64; 2]> {
        if self.is_none() {
            return Some([u, v]);
        }
        let limit = self.monotonic_radius().min(SCAN_END);
        // The radius first, by bisection, then decentring by Newton on both coordinates.
        let target = (u * u + v * v).sqrt();
        if !target.is_finite() || target == 0.0 && !matches!(self, Distortion::Brown { .. }) {
            return target.is_finite().then_some([u, v]);
        }
        let (mut low, mut high) = (0.0, limit);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if self.radius(middle) < target { low = middle } else { high = middle }
        }
        let scale = if target > 0.0 { 0.5 * (low + high) / target } else { 1.0 };
        let [mut x, mut y] = [u * scale, v * scale];
        for _ in 0..NEWTON_STEPS {
            let [a, b] = self.distort([x, y]);
            let (ex, ey) = (a - u, b - v);
            if ex.abs().max(ey.abs()) < 1e-13 * (1.0 + target) {
                break;
            }
            let [[j00, j01], [j10, j11]] = self.jacobian([x, y]);
            let determinant = j00 * j11 - j01 * j10;
            if determinant.is_nan() || determinant.abs() < 1e-12 {
                return None;
            }
            x -= (j11 * ex - j01 * ey) / determinant;
            y -= (j00 * ey - j10 * ex) / determinant;
        }
        let [a, b] = self.distort([x, y]);
        let met = (a - u).abs().max((b - v).abs()) < 1e-9 * (1.0 + target);
        (met && (x * x + y * y).sqrt() <= limit).then_some([x, y])
    }

    /// Derivatives of [`Distortion::distort`], row by row.
    fn jacobian(&self, [x, y]: [f64; 2]) -> [[f64; 2]; 2] {
        let r2 = x * x + y * y;
        let r = r2.sqrt();
        // Of the radial part (x, y)·s(r): s on the diagonal, and (x, y)·(x, y)ᵀ·s′/r.
        let (s, outer) = match *self {
            Distortion::None => (1.0, 0.0),
            _ if r < 1e-9 => (1.0, 0.0),
            _ => {
                let s = self.radius(r) / r;
                (s, (self.slope(r) - s) / r2)
            }
        };
        let (mut j00, mut j01, mut j10, mut j11) = (s + outer * x * x, outer * x * y, outer * x * y, s + outer * y * y);
        if let Distortion::Brown { p1, p2, .. } = *self {
            j00 += 2.0 * p1 * y + 6.0 * p2 * x;
            j01 += 2.0 * p1 * x + 2.0 * p2 * y;
            j10 += 2.0 * p1 * x + 2.0 * p2 * y;
            j11 += 6.0 * p1 * y + 2.0 * p2 * x;
        }
        [[j00, j01], [j10, j11]]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const POINTS: &str = include_str!("../../../assets/fixtures/distortion/points.csv");

    /// The lenses of assets/fixtures/distortion/recipe.py.
    fn lens(name: &str) -> Distortion {
        let brown = |k1, k2, p1, p2, k3| Distortion::Brown { k1, k2, k3, p1, p2 };
        match name {
            "barrel" => brown(-0.28, 0.07, 0.0, 0.0, 0.0),
            "pincushion" => brown(0.15, 0.02, 0.0, 0.0, 0.0),
            "tangential" => brown(-0.12, 0.03, 0.004, -0.006, -0.002),
            "fisheye" => Distortion::Fisheye { k1: 0.05, k2: -0.012, k3: 0.004, k4: -0.001 },
            _ => Distortion::Fisheye { k1: 0.0, k2: 0.0, k3: 0.0, k4: 0.0 },
        }
    }

    /// `[eq:brown]`, `[eq:fisheye]`: the points that OpenCV distorted.
    #[test]
    fn distorted_points_are_those_of_opencv() {
        let mut worst = 0.0f64;
        let mut compared = 0;
        for line in POINTS.lines().skip(1) {
            let mut cells = line.split(',');
            let name = cells.next().unwrap();
            let v: Vec<f64> = cells.map(|c| c.trim().parse().unwrap()).collect();
            let d = lens(name).distort([v[0], v[1]]);
            worst = worst.max((d[0] - v[2]).abs()).max((d[1] - v[3]).abs());
            compared += 1;
        }
        assert!(compared == 120 && worst < 1e-12, "{compared} points, worst {worst:.1e}");
    }

    #[test]
    fn where_the_polynomial_folds_back() {
        let barrel = Distortion::Brown { k1: -0.3, k2: 0.0, k3: 0.0, p1: 0.0, p2: 0.0 };
        assert!((barrel.monotonic_radius() - (1.0f64 / 0.9).sqrt()).abs() < 0.006);
        assert_eq!(lens("pincushion").monotonic_radius(), f64::INFINITY);
        assert_eq!(lens("fisheye_plain").monotonic_radius(), f64::INFINITY);
        // No point maps beyond the largest distorted radius.
        assert_eq!(barrel.undistort([5.0, 0.0]), None);
        let bad = Distortion::Fisheye { k1: f64::NAN, k2: 0.0, k3: 0.0, k4: 0.0 };
        assert!(bad.validate().unwrap_err().to_string().contains("k1"));
        assert!(bad.undistort([0.1, 0.1]).is_none() && bad.monotonic_radius() == 0.0);
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn undistorting_undoes_distorting(
            x in -0.8..0.8f64, y in -0.8..0.8f64,
            k in prop::array::uniform4(-0.15..0.15f64), p in prop::array::uniform2(-0.01..0.01f64), fisheye in any::<bool>(),
        ) {
            let lens = match fisheye {
                true => Distortion::Fisheye { k1: k[0], k2: k[1], k3: 0.2 * k[2], k4: 0.1 * k[3] },
                false => Distortion::Brown { k1: k[0], k2: k[1], k3: 0.3 * k[2], p1: p[0], p2: p[1] },
            };
            prop_assume!((x * x + y * y).sqrt() < 0.9 * lens.monotonic_radius());
            let [a, b] = lens.undistort(lens.distort([x, y])).expect("within the monotonic radius");
            prop_assert!((a - x).abs().max((b - y).abs()) < 1e-7, "{:?}: ({}, {}) came back as ({}, {})", lens, x, y, a, b);
        }

        #[test]
        fn any_coefficients_and_points_are_survived(k in prop::array::uniform5(any::<f64>()), x in any::<f64>(), y in any::<f64>()) {
            for lens in [
                Distortion::Brown { k1: k[0], k2: k[1], k3: k[2], p1: k[3], p2: k[4] },
                Distortion::Fisheye { k1: k[0], k2: k[1], k3: k[2], k4: k[3] },
            ] {
                lens.distort([x, y]);
                if let Some([a, b]) = lens.undistort([x, y]) {
                    prop_assert!(a.is_finite() && b.is_finite());
                }
            }
        }
    }
}
