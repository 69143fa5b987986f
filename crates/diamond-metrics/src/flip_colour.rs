//! The colour spaces of FLIP: sRGB, linear RGB, XYZ, the opponent space YCxCz, and L*a*b*.
//!
//! All in f64. White is the sum of the three primaries, and everything is relative to it.

/// A colour, or an opponent triple.
pub(crate) type Triple = [f64; 3];

/// Chromaticities (x, y) of the sRGB primaries and of D65, IEC 61966-2-1.
const PRIMARIES: [[f64; 2]; 3] = [[0.64, 0.33], [0.30, 0.60], [0.15, 0.06]];
const WHITE: [f64; 2] = [0.3127, 0.3290];

/// The linear maps between linear RGB and white-relative XYZ.
pub(crate) struct Primaries {
    /// Linear RGB → XYZ divided by the XYZ of white: every row sums to 1.
    to_relative_xyz: [Triple; 3],
    from_relative_xyz: [Triple; 3],
}

fn multiply(m: &[Triple; 3], v: Triple) -> Triple {
    std::array::from_fn(|r| m[r][0] * v[0] + m[r][1] * v[1] + m[r][2] * v[2])
}

/// Inverse by cofactors; the matrices here are far from singular.
fn inverse(m: &[Triple; 3]) -> [Triple; 3] {
    let cofactor = |r: usize, c: usize| {
        let (r1, r2, c1, c2) = ((r + 1) % 3, (r + 2) % 3, (c + 1) % 3, (c + 2) % 3);
        m[r1][c1] * m[r2][c2] - m[r1][c2] * m[r2][c1]
    };
    let determinant: f64 = (0..3).map(|c| m[0][c] * cofactor(0, c)).sum();
    std::array::from_fn(|r| std::array::from_fn(|c| cofactor(c, r) / determinant))
}

impl Primaries {
    /// The primaries of sRGB.
    pub fn srgb() -> Self {
        let xyz = |[x, y]: [f64; 2]| [x / y, 1.0, (1.0 - x - y) / y];
        let white = xyz(WHITE);
        let columns = PRIMARIES.map(xyz);
        let m: [Triple; 3] = std::array::from_fn(|r| std::array::from_fn(|c| columns[c][r]));
        // How much of each primary makes white.
        let amount = multiply(&inverse(&m), white);
        let to_relative_xyz = std::array::from_fn(|r| std::array::from_fn(|c| m[r][c] * amount[c] / white[r]));
        Self { from_relative_xyz: inverse(&to_relative_xyz), to_relative_xyz }
    }

    /// Linear RGB → opponent: Y = 116·y − 16, Cx = 500·(x − y), Cz = 200·(y − z), with white-relative x, y, z.
    pub fn opponent(&self, rgb: Triple) -> Triple {
        let [x, y, z] = multiply(&self.to_relative_xyz, rgb);
        [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
    }

    /// The inverse of [`Primaries::opponent`].
    pub fn rgb_of_opponent(&self, [luma, cx, cz]: Triple) -> Triple {
        let y = achromatic(luma);
        multiply(&self.from_relative_xyz, [y + cx / 500.0, y, y - cz / 200.0])
    }

    /// Linear RGB → CIE L*a*b* whose a and b are scaled by 0.01·L (the Hunt effect: dim colours look less colourful).
    pub fn hunt_lab(&self, rgb: Triple) -> Triple {
        const DELTA: f64 = 6.0 / 29.0;
        let f = multiply(&self.to_relative_xyz, rgb)
            .map(|t| if t > DELTA * DELTA * DELTA { libm::cbrt(t) } else { t / (3.0 * DELTA * DELTA) + 4.0 / 29.0 });
        let lightness = 116.0 * f[1] - 16.0;
        let hunt = 0.01 * lightness;
        [lightness, hunt * 500.0 * (f[0] - f[1]), hunt * 200.0 * (f[1] - f[2])]
    }
}

/// Opponent Y → luminance relative to white, in `[0, 1]` for displayable colours.
pub(crate) fn achromatic(luma: f64) -> f64 {
    (luma + 16.0) / 116.0
}

/// sRGB value in `[0, 1]` → linear.
pub(crate) fn srgb_decode(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { libm::pow((v + 0.055) / 1.055, 2.4) }
}

/// The HyAB distance of two L*a*b* colours: |ΔL| + √(Δa² + Δb²), made for large differences.
pub(crate) fn hyab(p: Triple, q: Triple) -> f64 {
    (p[0] - q[0]).abs() + libm::hypot(p[1] - q[1], p[2] - q[2])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn white_is_neutral_and_the_matrix_is_the_standards() {
        let p = Primaries::srgb();
        let white = p.hunt_lab([1.0; 3]);
        assert!((white[0] - 100.0).abs() < 1e-9 && white[1].abs() < 1e-9 && white[2].abs() < 1e-9);
        let luminance = [0.2126, 0.7152, 0.0722];
        for c in 0..3 {
            assert!((p.to_relative_xyz[1][c] - luminance[c]).abs() < 1e-4);
        }
    }

    #[test]
    fn the_opponent_space_goes_there_and_back() {
        let p = Primaries::srgb();
        for rgb in [[0.0, 0.0, 0.0], [1.0, 0.2, 0.7], [0.01, 0.99, 0.5]] {
            let back = p.rgb_of_opponent(p.opponent(rgb));
            for c in 0..3 {
                assert!((back[c] - rgb[c]).abs() < 1e-12);
            }
        }
    }
}
