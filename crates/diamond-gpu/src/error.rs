//! What can go wrong on a device: one enum that says what was expected, what was found, and what to do.
use diamond_losses::LossError;
use diamond_shading::ShadingError;
use diamond_splat::SplatError;

/// Errors of `diamond-gpu`.
#[derive(Debug, Clone, PartialEq)]
pub enum GpuError {
    /// No device was found.
    NoAdapter,
    /// A device was asked for by a number that there is not.
    AdapterIndex {
        /// The number that was asked for.
        index: usize,
        /// Names of the devices that there are.
        found: Vec<String>,
    },
    /// A choice of device that is none of `auto`, `cpu`, `gpu`, `gpu:N`.
    Choice {
        /// What was written.
        found: String,
    },
    /// A device was found but cannot be used.
    Open {
        /// Its name.
        device: String,
        /// What its driver said.
        problem: String,
    },
    /// The device went away: reset by its driver, unplugged, or taken by something else.
    Lost {
        /// Its name.
        device: String,
        /// What its driver said.
        problem: String,
    },
    /// The device has no room for an array.
    OutOfMemory {
        /// Which array.
        what: &'static str,
        /// Its size, bytes.
        bytes: u64,
    },
    /// An array is larger than what the device can hand to a kernel.
    Limit {
        /// Which array.
        what: &'static str,
        /// Its size, bytes.
        needed: u64,
        /// The largest that is possible, bytes.
        limit: u64,
    },
    /// A kernel was refused, which is a mistake in this program or in the driver.
    Kernel {
        /// Module and entry point.
        kernel: String,
        /// What the compiler said.
        problem: String,
    },
    /// Something is asked for that only the CPU does.
    Unsupported {
        /// What it is.
        what: &'static str,
        /// What to do instead.
        instead: &'static str,
    },
    /// Gaussians, features, camera or settings are refused.
    Splat(SplatError),
    /// A network, a G-buffer or settings of shading are refused.
    Shading(ShadingError),
    /// Pictures or options of a loss are refused.
    Loss(LossError),
}

impl std::fmt::Display for GpuError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            GpuError::NoAdapter => write!(
                f,
                "expected a GPU with a Vulkan, Metal or Direct3D 12 driver, found none; install the driver (on Linux also libvulkan1; \
                 mesa-vulkan-drivers has one that runs on the CPU), or use --device cpu"
            ),
            GpuError::AdapterIndex { index, found } => write!(
                f,
                "device gpu:{index}: expected a number below {}, the devices are {}; `diamond devices` lists them, and --device cpu needs none",
                found.len(),
                found.iter().enumerate().map(|(i, name)| format!("gpu:{i} ({name})")).collect::<Vec<_>>().join(", ")
            ),
            GpuError::Choice { found } => {
                write!(f, "device: expected auto, cpu, gpu or gpu:N, found {found:?}; `diamond devices` lists them")
            }
            GpuError::Open { device, problem } => write!(
                f,
                "{device}: expected a device that can be opened, found: {problem}; update its driver, choose another with --device gpu:N, or \
                 use --device cpu"
            ),
            GpuError::Lost { device, problem } => write!(
                f,
                "{device}: expected the device to stay, found it lost: {problem}; run again (a run continues from its checkpoint with \
                 --resume), or use --device cpu"
            ),
            GpuError::OutOfMemory { what, bytes } => write!(
                f,
                "{what}: expected room for {bytes} bytes on the device, found less; use fewer Gaussians or a smaller picture, or --device cpu"
            ),
            GpuError::Limit { what, needed, limit } => write!(
                f,
                "{what}: expected at most {limit} bytes, which is what the device can hand to a kernel, found {needed}; use fewer Gaussians \
                 or a smaller picture, or --device cpu"
            ),
            GpuError::Kernel { kernel, problem } => write!(
                f,
                "kernel {kernel}: expected the driver to accept it, found: {problem}; this is a mistake of this program or of the driver, use \
                 --device cpu"
            ),
            GpuError::Unsupported { what, instead } => {
                write!(f, "{what}: expected something that runs on a GPU, found that it does not; {instead}")
            }
            GpuError::Splat(error) => error.fmt(f),
            GpuError::Shading(error) => error.fmt(f),
            GpuError::Loss(error) => error.fmt(f),
        }
    }
}

impl std::error::Error for GpuError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            GpuError::Splat(error) => Some(error),
            GpuError::Shading(error) => Some(error),
            GpuError::Loss(error) => Some(error),
            _ => None,
        }
    }
}

impl From<SplatError> for GpuError {
    fn from(error: SplatError) -> Self {
        GpuError::Splat(error)
    }
}

impl From<LossError> for GpuError {
    fn from(error: LossError) -> Self {
        GpuError::Loss(error)
    }
}

impl From<ShadingError> for GpuError {
    fn from(error: ShadingError) -> Self {
        GpuError::Shading(error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_say_what_to_do() {
        for (error, words) in [
            (GpuError::NoAdapter, vec!["found none", "--device cpu"]),
            (GpuError::AdapterIndex { index: 3, found: vec!["llvmpipe".into()] }, vec!["gpu:3", "gpu:0 (llvmpipe)"]),
            (GpuError::Choice { found: "tpu".into() }, vec!["\"tpu\"", "gpu:N"]),
            (GpuError::Lost { device: "A".into(), problem: "reset".into() }, vec!["A", "reset", "--resume"]),
            (GpuError::OutOfMemory { what: "splats", bytes: 480 }, vec!["splats", "480"]),
            (GpuError::Limit { what: "rows", needed: 200, limit: 100 }, vec!["rows", "200", "100"]),
        ] {
            let text = error.to_string();
            words.iter().for_each(|word| assert!(text.contains(word), "{text:?} lacks {word:?}"));
        }
    }
}
