//! An instruction set that has been found on this machine, ready to run kernels.
use crate::instruction_set::{InstructionSet, InstructionSetError, current};
use pulp::{Simd, WithSimd};

#[derive(Debug, Clone, Copy)]
pub(crate) enum Kind {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2Fma(pulp::x86::V3),
    #[cfg(target_arch = "x86_64")]
    Avx512(pulp::x86::V4),
    #[cfg(target_arch = "aarch64")]
    Neon(pulp::aarch64::Neon),
    #[cfg(any(test, feature = "emulated"))]
    Four,
    #[cfg(any(test, feature = "emulated"))]
    Eight,
    #[cfg(any(test, feature = "emulated"))]
    Sixteen,
}

/// The instructions that a kernel is run with.
#[derive(Debug, Clone, Copy)]
pub struct Level(Kind);

impl Level {
    /// One lane without fused multiply-add: [`InstructionSet::Portable`].
    pub const PORTABLE: Level = Level(Kind::Portable);

    /// Four, eight and sixteen lanes with fused multiply-add and without vector instructions: slow, and the same bits as
    /// NEON, AVX2 and AVX-512. For tests.
    #[cfg(any(test, feature = "emulated"))]
    pub const EMULATED: [Level; 3] = [Level(Kind::Four), Level(Kind::Eight), Level(Kind::Sixteen)];

    /// The process's choice: [`current`].
    pub fn current() -> Self {
        Self::of(current()).unwrap_or(Self::PORTABLE)
    }

    /// An instruction set. Errors: the machine does not have it.
    pub fn of(set: InstructionSet) -> Result<Self, InstructionSetError> {
        let found = match set {
            InstructionSet::Portable => Some(Kind::Portable),
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2Fma => pulp::x86::V3::try_new().map(Kind::Avx2Fma),
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512 => pulp::x86::V4::try_new().map(Kind::Avx512),
            #[cfg(target_arch = "aarch64")]
            InstructionSet::Neon => pulp::aarch64::Neon::try_new().map(Kind::Neon),
            _ => None,
        };
        found.map(Level).ok_or(InstructionSetError::Unavailable { wanted: set })
    }

    /// Every level that can be tested here: what the machine has and, with the feature `emulated`, the other widths.
    pub fn testable() -> Vec<Level> {
        let mut levels: Vec<Level> =
            InstructionSet::available().into_iter().filter_map(|set| Level::of(set).ok()).collect();
        #[cfg(any(test, feature = "emulated"))]
        levels.extend(Self::EMULATED);
        levels.shrink_to_fit();
        levels
    }

    #[inline]
    pub(crate) fn kind(self) -> Kind {
        self.0
    }

    /// Runs a kernel.
    #[inline]
    pub fn dispatch<Op: WithSimd>(self, op: Op) -> Op::Output {
        match self.0 {
            Kind::Portable => op.with_simd(pulp::Scalar::new()),
            #[cfg(target_arch = "x86_64")]
            Kind::Avx2Fma(simd) => Simd::vectorize(simd, op),
            #[cfg(target_arch = "x86_64")]
            Kind::Avx512(simd) => Simd::vectorize(simd, op),
            #[cfg(target_arch = "aarch64")]
            Kind::Neon(simd) => Simd::vectorize(simd, op),
            #[cfg(any(test, feature = "emulated"))]
            Kind::Four => op.with_simd(pulp::Scalar128b),
            #[cfg(any(test, feature = "emulated"))]
            Kind::Eight => op.with_simd(pulp::Scalar256b),
            #[cfg(any(test, feature = "emulated"))]
            Kind::Sixteen => op.with_simd(pulp::Scalar512b),
        }
    }

    /// Lanes of a vector.
    pub fn width(self) -> usize {
        struct Width;
        impl WithSimd for Width {
            type Output = usize;
            #[inline(always)]
            fn with_simd<S: Simd>(self, _: S) -> usize {
                S::F32_LANES
            }
        }
        self.dispatch(Width)
    }

    /// Whether a multiplication and an addition are fused, which decides the bits.
    pub fn is_fused(self) -> bool {
        !matches!(self.0, Kind::Portable)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn widths_are_those_of_the_instruction_sets() {
        for (set, width) in [
            (InstructionSet::Avx512, 16),
            (InstructionSet::Avx2Fma, 8),
            (InstructionSet::Neon, 4),
            (InstructionSet::Portable, 1),
        ] {
            if let Ok(level) = Level::of(set) {
                assert_eq!(level.width(), width, "{set}");
            }
        }
        assert_eq!(Level::EMULATED.map(Level::width), [4, 8, 16]);
    }
}
