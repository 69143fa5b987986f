//! Which lights to render under, as written on a command line.
use crate::SssError;
use diamond_light::{LightRig, OlatLight};
use diamond_reconstruct::Model;
use glam::Vec3;

/// Lights that shine together: one picture.
#[derive(Debug, Clone, PartialEq)]
pub struct LightMix {
    /// Part of the file's name.
    pub name: String,
    /// The lights; their pictures are added.
    pub lights: Vec<OlatLight>,
}

/// Which lights to render under.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum LightChoice {
    /// The first light of the training rig.
    #[default]
    Training,
    /// A point light at a position.
    Point(Vec3),
    /// A light at infinity in a direction (from the scene to the light).
    Direction(Vec3),
    /// Point lights with linear RGB intensities, all at once.
    Mix(Vec<(Vec3, Vec3)>),
    /// So many lights of an even dome, one picture each.
    Dome(usize),
}

/// `x,y,z`, finite.
pub fn parse_vec3(text: &str) -> Result<Vec3, SssError> {
    let numbers: Vec<f32> = text.split(',').filter_map(|p| p.trim().parse().ok()).collect();
    match numbers.as_slice() {
        [x, y, z] if text.split(',').count() == 3 && numbers.iter().all(|v| v.is_finite()) => Ok(Vec3::new(*x, *y, *z)),
        _ => Err(SssError::Usage(format!("\"{text:.80}\": expected three finite numbers x,y,z"))),
    }
}

/// `x,y,z[:r,g,b];…`: positions and linear RGB intensities (1,1,1 where left out).
pub fn parse_mix(text: &str) -> Result<Vec<(Vec3, Vec3)>, SssError> {
    let parts: Vec<&str> = text.split(';').map(str::trim).filter(|p| !p.is_empty()).collect();
    if parts.is_empty() {
        return Err(SssError::Usage(format!("\"{text:.80}\": expected lights as x,y,z:r,g,b;x,y,z:r,g,b")));
    }
    parts
        .into_iter()
        .map(|part| {
            let (position, colour) = part.split_once(':').unwrap_or((part, "1,1,1"));
            let colour = parse_vec3(colour)?;
            if colour.min_element() < 0.0 {
                return Err(SssError::Usage(format!("\"{part:.80}\": intensities must not be negative")));
            }
            Ok((parse_vec3(position)?, colour))
        })
        .collect()
}

impl LightChoice {
    /// The mixes, one picture each. `rig` is the training rig, `up` is upward.
    pub fn mixes(&self, model: &Model, rig: &[OlatLight], up: Vec3) -> Result<Vec<LightMix>, SssError> {
        let usage = |e: diamond_light::LightError| SssError::Usage(e.to_string());
        let point = |position: Vec3, intensity: Vec3| OlatLight::Point { position, intensity };
        let centre = model.scene.centre();
        let one = |light: OlatLight| vec![LightMix { name: "light".into(), lights: vec![light] }];
        Ok(match self {
            Self::Training => match rig.first() {
                Some(light) => one(*light),
                None => one(point(centre + up * model.scene.light_distance, Vec3::ONE)),
            },
            Self::Point(position) => one(point(*position, Vec3::ONE)),
            Self::Direction(direction) => one(OlatLight::directional(*direction, Vec3::ONE).map_err(usage)?),
            Self::Mix(lights) => vec![LightMix {
                name: "mix".into(),
                lights: lights.iter().map(|(position, intensity)| point(*position, *intensity)).collect(),
            }],
            Self::Dome(count) => LightRig::dome(*count, centre, up, model.scene.light_distance, 0.0, Vec3::ONE)
                .map_err(usage)?
                .lights
                .into_iter()
                .enumerate()
                .map(|(i, light)| LightMix { name: format!("light_{i:03}"), lights: vec![light] })
                .collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lights_are_read_as_written() {
        assert_eq!(parse_vec3("1, -2,3e0").unwrap(), Vec3::new(1.0, -2.0, 3.0));
        for bad in ["", "1,2", "1,2,3,4", "1,2,x", "nan,0,0", "inf,1,1", "1,x,2,3"] {
            assert_eq!(parse_vec3(bad).unwrap_err().exit_code(), 2, "{bad}");
        }
        let mix = parse_mix("0,0,4:1,0.5,0; 4,0,0").unwrap();
        assert_eq!(mix, [(Vec3::Z * 4.0, Vec3::new(1.0, 0.5, 0.0)), (Vec3::X * 4.0, Vec3::ONE)]);
        assert!(parse_mix(";").is_err() && parse_mix("0,0,1:-1,0,0").is_err());
    }
}
