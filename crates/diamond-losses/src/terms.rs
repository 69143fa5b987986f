//! The names of the objective's terms, said once, for configuration, logs and documents.

/// A term of the objective.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Term {
    /// Absolute difference and structural dissimilarity of the rendered image, [`crate::photometric`].
    Photometric,
    /// Perceptual distance by learned features; computed elsewhere, listed here for its name.
    Lpips,
    /// Cross-entropy of opacity and mask, [`crate::mask_bce`].
    Mask,
    /// Rendered normals against pseudo-normals, [`crate::normal_consistency`].
    Normal,
    /// Smoothness of base colour, [`crate::smoothness`].
    SmoothBaseColor,
    /// Smoothness of metalness, [`crate::smoothness`].
    SmoothMetalness,
    /// Smoothness of roughness, [`crate::smoothness`].
    SmoothRoughness,
    /// Smoothness of subsurfaceness, [`crate::smoothness`].
    SmoothSubsurfaceness,
    /// Base colour against the enhanced photograph, [`crate::enhancement`].
    Enhancement,
    /// Incident light against visibility, [`crate::incident_light`].
    Incident,
    /// Visibility by spherical harmonics against traced visibility, [`crate::visibility`].
    Visibility,
    /// Entropy of the Gaussians' opacities, [`crate::opacity_entropy`].
    OpacityEntropy,
    /// Entropy of the rendered opacity, [`crate::mask_entropy`].
    MaskEntropy,
    /// The smallest scale of each Gaussian, [`crate::flatness`].
    Flatness,
    /// Normals against shortest axes, [`crate::normal_alignment`].
    NormalAlignment,
    /// Silhouettes of different views against each other; computed elsewhere, listed here for its name.
    SilhouetteConsistency,
    /// Depths of different views against each other; computed elsewhere, listed here for its name.
    DepthConsistency,
}

/// What is to be known of a term.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TermInfo {
    /// The term.
    pub term: Term,
    /// Name in logs and reports.
    pub name: &'static str,
    /// Key of its weight in the configuration, in the table of losses.
    pub lambda_key: &'static str,
    /// Tag of its equation, without brackets; `None` for a term that is computed in another crate.
    pub tag: Option<&'static str>,
    /// Weight in the released SSS-3DGS system; `None` where the term is not part of it. The photometric weight is that of
    /// 1 − SSIM.
    pub lambda_original: Option<f32>,
    /// Weight in the DIAMOND-SSS paper, after tuning; `None` where the term is not part of it.
    pub lambda_tuned: Option<f32>,
}

const fn info(
    term: Term,
    name: &'static str,
    lambda_key: &'static str,
    tag: Option<&'static str>,
    lambdas: [Option<f32>; 2],
) -> TermInfo {
    TermInfo { term, name, lambda_key, tag, lambda_original: lambdas[0], lambda_tuned: lambdas[1] }
}

/// All terms, in the order of [`Term`]. A name that the literature gives twice is one term: `enh` and `base_color` are
/// enhancement, `ray` is visibility.
pub const TERMS: [TermInfo; 17] = [
    info(Term::Photometric, "photometric", "ssim", Some("photometric"), [Some(0.2), Some(0.492)]),
    info(Term::Lpips, "lpips", "lpips", None, [Some(0.2), Some(0.171)]),
    info(Term::Mask, "mask", "mask", Some("mask-bce"), [Some(0.1), Some(0.1)]),
    info(Term::Normal, "normal", "normal", Some("normal"), [Some(0.02), Some(0.037)]),
    info(
        Term::SmoothBaseColor,
        "smooth_base_color",
        "smooth_base_color",
        Some("smoothness"),
        [Some(0.006), Some(0.005)],
    ),
    info(Term::SmoothMetalness, "smooth_metalness", "smooth_metalness", Some("smoothness"), [Some(0.002), Some(0.007)]),
    info(Term::SmoothRoughness, "smooth_roughness", "smooth_roughness", Some("smoothness"), [Some(0.002), Some(0.003)]),
    info(
        Term::SmoothSubsurfaceness,
        "smooth_subsurfaceness",
        "smooth_subsurfaceness",
        Some("smoothness"),
        [Some(0.002), Some(0.002)],
    ),
    info(Term::Enhancement, "enhancement", "enhancement", Some("enhancement"), [Some(0.005), Some(0.002)]),
    info(Term::Incident, "incident", "incident", Some("incident"), [Some(0.02), Some(0.015)]),
    info(Term::Visibility, "visibility", "visibility", Some("visibility"), [Some(0.01), Some(0.01)]),
    info(Term::OpacityEntropy, "opacity_entropy", "opacity_entropy", Some("opacity-entropy"), [None, None]),
    info(Term::MaskEntropy, "mask_entropy", "mask_entropy", Some("mask-entropy"), [None, None]),
    info(Term::Flatness, "flatness", "flatness", Some("flatness"), [None, None]),
    info(Term::NormalAlignment, "normal_alignment", "normal_alignment", Some("normal-alignment"), [None, None]),
    info(Term::SilhouetteConsistency, "silhouette_consistency", "silhouette_consistency", None, [None, Some(0.5)]),
    info(Term::DepthConsistency, "depth_consistency", "depth_consistency", None, [None, Some(0.3)]),
];

impl Term {
    /// What is to be known of this term.
    pub fn info(self) -> &'static TermInfo {
        &TERMS[self as usize]
    }

    /// Name in logs and reports.
    pub fn name(self) -> &'static str {
        self.info().name
    }

    /// The term whose weight has this key in the configuration.
    pub fn from_lambda_key(key: &str) -> Option<Self> {
        TERMS.iter().find(|info| info.lambda_key == key).map(|info| info.term)
    }
}

impl std::fmt::Display for Term {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_is_complete_ordered_and_unambiguous() {
        for (i, info) in TERMS.iter().enumerate() {
            assert_eq!(info.term as usize, i, "{}", info.name);
            assert_eq!(info.term.info(), info);
            assert_eq!(Term::from_lambda_key(info.lambda_key), Some(info.term));
            assert_eq!(TERMS.iter().filter(|other| other.name == info.name).count(), 1);
        }
        assert_eq!(Term::from_lambda_key("ray"), None);
    }
}
