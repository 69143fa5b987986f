//! Which instruction set a run asks for: a word in the configuration and on the command line.
use diamond_simd::{InstructionSet, InstructionSetError};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// `auto` or the name of an instruction set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum InstructionChoice {
    /// What the environment variable `DIAMOND_INSTRUCTION_SET` says, else the fastest.
    #[default]
    Auto,
    /// This one, or an error where the machine lacks it.
    Fixed(InstructionSet),
}

impl InstructionChoice {
    /// Decides for the whole process, before its first computation; returns what is used.
    ///
    /// Errors: the machine does not have it, the process uses another one already, the environment variable is wrong.
    pub fn apply(self) -> Result<InstructionSet, InstructionSetError> {
        match self {
            Self::Fixed(set) => diamond_simd::fix(set)?,
            Self::Auto => drop(diamond_simd::from_environment()?),
        }
        Ok(diamond_simd::current())
    }
}

impl fmt::Display for InstructionChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Fixed(set) => set.fmt(f),
        }
    }
}

impl FromStr for InstructionChoice {
    type Err = InstructionSetError;

    fn from_str(name: &str) -> Result<Self, InstructionSetError> {
        if name == "auto" { Ok(Self::Auto) } else { name.parse().map(Self::Fixed) }
    }
}

impl TryFrom<String> for InstructionChoice {
    type Error = InstructionSetError;

    fn try_from(name: String) -> Result<Self, InstructionSetError> {
        name.parse()
    }
}

impl From<InstructionChoice> for String {
    fn from(choice: InstructionChoice) -> String {
        choice.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_read_back_and_mistakes_named() {
        for word in ["auto", "portable", "avx2", "avx512", "neon"] {
            assert_eq!(word.parse::<InstructionChoice>().map(String::from), Ok(word.to_owned()));
        }
        let text = crate::Config::parse("instruction_set = \"mmx\"", "mine.toml").unwrap_err().to_string();
        assert!(text.contains("mine.toml") && text.contains("`mmx`") && text.contains("portable"), "{text}");
        let config = crate::Config::parse("instruction_set = \"portable\"", "mine.toml").unwrap();
        assert_eq!(config.instruction_set, InstructionChoice::Fixed(InstructionSet::Portable));
    }
}
