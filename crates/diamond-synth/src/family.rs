//! A family of random recipes: hundreds of objects and materials from one seed, for training.
use crate::{
    BoundaryRecipe, CoatRecipe, FilmRecipe, HeldOutRecipe, MaterialRecipe, ObjectRecipe, QualityRecipe, Recipe,
    RigRecipe, SynthError, changed_table,
};
use diamond_pathtrace::Rng;
use serde::{Deserialize, Serialize};

/// Random numbers of a family's members.
const STREAM: u64 = 0x6661_6d69_6c79;

/// Seeds of a family and what its members have in common.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Family {
    /// First part of the members' names.
    pub name: String,
    /// Number of members.
    pub count: u32,
    /// Seed of all of them.
    #[serde(default)]
    pub seed: u64,
    /// Cells along the longest side of each object.
    #[serde(default = "cells")]
    pub cells: u32,
    /// As in a recipe.
    #[serde(default)]
    pub rig: RigRecipe,
    /// As in a recipe.
    #[serde(default)]
    pub held_out: HeldOutRecipe,
    /// As in a recipe.
    #[serde(default)]
    pub film: FilmRecipe,
    /// As in a recipe.
    #[serde(default)]
    pub quality: QualityRecipe,
}

fn cells() -> u32 {
    48
}

/// A kind of translucent matter: ranges from which its members are drawn.
struct Matter {
    name: &'static str,
    /// Mean free paths across the object's radius.
    density: [f32; 2],
    /// Colour of multiply scattered light: lowest and highest per channel.
    colour: [[f32; 3]; 2],
    /// Ratio of blue to red extinction.
    chroma: [f32; 2],
    g: [f32; 2],
    eta: [f32; 2],
    roughness: [f32; 2],
}

/// Kinds of matter, with roughly the optical densities of objects that fit in a hand.
const MATTERS: [Matter; 7] = [
    Matter {
        name: "wax",
        density: [6.0, 20.0],
        colour: [[0.8, 0.65, 0.4], [0.97, 0.93, 0.85]],
        chroma: [1.0, 1.6],
        g: [0.0, 0.3],
        eta: [1.4, 1.45],
        roughness: [0.3, 0.6],
    },
    Matter {
        name: "jade",
        density: [8.0, 30.0],
        colour: [[0.2, 0.55, 0.25], [0.6, 0.9, 0.7]],
        chroma: [0.8, 1.4],
        g: [0.0, 0.5],
        eta: [1.5, 1.65],
        roughness: [0.1, 0.35],
    },
    Matter {
        name: "marble",
        density: [20.0, 60.0],
        colour: [[0.75, 0.72, 0.68], [0.97, 0.96, 0.94]],
        chroma: [1.0, 1.2],
        g: [0.0, 0.3],
        eta: [1.45, 1.55],
        roughness: [0.1, 0.5],
    },
    Matter {
        name: "skin",
        density: [15.0, 50.0],
        colour: [[0.6, 0.3, 0.2], [0.92, 0.7, 0.6]],
        chroma: [1.5, 3.0],
        g: [0.2, 0.5],
        eta: [1.38, 1.44],
        roughness: [0.35, 0.6],
    },
    Matter {
        name: "milk",
        density: [30.0, 80.0],
        colour: [[0.88, 0.85, 0.75], [0.99, 0.98, 0.95]],
        chroma: [1.1, 1.6],
        g: [0.2, 0.6],
        eta: [1.33, 1.36],
        roughness: [0.1, 0.3],
    },
    Matter {
        name: "soap",
        density: [3.0, 12.0],
        colour: [[0.4, 0.5, 0.4], [0.95, 0.95, 0.95]],
        chroma: [0.8, 1.3],
        g: [0.0, 0.4],
        eta: [1.45, 1.5],
        roughness: [0.2, 0.5],
    },
    Matter {
        name: "plastic",
        density: [2.0, 10.0],
        colour: [[0.1, 0.1, 0.1], [0.95, 0.95, 0.95]],
        chroma: [0.7, 1.4],
        g: [0.0, 0.3],
        eta: [1.45, 1.6],
        roughness: [0.15, 0.5],
    },
];

impl Family {
    /// Reads a family; `origin` names it in errors.
    ///
    /// # Errors
    /// [`SynthError::Recipe`].
    pub fn parse(text: &str, origin: &str) -> Result<Self, SynthError> {
        Self::parse_changed(text, origin, &[])
    }

    /// Reads a family with changes such as `rig.views=4`, see [`changed_table`].
    ///
    /// # Errors
    /// [`SynthError::Recipe`].
    pub fn parse_changed(text: &str, origin: &str, changes: &[String]) -> Result<Self, SynthError> {
        let fail = |detail: String| SynthError::Recipe { origin: origin.into(), detail };
        let family: Result<Family, _> = match changes.is_empty() {
            true => toml::from_str(text),
            false => changed_table(text, origin, changes)?.try_into(),
        };
        let family = family.map_err(|e| fail(e.to_string()))?;
        family.member(0).check(origin)?;
        Ok(family)
    }

    /// Member `index`, which depends on the seed and the index alone.
    pub fn member(&self, index: u32) -> Recipe {
        let mut rng = Rng::new(self.seed, STREAM ^ (u64::from(index) << 32));
        let matter = &MATTERS[rng.bits() as usize % MATTERS.len()];
        let density = logarithmic(&mut rng, matter.density);
        let chroma = logarithmic(&mut rng, matter.chroma);
        let g = between(&mut rng, matter.g);
        let [low, high] = matter.colour;
        // Channels of a colour go up and down together, mostly.
        let common = rng.uniform();
        let colour: [f32; 3] = std::array::from_fn(|c| {
            let t = 0.7 * common + 0.3 * rng.uniform();
            low[c] + (high[c] - low[c]) * t
        });
        // Forward scattering hardly scatters: the same look needs 1/(1 − g) as many collisions.
        let sigma_t = [density, density * chroma.sqrt(), density * chroma].map(|s| s / (1.0 - g));
        let albedo =
            colour.map(|c| similarity(diamond_pathtrace::closed_form::albedo_from_colour(f64::from(c)) as f32, g));
        let eta = between(&mut rng, matter.eta);
        let roughness = between(&mut rng, matter.roughness);
        let f0 = ((eta - 1.0) / (eta + 1.0)).powi(2);
        let coat = CoatRecipe { roughness, f0: [f0; 3] };
        Recipe {
            name: format!("{} {index}: {}", self.name, matter.name),
            seed: u64::from(rng.bits()) << 32 | u64::from(rng.bits()),
            object: ObjectRecipe::Random { seed: u64::from(rng.bits()), cells: self.cells },
            material: MaterialRecipe {
                sigma_t,
                albedo,
                g,
                boundary: BoundaryRecipe::Matched,
                coat: Some(coat),
                veins: None,
            },
            rig: self.rig,
            held_out: self.held_out,
            film: self.film,
            quality: self.quality,
        }
    }

    /// All members, in order.
    pub fn members(&self) -> impl Iterator<Item = Recipe> + '_ {
        (0..self.count).map(|index| self.member(index))
    }
}

fn between(rng: &mut Rng, [low, high]: [f32; 2]) -> f32 {
    low + (high - low) * rng.uniform()
}

fn logarithmic(rng: &mut Rng, [low, high]: [f32; 2]) -> f32 {
    low * (high / low).powf(rng.uniform())
}

/// The albedo of a medium of mean cosine `g` that looks like an isotropic one of albedo `isotropic`: where σ_s(1 − g) and σ_a
/// agree.
fn similarity(isotropic: f32, g: f32) -> f32 {
    isotropic / (isotropic + (1.0 - isotropic) * (1.0 - g))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_are_valid_different_and_the_same_again() {
        let family = Family::parse("name = \"f\"\ncount = 300\nseed = 4\n", "f").unwrap();
        let members: Vec<Recipe> = family.members().collect();
        assert_eq!(members, family.members().collect::<Vec<_>>());
        let mut hashes: Vec<String> = members.iter().map(Recipe::hash).collect();
        hashes.sort();
        hashes.dedup();
        assert_eq!(hashes.len(), 300);
        for member in &members {
            member.check("member").unwrap();
        }
        for matter in &MATTERS {
            let share = members.iter().filter(|m| m.name.ends_with(matter.name)).count();
            assert!((20..80).contains(&share), "{}: {share}", matter.name);
        }
        let other = Family { seed: 5, ..family.clone() };
        assert_ne!(other.member(0), family.member(0));
    }

    /// (1 − albedo) : albedo·(1 − g) stays what it was.
    #[test]
    fn similarity_keeps_the_ratio_of_absorption_to_reduced_scattering() {
        for (a, g) in [(0.9f32, 0.8f32), (0.5, 0.0), (1.0, 0.9), (0.0, 0.5)] {
            let b = similarity(a, g);
            assert!(((1.0 - b) * a - (1.0 - a) * b * (1.0 - g)).abs() < 1e-6);
        }
    }
}
