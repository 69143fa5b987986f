//! Between pictures and what is diffused: a variational autoencoder, blocks of pixels, or nothing.
use crate::error::Result;
use crate::nn::{depth_to_space, space_to_depth};
use candle_core::Tensor;

/// The way from pictures (batch, channels, height, width), encoded RGB in [−1, 1], to latents and back.
pub trait FirstStage {
    /// Pixels of a picture's side for one of the latents'.
    fn factor(&self) -> usize;

    /// Channels of latents of pictures with `channels` channels.
    fn latent_channels(&self, channels: usize) -> usize;

    /// What latents are multiplied by before they are diffused, so that they have about unit variance.
    fn scale(&self) -> f64;

    /// The most probable latents, *not* scaled: what a network is told about a source picture.
    fn encode(&self, pictures: &Tensor) -> Result<Tensor>;

    /// Latents to diffuse: scaled, and drawn where the encoder is uncertain. `noise` is standard normal, of the latents' shape.
    fn encode_to_diffuse(&self, pictures: &Tensor, noise: &Tensor) -> Result<Tensor>;

    /// Pictures of scaled latents.
    fn decode(&self, latents: &Tensor) -> Result<Tensor>;
}

/// Blocks of n × n pixels become channels; exact both ways.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SpaceToDepth(pub usize);

impl FirstStage for SpaceToDepth {
    fn factor(&self) -> usize {
        self.0
    }

    fn latent_channels(&self, channels: usize) -> usize {
        channels * self.0 * self.0
    }

    fn scale(&self) -> f64 {
        1.0
    }

    fn encode(&self, pictures: &Tensor) -> Result<Tensor> {
        space_to_depth(pictures, self.0)
    }

    fn encode_to_diffuse(&self, pictures: &Tensor, _: &Tensor) -> Result<Tensor> {
        self.encode(pictures)
    }

    fn decode(&self, latents: &Tensor) -> Result<Tensor> {
        depth_to_space(latents, self.0)
    }
}

/// Pictures are diffused as they are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity;

impl FirstStage for Identity {
    fn factor(&self) -> usize {
        1
    }

    fn latent_channels(&self, channels: usize) -> usize {
        channels
    }

    fn scale(&self) -> f64 {
        1.0
    }

    fn encode(&self, pictures: &Tensor) -> Result<Tensor> {
        Ok(pictures.clone())
    }

    fn encode_to_diffuse(&self, pictures: &Tensor, _: &Tensor) -> Result<Tensor> {
        Ok(pictures.clone())
    }

    fn decode(&self, latents: &Tensor) -> Result<Tensor> {
        Ok(latents.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::noise::Noise;
    use candle_core::Device;

    #[test]
    fn exact_stages_go_there_and_back() {
        let pictures = Noise::new(1, "pictures", 0).normal_tensor((2, 3, 8, 4), &Device::Cpu).unwrap();
        let stages: [&dyn FirstStage; 2] = [&SpaceToDepth(2), &Identity];
        for stage in stages {
            let latents = stage.encode(&pictures).unwrap();
            assert_eq!(latents.dims(), [2, stage.latent_channels(3), 8 / stage.factor(), 4 / stage.factor()]);
            let drawn = stage.encode_to_diffuse(&pictures, &latents).unwrap();
            let back = stage.decode(&drawn).unwrap();
            let worst = (back - &pictures).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
            assert_eq!((worst, stage.scale()), (0.0, 1.0));
        }
        assert!(SpaceToDepth(3).encode(&pictures).is_err());
    }
}
