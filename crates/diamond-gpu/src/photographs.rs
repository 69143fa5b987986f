//! Photographs on the device: sent there once, as far as there is room for them.
use crate::workspace::kept_array;
use crate::{Device, GpuError};
use diamond_image::{Image, Transfer};
use diamond_losses::encode_image;
use diamond_reconstruct::StepImage;
use std::collections::BTreeMap;

/// Bytes of photographs that stay on a device; beyond, all are sent anew.
const KEPT_BYTES: u64 = 1 << 30;

/// A photograph.
#[derive(Debug)]
pub(crate) struct Photograph {
    /// By pixel: RGB in the space in which it is compared, and how much of it is believed where that is known.
    pub encoded: wgpu::Buffer,
    /// By pixel: linear RGB, and the mask.
    pub pixels: wgpu::Buffer,
}

/// Photographs by their number among all images.
#[derive(Debug, Default)]
pub(crate) struct Photographs {
    kept: BTreeMap<usize, Photograph>,
    bytes: u64,
    /// Space in which they are compared.
    space: Option<Transfer>,
}

impl Photographs {
    /// Sends an image unless it is there.
    pub fn keep(&mut self, device: &Device, image: &StepImage<'_>, space: Transfer) -> Result<(), GpuError> {
        if self.space != Some(space) {
            (self.kept, self.bytes, self.space) = (BTreeMap::new(), 0, Some(space));
        }
        let pair = image.pair;
        // Pictures that nobody took have no number.
        if pair.image != usize::MAX && self.kept.contains_key(&pair.image) {
            return Ok(());
        }
        let pixels = pair.radiance.pixels() as u64;
        let bytes = pixels * 4 * 7;
        if self.bytes + bytes > KEPT_BYTES {
            (self.kept, self.bytes) = (BTreeMap::new(), 0);
        }
        let encoded = encode_image(space, pair.radiance);
        let encoded = match pair.believed {
            Some(believed) => send(device, &with_fourth(&encoded, Some(believed.data())))?,
            None => send(device, encoded.data())?,
        };
        let pixels = send(device, &with_fourth(pair.radiance, pair.mask.map(|m| m.data())))?;
        if self.kept.insert(pair.image, Photograph { encoded, pixels }).is_none() {
            self.bytes += bytes;
        }
        Ok(())
    }

    /// One that was kept.
    pub fn of(&self, image: &StepImage<'_>) -> Result<&Photograph, GpuError> {
        self.kept.get(&image.pair.image).ok_or_else(|| GpuError::Kernel {
            kernel: "photograph".into(),
            problem: "it was not sent before it was used".into(),
        })
    }
}

fn send(device: &Device, values: &[f32]) -> Result<wgpu::Buffer, GpuError> {
    let buffer = kept_array(device, "photograph", (values.len() as u64).max(4))?;
    device.queue.write_buffer(&buffer, 0, bytemuck::cast_slice(values));
    Ok(buffer)
}

/// RGB with a fourth number per pixel, 1 where there is none.
fn with_fourth(rgb: &Image, fourth: Option<&[f32]>) -> Vec<f32> {
    let mut out = Vec::with_capacity(4 * rgb.pixels());
    for (i, rgb) in rgb.data().chunks_exact(3).enumerate() {
        out.extend_from_slice(rgb);
        out.push(fourth.map_or(1.0, |fourth| fourth[i]));
    }
    out
}
