//! Whose turn it is: a photograph's, or a picture's that nobody took.
use crate::AugmentationSettings;

/// What a place in the run's sequence of images is, with its number among its kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Turn {
    Photograph(u64),
    Made(u64),
}

/// A rule by which turns alternate evenly, known for each place by itself, so that a resumed run goes on with it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Turns {
    /// First place at which a made picture may come, and the first after the last.
    window: (u64, u64),
    /// Of a million places in the window so many are made pictures'.
    share: u64,
}

const WHOLE: u64 = 1_000_000;

impl Turns {
    /// Of a run of `steps` steps with `accumulate` images each, among which there are so many photographs and made pictures: these have the configured share, but
    /// no picture comes more often than a photograph.
    pub fn new(settings: &AugmentationSettings, steps: u64, accumulate: u32, photographs: usize, made: usize) -> Self {
        let at = |f: f32| (f64::from(f) * steps as f64).round() as u64 * u64::from(accumulate);
        let even = made as f64 / (photographs + made).max(1) as f64;
        let share = (f64::from(settings.share).min(even) * WHOLE as f64).round() as u64;
        let first = at(settings.from).next_multiple_of(2);
        Self { window: (first, at(settings.until).max(first)), share: share.min(WHOLE) }
    }

    /// Whether `position` is not before the first place at which a made picture may come.
    pub fn begun(&self, position: u64) -> bool {
        position >= self.window.0
    }

    /// Places of made pictures before `position`. The first place of the window is one and even, so that with a share of a half those at which
    /// views are compared (every so many steps, an even number) stay photographs'.
    fn made_before(&self, position: u64) -> u64 {
        let inside = position.clamp(self.window.0, self.window.1) - self.window.0;
        (u128::from(inside) * u128::from(self.share)).div_ceil(u128::from(WHOLE)) as u64
    }

    /// Whose turn it is at `position` = step × accumulate + index in the batch.
    pub fn at(&self, position: u64) -> Turn {
        let (before, after) = (self.made_before(position), self.made_before(position + 1));
        if after > before { Turn::Made(before) } else { Turn::Photograph(position - before) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Photographs keep the places at which views are compared.
    #[test]
    fn every_other_place_is_a_photographs() {
        let turns = Turns::new(&AugmentationSettings { share: 0.5, ..Default::default() }, 100, 1, 9, 90);
        let compared = (0..100).filter(|step| (step + 1) % 4 == 0);
        assert!(
            compared.clone().count() == 25 && compared.into_iter().all(|p| matches!(turns.at(p), Turn::Photograph(_)))
        );
        assert_eq!((0..100).filter(|p| matches!(turns.at(*p), Turn::Made(_))).count(), 50);
    }

    #[test]
    fn every_number_comes_once_and_the_share_is_kept() {
        let settings = AugmentationSettings { from: 0.1, until: 0.6, share: 0.3, ..Default::default() };
        let turns = Turns::new(&settings, 100, 2, 5, 5);
        assert!(!turns.begun(19) && turns.begun(20));
        let (mut photographs, mut made) = (Vec::new(), Vec::new());
        for position in 0..200 {
            match turns.at(position) {
                Turn::Photograph(n) => photographs.push(n),
                Turn::Made(n) => {
                    assert!((20..120).contains(&position));
                    made.push(n);
                }
            }
        }
        assert_eq!(photographs, (0..170).collect::<Vec<u64>>());
        assert_eq!(made, (0..30).collect::<Vec<u64>>());
        let none = Turns::new(&settings, 100, 2, 5, 0);
        assert!((0..200).all(|p| none.at(p) == Turn::Photograph(p)));
        // One picture beside 19 photographs: a twentieth of the hundred places in the window.
        let few = Turns::new(&settings, 100, 2, 19, 1);
        assert_eq!((0..200).filter(|p| matches!(few.at(*p), Turn::Made(_))).count(), 5);
    }
}
