//! LPIPS: how different two pictures look, by the activations of a classifier.
//!
//! Both pictures go through a classifier; at five taps the activations of each pixel are scaled to unit length, squared
//! differences are weighed per channel by a learned head, averaged over pixels, and summed.
//!
//! Invariant: the weights are the user's. None are contained, fetched or guessed; without a file there is no number, and
//! [`Lpips::from_environment`] says so.
//!
//! One safetensors file per classifier holds `features.N.weight` and `features.N.bias` with torchvision's numbers, and `lin0.weight` to
//! `lin4.weight` (1, channels, 1, 1). In Python, from torchvision's and LPIPS's own files (not run or shipped here):
//!
//! ```text
//! keep = {k: v for k, v in torchvision.models.vgg16(weights="IMAGENET1K_V1").state_dict().items() if k.startswith("features.")}
//! keep |= {k.replace(".model.1", ""): v for k, v in torch.load("lpips/weights/v0.1/vgg.pth").items()}
//! safetensors.torch.save_file(keep, "lpips-vgg.safetensors")
//! ```
//!
//! `diamond models check` says whether a file fits, `diamond models convert` renames.
//!
//! ```no_run
//! use diamond_lpips::{Lpips, Network};
//! # let (a, b) = (diamond_image::Image::new(64, 64, 3), diamond_image::Image::new(64, 64, 3));
//! match Lpips::from_environment(Network::Vgg)? {
//!     Ok(lpips) => println!("LPIPS {:.4}", lpips.value(&a, &b)?),
//!     Err(absent) => println!("LPIPS absent: {absent}"),
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
mod distance;
mod network;

pub use distance::Lpips;
pub use network::Network;
