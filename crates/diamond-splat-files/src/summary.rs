//! What is in a cloud, in numbers for a person.
use crate::{ColorSpace, SplatCloud};
use glam::Vec3;

/// Bins of the histogram of opacities.
pub const OPACITY_BINS: usize = 10;

/// Figures about a cloud.
#[derive(Debug, Clone, PartialEq)]
pub struct Summary {
    /// Number of Gaussians.
    pub count: usize,
    /// Degree of the colour.
    pub degree: usize,
    /// Smallest and largest coordinates of the centres; `None` of an empty cloud.
    pub bounds: Option<(Vec3, Vec3)>,
    /// The box that holds 98 of 100 centres along each axis, without strays.
    pub core: Option<(Vec3, Vec3)>,
    /// Smallest, median and largest standard deviation, scene units.
    pub scales: Option<[f32; 3]>,
    /// Gaussians by opacity, equal bins of [0, 1].
    pub opacities: [usize; OPACITY_BINS],
    /// Mean colour without its dependence on direction, weighted by opacity.
    pub color: Vec3,
}

impl SplatCloud {
    /// Counts and measures.
    pub fn summary(&self) -> Summary {
        let n = self.len();
        let sorted = |mut values: Vec<f32>| {
            values.sort_unstable_by(f32::total_cmp);
            values
        };
        let at = |values: &[f32], t: f64| values[((n - 1) as f64 * t).round() as usize];
        let mut opacities = [0; OPACITY_BINS];
        let (mut color, mut weight) = (glam::DVec3::ZERO, 0.0f64);
        for i in 0..n {
            let o = self.opacity(i);
            opacities[((o * OPACITY_BINS as f32) as usize).min(OPACITY_BINS - 1)] += 1;
            color += self.base_color(i).as_dvec3() * f64::from(o);
            weight += f64::from(o);
        }
        let (mut bounds, mut core, mut scales) = (None, None, None);
        if n > 0 {
            let axes: [Vec<f32>; 3] = std::array::from_fn(|k| sorted(self.means.iter().map(|m| m[k]).collect()));
            let corner = |t: f64| Vec3::from(std::array::from_fn(|k| at(&axes[k], t)));
            bounds = Some((corner(0.0), corner(1.0)));
            core = Some((corner(0.01), corner(0.99)));
            let all = sorted(self.log_scales.iter().flat_map(|s| s.to_array()).collect());
            let pick = |i: usize| crate::cloud::scale(all[i]);
            scales = Some([pick(0), pick(all.len() / 2), pick(all.len() - 1)]);
        }
        let color = if weight > 0.0 { (color / weight).as_vec3() } else { Vec3::ZERO };
        Summary { count: n, degree: self.degree, bounds, core, scales, opacities, color }
    }
}

impl Summary {
    /// The figures as lines; `cloud` is what they are of.
    pub fn to_text(&self, cloud: &SplatCloud) -> String {
        const BAR: usize = 40;
        let vector = |v: Vec3| format!("({:.4}, {:.4}, {:.4})", v.x, v.y, v.z);
        let space = match cloud.color_space {
            ColorSpace::Display => "taken for display sRGB",
            ColorSpace::Linear => "linear",
        };
        let mut out = format!("{} Gaussians, colour of degree {}, {space}\n", self.count, self.degree);
        if let (Some((low, high)), Some((core_low, core_high))) = (self.bounds, self.core) {
            out += &format!("centres   {} to {}\n", vector(low), vector(high));
            out += &format!("98 in 100 {} to {}\n", vector(core_low), vector(core_high));
        }
        if let Some([low, median, high]) = self.scales {
            out += &format!("standard deviations {low:.3e} to {high:.3e}, median {median:.3e}\n");
        }
        out += &format!("mean colour {}\n", vector(self.color));
        let most = self.opacities.iter().copied().max().unwrap_or(0).max(1);
        out += "opacity\n";
        for (i, count) in self.opacities.iter().enumerate() {
            let bar = "#".repeat((count * BAR).div_ceil(most));
            out += &format!("  {:.1} to {:.1}  {count:>9}  {bar}\n", i as f32 / 10.0, (i + 1) as f32 / 10.0);
        }
        if cloud.normals.is_some() {
            out += "has normals\n";
        }
        if cloud.antialiased {
            out += "fitted with an antialiasing filter\n";
        }
        out
    }
}
