//! The two classifiers whose activations are compared, as far as the last tap.

/// Which classifier.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Network {
    /// VGG-16: taps behind the last ReLU of each of its five stages.
    Vgg,
    /// AlexNet: taps behind its five ReLUs.
    Alex,
}

/// A step of a classifier.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Layer {
    /// A convolution with the number that it has in `features`, then ReLU.
    Convolution {
        /// Place in the list of layers, which is a part of the weights' names.
        index: usize,
        /// Channels out.
        channels: usize,
        /// Side of the kernel.
        kernel: usize,
        /// Distance of neighbouring results.
        stride: usize,
        /// Zeros around the picture.
        padding: usize,
    },
    /// The largest value of windows.
    Pool {
        /// Side of the window.
        kernel: usize,
    },
    /// What comes out here is compared.
    Tap,
}

/// Windows are two apart in both classifiers.
pub(crate) const POOL_STRIDE: usize = 2;

const fn plain(index: usize, channels: usize) -> Layer {
    Layer::Convolution { index, channels, kernel: 3, stride: 1, padding: 1 }
}

/// VGG-16 up to ReLU 29.
const VGG: &[Layer] = &[
    plain(0, 64),
    plain(2, 64),
    Layer::Tap,
    Layer::Pool { kernel: 2 },
    plain(5, 128),
    plain(7, 128),
    Layer::Tap,
    Layer::Pool { kernel: 2 },
    plain(10, 256),
    plain(12, 256),
    plain(14, 256),
    Layer::Tap,
    Layer::Pool { kernel: 2 },
    plain(17, 512),
    plain(19, 512),
    plain(21, 512),
    Layer::Tap,
    Layer::Pool { kernel: 2 },
    plain(24, 512),
    plain(26, 512),
    plain(28, 512),
    Layer::Tap,
];

/// AlexNet up to ReLU 11.
const ALEX: &[Layer] = &[
    Layer::Convolution { index: 0, channels: 64, kernel: 11, stride: 4, padding: 2 },
    Layer::Tap,
    Layer::Pool { kernel: 3 },
    Layer::Convolution { index: 3, channels: 192, kernel: 5, stride: 1, padding: 2 },
    Layer::Tap,
    Layer::Pool { kernel: 3 },
    plain(6, 384),
    Layer::Tap,
    plain(8, 256),
    Layer::Tap,
    plain(10, 256),
    Layer::Tap,
];

impl Network {
    pub(crate) fn layers(self) -> &'static [Layer] {
        match self {
            Self::Vgg => VGG,
            Self::Alex => ALEX,
        }
    }

    /// As metrics call it: `vgg` or `alex`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vgg => "vgg",
            Self::Alex => "alex",
        }
    }

    /// The environment variable that may hold the path of its weights.
    pub fn variable(self) -> &'static str {
        match self {
            Self::Vgg => "DIAMOND_LPIPS_VGG",
            Self::Alex => "DIAMOND_LPIPS_ALEX",
        }
    }

    /// The smallest side that a picture may have.
    pub fn smallest_side(self) -> usize {
        match self {
            Self::Vgg => 16,
            Self::Alex => 31,
        }
    }
}
