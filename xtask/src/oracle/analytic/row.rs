//! What a row of the analytic table asks for.

/// A beam of unit irradiance, or light from everywhere above.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Incidence {
    /// A beam whose direction has this cosine with the normal.
    Beam(f32),
    /// Lambertian incidence.
    Lambert,
}

/// A layer between two planes; a half-space where `tau` is infinite.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Layer {
    /// Single-scattering albedo.
    pub albedo: f32,
    /// Mean cosine.
    pub g: f32,
    /// Optical thickness.
    pub tau: f32,
    /// Index of refraction; 1 without a boundary.
    pub eta: f32,
}

/// A quantity that we know how to compute.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Quantity {
    /// Reflected part of the light.
    Reflectance(Layer, Incidence),
    /// Transmitted part of the light, unscattered and scattered.
    Transmittance(Layer, Incidence),
    /// Scattering function of a layer's upper side, 1/sr, for the cosines of incidence and emergence.
    Brdf(Layer, f32, f32),
    /// Deep attenuation κ/σ_t for an albedo.
    Attenuation(f64),
    /// Chandrasekhar's function: cosine, albedo.
    H(f64, f64),
    /// Part of a parallel beam that passes a sphere that absorbs only, for σ·R.
    AbsorbingSphere(f32),
    /// Radiance of a white object in a furnace of radiance 1.
    Furnace(Layer),
    /// Total reflectance of the dipole: reduced albedo, index.
    DipoleTotal(f64, f64),
    /// Profile of the dipole: reduced albedo, index, distance.
    DipoleProfile(f64, f64, f64),
    /// Burley's cumulative distribution at r/d.
    BurleyCdf(f64),
    /// Burley's scale under a beam, for a surface albedo.
    BurleySearchlight(f64),
    /// Burley's scale under diffuse light.
    BurleyDiffuse(f64),
    /// Single-scattering albedo for a surface albedo.
    AlbedoInversion(f64),
    /// ⟨r²⟩ after n flights with mean cosine g.
    MeanSquare(u32, f32),
    /// Directional albedo of GGX with Fresnel term 1.
    GgxAlbedo {
        /// Width of the lobe.
        alpha: f32,
        /// Cosine of the view.
        cos: f32,
        /// Whether masking and shadowing are correlated in height.
        correlated: bool,
    },
}

/// The number after `key` and an optional sign of equality, where `key` is a word of its own.
fn number(text: &str, key: &str) -> Option<f64> {
    text.match_indices(key).find_map(|(start, _)| {
        let before = text[..start].chars().next_back();
        let rest = text[start + key.len()..].strip_prefix('=')?.trim_start();
        let word = !before.is_some_and(|c| c.is_alphanumeric() || c == '_');
        let end = rest.find(|c: char| !(c.is_ascii_digit() || ".-+eE".contains(c))).unwrap_or(rest.len());
        let found = rest[..end].trim_end_matches(['.', 'e', 'E']).parse().ok();
        found.filter(|_| word)
    })
}

fn argument(text: &str, name: &str) -> Option<f64> {
    let rest = &text[text.find(&format!("{name}("))? + name.len() + 1..];
    rest[..rest.find(')')?].trim_start_matches("r=").parse().ok()
}

/// What the text asks for; `None` for what is not known here.
pub fn read(quantity: &str) -> Option<Quantity> {
    let text = quantity.replace("a'=", "reduced=");
    let has = |word: &str| text.contains(word);
    let get = |key: &str| number(&text, key);
    let eta = get("eta").or(get("n")).unwrap_or(1.0);
    let layer = |tau: f64| {
        let albedo = get("a")?;
        Some(Layer { albedo: albedo as f32, g: get("g").unwrap_or(0.0) as f32, tau: tau as f32, eta: eta as f32 })
    };
    let incidence = || {
        if has("Lambert") {
            Some(Incidence::Lambert)
        } else if let Some(mu0) = get("mu0") {
            Some(Incidence::Beam(mu0 as f32))
        } else {
            has("normal").then_some(Incidence::Beam(1.0))
        }
    };
    if has("urnace") {
        let tau = get("tau").unwrap_or(4.0) as f32;
        let g = get("g").unwrap_or(0.0) as f32;
        return Some(Quantity::Furnace(Layer { albedo: get("a").unwrap_or(1.0) as f32, g, tau, eta: eta as f32 }));
    }
    if text.starts_with("semi") {
        let layer = layer(f64::INFINITY)?;
        if has("BRDF") {
            let cosines = if has("normal->normal") { (1.0, 1.0) } else { (get("mu0")?, get("mu")?) };
            return Some(Quantity::Brdf(layer, cosines.0 as f32, cosines.1 as f32));
        }
        return (has("albedo") || has(" R")).then_some(Quantity::Reflectance(layer, incidence()?));
    }
    if text.starts_with("inf") {
        return has("attenuation").then(|| get("a").map(Quantity::Attenuation)).flatten();
    }
    if text.starts_with("slab") {
        let layer = layer(get("tau")?)?;
        return if has(" R ") {
            Some(Quantity::Reflectance(layer, incidence()?))
        } else if has(" T ") {
            Some(Quantity::Transmittance(layer, incidence()?))
        } else {
            None
        };
    }
    if text.starts_with("H(") {
        return Some(Quantity::H(argument(&text, "H")?, get("a")?));
    }
    if text.starts_with("sphere absorb") {
        return Some(Quantity::AbsorbingSphere(number(&text.replace("sigma*R", "depth"), "depth")? as f32));
    }
    if text.starts_with("dipole") {
        let albedo = get("reduced")?;
        if has("total") {
            return Some(Quantity::DipoleTotal(albedo, eta));
        }
        // Distances are in reduced mean free paths.
        let r = if has("r=1/sigma_t'") { 1.0 } else { argument(&text, "R")? };
        return Some(Quantity::DipoleProfile(albedo, eta, r));
    }
    if text.starts_with("Burley") {
        let colour = || get("A");
        return if has("CDF") {
            let d = get("d").unwrap_or(1.0);
            Some(Quantity::BurleyCdf(argument(&text, "CDF")? / d))
        } else if has("integral") {
            Some(Quantity::BurleyCdf(f64::INFINITY))
        } else if has("searchlight") {
            colour().map(Quantity::BurleySearchlight)
        } else if has("diffuse") {
            colour().map(Quantity::BurleyDiffuse)
        } else {
            None
        };
    }
    if text.starts_with("Chiang") {
        return number(&text, "alpha(A").map(Quantity::AlbedoInversion);
    }
    if has("r^2") {
        return Some(Quantity::MeanSquare(get("n")? as u32, get("g")? as f32));
    }
    if text.starts_with("GGX directional albedo") && has("F=1") {
        let correlated = has("correlated");
        return Some(Quantity::GgxAlbedo { alpha: get("alpha")? as f32, cos: get("cos")? as f32, correlated });
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_row_is_read() {
        let half = |a| Layer { albedo: a, g: 0.0, tau: f32::INFINITY, eta: 1.0 };
        let cases = [
            (
                "semiinf_iso a=0.5 plane albedo, normal incidence",
                Quantity::Reflectance(half(0.5), Incidence::Beam(1.0)),
            ),
            ("semiinf_iso a=0.8 plane albedo, mu0=0.25", Quantity::Reflectance(half(0.8), Incidence::Beam(0.25))),
            (
                "semiinf_iso a=0.5 spherical (Lambert incidence) albedo",
                Quantity::Reflectance(half(0.5), Incidence::Lambert),
            ),
            ("semiinf_iso a=0.5 BRDF mu0=1,mu=0.5 [1/sr]", Quantity::Brdf(half(0.5), 1.0, 0.5)),
            ("inf_iso a=0.5 asymptotic attenuation kappa/sigma_t", Quantity::Attenuation(0.5)),
            ("H(1) at a=1", Quantity::H(1.0, 1.0)),
            (
                "slab a=0.9 g=0.75 tau=2.0 T total normal",
                Quantity::Transmittance(Layer { albedo: 0.9, g: 0.75, tau: 2.0, eta: 1.0 }, Incidence::Beam(1.0)),
            ),
            ("sphere absorb-only sigma*R=0.5: parallel beam transmitted fraction", Quantity::AbsorbingSphere(0.5)),
            ("dipole(Jensen2001) total Rd a'=0.5 eta=1.3", Quantity::DipoleTotal(0.5, 1.3)),
            ("dipole R(r=1/sigma_t') a'=0.9 eta=1.3", Quantity::DipoleProfile(0.9, 1.3, 1.0)),
            ("dipole R(r=0.1) a'=0.99 eta=1.5", Quantity::DipoleProfile(0.99, 1.5, 0.1)),
            ("Burley CDF(1), d=1", Quantity::BurleyCdf(1.0)),
            ("Burley s_diffuse A=0.2", Quantity::BurleyDiffuse(0.2)),
            ("Chiang2016 albedo inversion alpha(A=0.5)", Quantity::AlbedoInversion(0.5)),
            ("<r^2> after n=20 flights, g=0.5 [mfp^2]", Quantity::MeanSquare(20, 0.5)),
            (
                "GGX directional albedo alpha=0.04 cos=0.5 F=1 separable Smith",
                Quantity::GgxAlbedo { alpha: 0.04, cos: 0.5, correlated: false },
            ),
        ];
        for (text, expected) in cases {
            assert_eq!(read(text), Some(expected), "{text}");
        }
        assert_eq!(read("slab of marble"), None);
    }
}
