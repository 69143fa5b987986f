//! Naive deferred shading of one pixel, term by term, over any [`Real`].
use crate::Real;
use crate::camera::unproject_z;
use crate::ggx::{self, Model, dot, normalise};
use crate::light::point_incidence;

/// Number of values that [`Setting::shade_pixel`] returns.
pub const OUTPUTS: usize = 24;

/// Where the irradiance comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Incident {
    /// (incident channel + offset) · intensity.
    Learned {
        /// The offset.
        offset: f64,
    },
    /// The intensity, or with a reference distance its inverse-square falloff.
    Physical {
        /// The reference distance.
        reference: Option<f64>,
    },
}

/// A camera, a light and the choices of the shader.
#[derive(Debug, Clone, Copy)]
pub struct Setting {
    /// BRDF.
    pub model: Model,
    /// Irradiance.
    pub incident: Incident,
    /// surface + s·residual instead of (1 − s)·surface + s·residual.
    pub additive: bool,
    /// Divide features by opacity.
    pub normalise: bool,
    /// Multiply the surface by the visibility channel.
    pub shadowed: bool,
    /// Least n·l (0: black below the horizon).
    pub horizon_leak: f64,
    /// Least n·v.
    pub min_cos_theta_o: f64,
    /// Constant roughness.
    pub roughness: Option<f64>,
    /// Without: surface only, whole.
    pub use_residual: bool,
    /// Residual times intensity.
    pub scale_residual: bool,
    /// fx, fy, cx, cy.
    pub pinhole: [f64; 4],
    /// World to camera, rows.
    pub rotation: [[f64; 3]; 3],
    /// World to camera.
    pub translation: [f64; 3],
    /// Position of a point light, or direction of a directional one.
    pub light: [f64; 3],
    /// Whether `light` is a direction.
    pub directional: bool,
    /// Intensity, or irradiance.
    pub intensity: [f64; 3],
}

impl Setting {
    /// From the 14 sums Σ w·f (base colour 3, roughness, metalness, subsurfaceness, normal 3, residual 3, incident,
    /// visibility), the opacity Σ w and the depth Σ w·z to: radiance 3, surface 3, subsurface 3, base colour 3,
    /// roughness, metalness, subsurfaceness, normal 3, residual 3, incident, visibility, depth.
    pub fn shade_pixel<R: Real>(&self, pixel: [f64; 2], sums: &[R], opacity: R, depth: R) -> Vec<R> {
        let (zero, one) = (R::of(0.0), R::of(1.0));
        let f: Vec<R> = sums.iter().map(|&s| if self.normalise { s / opacity } else { s }).collect();
        let z = depth / opacity;
        let constants = |v: [f64; 3]| v.map(R::of);
        let (pinhole, rotation) = (self.pinhole.map(R::of), self.rotation.map(constants));
        let place = |z: R| unproject_z(pinhole, rotation, constants(self.translation), pixel.map(R::of), z);
        let (x, eye) = (place(z), place(zero));
        let v = normalise([eye[0] - x[0], eye[1] - x[1], eye[2] - x[2]]);
        let n = normalise([f[6], f[7], f[8]]);
        let roughness = self.roughness.map_or(f[3], R::of);
        let s = f[5];

        let reference = match self.incident {
            Incident::Physical { reference } => reference.map(R::of),
            Incident::Learned { .. } => None,
        };
        let (light, intensity) = (constants(self.light), constants(self.intensity));
        let (l, mut irradiance) = if self.directional {
            (light, intensity)
        } else {
            let i = point_incidence(light, intensity, x, reference);
            ([i[0], i[1], i[2]], [i[4], i[5], i[6]])
        };
        if let Incident::Learned { offset } = self.incident {
            irradiance = irradiance.map(|e| e * (f[12] + R::of(offset)));
        }

        let mut a = ggx::angles(n, v, l);
        let ci = dot(n, normalise(l));
        a[0] = if ci.value() < self.horizon_leak { R::of(self.horizon_leak) } else { ci };
        if a[1].value() < self.min_cos_theta_o {
            a[1] = R::of(self.min_cos_theta_o);
        }
        let mut out = vec![zero; OUTPUTS];
        for c in 0..3 {
            let mut surface = zero;
            if a[0].value() > 0.0 {
                surface = irradiance[c] * ggx::evaluate_at(self.model, f[c], roughness, f[4], a) * a[0];
            }
            if self.shadowed {
                surface = surface * f[13];
            }
            let mut residual = f[9 + c];
            if self.scale_residual {
                residual = residual * intensity[c];
            }
            let (surface, subsurface) = match (self.use_residual, self.additive) {
                (false, _) => (surface, zero),
                (true, false) => ((one - s) * surface, s * residual),
                (true, true) => (surface, s * residual),
            };
            out[c] = opacity * (surface + subsurface);
            out[3 + c] = opacity * surface;
            out[6 + c] = opacity * subsurface;
            out[9 + c] = f[c];
            out[15 + c] = n[c];
            out[18 + c] = f[9 + c];
        }
        out[12] = roughness;
        (out[13], out[14], out[21], out[22], out[23]) = (f[4], s, f[12], f[13], z);
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera at the origin looks at a facing white wall lit from where it stands: radiance = O·c/π.
    #[test]
    fn a_lambertian_wall_worked_by_hand() {
        let setting = Setting {
            model: Model {
                masking: ggx::Masking::SmithSeparable,
                fresnel: ggx::Fresnel::Schlick,
                diffuse: ggx::Diffuse::Lambert,
            },
            incident: Incident::Physical { reference: Some(4.0) },
            additive: false,
            normalise: true,
            shadowed: true,
            horizon_leak: 0.0,
            min_cos_theta_o: 0.0,
            roughness: Some(1.0),
            use_residual: true,
            scale_residual: false,
            pinhole: [1.0, 1.0, 0.5, 0.5],
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            light: [0.0, 0.0, 0.0],
            directional: false,
            intensity: [1.0, 2.0, 3.0],
        };
        // O = ½, depth 4; base ½, s = ½, residual ½, visibility ½, all times O.
        let h = 0.25;
        let sums = [h, h, h, 0.0, 0.0, h, 0.0, 0.0, -0.5, h, h, h, 0.0, h];
        let out = setting.shade_pixel([0.5, 0.5], &sums, 0.5, 2.0);
        // α = 1 at normal incidence: D/4 = 1/4π and F = 0.04.
        let f = (0.5 + 0.01) / std::f64::consts::PI;
        for (c, intensity) in setting.intensity.into_iter().enumerate() {
            assert!((out[3 + c] - 0.5 * 0.5 * f * 0.5 * intensity).abs() < 1e-12, "{out:?}");
            assert!((out[6 + c] - 0.5 * 0.5 * 0.5).abs() < 1e-12);
        }
        assert_eq!((out[15..18].to_vec(), out[23]), (vec![0.0, 0.0, -1.0], 4.0));
    }
}
