//! Which instruction sets there are, which the machine has, and the one that this process uses.
use crate::Level;
use std::fmt;
use std::str::FromStr;
use std::sync::OnceLock;

/// Name of the environment variable that chooses where nothing else did.
pub const ENVIRONMENT_VARIABLE: &str = "DIAMOND_INSTRUCTION_SET";

/// An instruction set that kernels are compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum InstructionSet {
    /// 16 lanes, x86-64-v4.
    Avx512,
    /// 8 lanes with fused multiply-add, x86-64-v3.
    Avx2Fma,
    /// 4 lanes with fused multiply-add, AArch64.
    Neon,
    /// What every machine has, without fused multiply-add; the same bits everywhere.
    Portable,
}

impl InstructionSet {
    /// All, the widest first.
    pub const ALL: [InstructionSet; 4] =
        [InstructionSet::Avx512, InstructionSet::Avx2Fma, InstructionSet::Neon, InstructionSet::Portable];

    /// Name in settings.
    pub fn name(self) -> &'static str {
        match self {
            InstructionSet::Avx512 => "avx512",
            InstructionSet::Avx2Fma => "avx2",
            InstructionSet::Neon => "neon",
            InstructionSet::Portable => "portable",
        }
    }

    /// Whether this machine has it.
    pub fn is_available(self) -> bool {
        Level::of(self).is_ok()
    }

    /// Those that this machine has, the fastest first; the last is [`InstructionSet::Portable`].
    pub fn available() -> Vec<InstructionSet> {
        Self::ALL.into_iter().filter(|set| set.is_available()).collect()
    }

    /// The fastest that this machine has.
    pub fn best() -> InstructionSet {
        Self::ALL.into_iter().find(|set| set.is_available()).unwrap_or(InstructionSet::Portable)
    }
}

impl fmt::Display for InstructionSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for InstructionSet {
    type Err = InstructionSetError;

    /// One of `avx512`, `avx2`, `neon`, `portable`.
    fn from_str(name: &str) -> Result<Self, InstructionSetError> {
        let unknown = || InstructionSetError::Unknown { name: name.to_owned() };
        Self::ALL.into_iter().find(|set| set.name() == name).ok_or_else(unknown)
    }
}

/// Why an instruction set cannot be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum InstructionSetError {
    /// No instruction set has this name.
    Unknown {
        /// What was given.
        name: String,
    },
    /// The machine does not have it.
    Unavailable {
        /// What was asked for.
        wanted: InstructionSet,
    },
    /// The process has computed with, or was fixed to, another one.
    Decided {
        /// What was asked for.
        wanted: InstructionSet,
        /// What is in use.
        current: InstructionSet,
    },
}

impl fmt::Display for InstructionSetError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unknown { name } => {
                write!(f, "`{name}` is no instruction set; expected auto, portable, avx2, avx512 or neon")
            }
            Self::Unavailable { wanted } => {
                let names: Vec<_> = InstructionSet::available().into_iter().map(InstructionSet::name).collect();
                write!(
                    f,
                    "this machine has no {wanted}; it has {} (use `auto` for the fastest, `portable` for the same bits \
                     on every machine)",
                    names.join(", ")
                )
            }
            Self::Decided { wanted, current } => write!(
                f,
                "the instruction set is already {current} and cannot become {wanted}: choose before the first \
                 computation, and once"
            ),
        }
    }
}

impl std::error::Error for InstructionSetError {}

static CHOICE: OnceLock<InstructionSet> = OnceLock::new();

/// What the environment variable [`ENVIRONMENT_VARIABLE`] asks for; `None` if it is unset, empty or `auto`.
///
/// Errors: no such name, or not on this machine.
pub fn from_environment() -> Result<Option<InstructionSet>, InstructionSetError> {
    match std::env::var(ENVIRONMENT_VARIABLE) {
        Ok(name) if !name.is_empty() && name != "auto" => {
            let set: InstructionSet = name.parse()?;
            Level::of(set)?;
            Ok(Some(set))
        }
        _ => Ok(None),
    }
}

/// Fixes the instruction set of all kernels of this process. May be called again with the same one.
///
/// Errors: the machine does not have it, or another one is in use.
pub fn fix(set: InstructionSet) -> Result<(), InstructionSetError> {
    Level::of(set)?;
    let current = *CHOICE.get_or_init(|| set);
    if current == set { Ok(()) } else { Err(InstructionSetError::Decided { wanted: set, current }) }
}

/// The instruction set of this process: what [`fix`] said; else what the environment says; else the fastest. The first call
/// decides. A variable that names nothing usable counts as unset here; [`from_environment`] says what is wrong with it.
pub fn current() -> InstructionSet {
    *CHOICE.get_or_init(|| from_environment().ok().flatten().unwrap_or_else(InstructionSet::best))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_back_and_others_refused() {
        for set in InstructionSet::ALL {
            assert_eq!(set.to_string().parse::<InstructionSet>(), Ok(set));
        }
        let text = "sse9".parse::<InstructionSet>().unwrap_err().to_string();
        assert!(text.contains("`sse9`") && text.contains("avx512") && text.contains("auto"), "{text}");
    }

    #[test]
    fn the_choice_is_made_once_and_only_among_what_there_is() {
        let available = InstructionSet::available();
        assert_eq!(
            (available.first(), available.last()),
            (Some(&InstructionSet::best()), Some(&InstructionSet::Portable))
        );
        for set in InstructionSet::ALL.into_iter().filter(|set| !available.contains(set)) {
            let text = fix(set).unwrap_err().to_string();
            assert!(text.contains(set.name()) && text.contains("portable"), "{text}");
        }
        let now = current();
        assert_eq!(fix(now), Ok(()));
        for set in available.into_iter().filter(|set| *set != now) {
            let text = fix(set).unwrap_err().to_string();
            assert!(text.contains(&format!("already {now}")), "{text}");
        }
    }
}
