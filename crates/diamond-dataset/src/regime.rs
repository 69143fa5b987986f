//! How sparse a reconstruction's input is: regimes, by name.
use crate::{Capture, DatasetError, Selection};
use std::str::FromStr;

/// How many views and lights of a capture are learned from.
///
/// As written: one of the names in [`Regime::PAPER`], or `v<views>-l<lights>` with per cents (`v10-l3`, `v2.5-full`,
/// `full-l5`), or counts (`3x4` is three views with four lights each).
///
/// ```
/// use diamond_dataset::{Regime, Selection};
/// let regime: Regime = "v3-l3".parse()?;
/// assert_eq!((regime.views, regime.lights), (Selection::percent(3.0), Selection::percent(3.0)));
/// assert_eq!("full-one".parse::<Regime>()?.lights, Selection::PerView(1));
/// assert_eq!("3x4".parse::<Regime>()?.lights, Selection::Count(4));
/// # Ok::<(), diamond_dataset::DatasetError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Regime {
    /// Its name.
    pub name: String,
    /// Which views.
    pub views: Selection,
    /// Which lights.
    pub lights: Selection,
}

impl Regime {
    /// The regimes of the DIAMOND-SSS paper, from dense to sparse.
    pub const PAPER: [&str; 6] = ["full-full", "full-one", "v5-full", "v3-full", "v5-l5", "v3-l3"];

    /// The part of a capture that this regime leaves to learn from; held-out images stay. See
    /// [`Capture::select_seeded`].
    pub fn apply(&self, capture: &Capture, seed: u64) -> Result<Capture, DatasetError> {
        capture.select_seeded(&self.views, &self.lights, seed)
    }
}

impl FromStr for Regime {
    type Err = DatasetError;

    fn from_str(text: &str) -> Result<Self, DatasetError> {
        let name = text.trim();
        let bad = || DatasetError::Selection {
            what: "regime",
            reason: format!(
                "\"{name:.40}\" is none; write one of {}, other per cents (v10-l3), or counts (3x4)",
                Self::PAPER.join(", ")
            ),
        };
        let share = |part: &str, letter: char| -> Option<Selection> {
            match part {
                "full" => Some(Selection::All),
                "one" => Some(if letter == 'l' { Selection::PerView(1) } else { Selection::Count(1) }),
                _ => format!("{}%", part.strip_prefix(letter)?).parse().ok(),
            }
        };
        let chosen = match (name.split_once('x'), name.split_once('-')) {
            (Some((v, l)), _) => (v.parse::<usize>().ok())
                .zip(l.parse::<usize>().ok())
                .filter(|(v, l)| *v > 0 && *l > 0)
                .map(|(v, l)| (Selection::Count(v), Selection::Count(l))),
            (_, Some((v, l))) => share(v, 'v').zip(share(l, 'l')),
            _ => None,
        };
        let (views, lights) = chosen.ok_or_else(bad)?;
        Ok(Self { name: name.to_owned(), views, lights })
    }
}

impl std::fmt::Display for Regime {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read() {
        let parse = |s: &str| s.parse::<Regime>().unwrap();
        for name in Regime::PAPER {
            assert_eq!(parse(name).to_string(), name);
        }
        assert_eq!((parse("full-full").views, parse("full-full").lights), (Selection::All, Selection::All));
        assert_eq!((parse("v5-full").views, parse("v5-full").lights), (Selection::Share(50), Selection::All));
        assert_eq!((parse("v2.5-l10").views, parse("v2.5-l10").lights), (Selection::Share(25), Selection::Share(100)));
        assert_eq!((parse("one-l3").views, parse("12x1").lights), (Selection::Count(1), Selection::Count(1)));
        for bad in ["", "full", "v3", "v3-v3", "l3-v3", "v0-l3", "0x3", "3x", "vx-l3", "v3-l3-l3", "v-1-l3"] {
            let error = bad.parse::<Regime>().unwrap_err().to_string();
            assert!(error.contains("full-one"), "{bad}: {error}");
        }
    }
}
