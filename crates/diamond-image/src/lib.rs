//! Row-major `f32` images and masks, bilinear sampling with its pullback, colour transfer, area resizing, luminance.
//!
//! Invariant: nothing here knows of files, cameras or lights, and nothing outside the standard library is used.
//!
//! Pixel centres lie at `+0.5`: the pixel in column `x`, row `y` covers `[x, x+1) × [y, y+1)`; row 0 is at the top.
//! Values are interleaved: element `(x, y, c)` lies at `(y·width + x)·channels + c`. Colour is linear radiance unless a
//! [`Transfer`] says otherwise; where there is alpha, colour is premultiplied by it.
//!
//! ```
//! use diamond_image::Image;
//! let mut image = Image::new(4, 2, 3);
//! image.pixel_mut(1, 0)[2] = 0.5;
//! assert_eq!(image.pixel(1, 0), &[0.0, 0.0, 0.5]);
//! ```
mod bilinear;
mod image;
mod luminance;
mod mask;
mod morphology;
mod outline_distance;
mod remap;
mod resize;
mod transfer;

pub use bilinear::Tap;
pub use image::{Image, ImageError};
pub use luminance::{REC709_LUMINANCE, luminance, luminance_pull};
pub use mask::Mask;
pub use transfer::Transfer;
