//! Choosing a few views and lights of a capture, evenly and reproducibly.
use crate::scene::light_direction;
use crate::{Capture, DatasetError, Shot, Split, View};
use diamond_light::OlatLight;
use glam::Vec3;
use std::collections::BTreeMap;
use std::str::FromStr;

/// Which views, or which lights, to keep.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Selection {
    /// All of them.
    #[default]
    All,
    /// So many, spread evenly over directions; all where there are fewer.
    Count(usize),
    /// This share of them in thousandths, rounded, at least one; spread evenly over directions.
    Share(u32),
    /// Of lights only: so many for each view, others from view to view, so that all views together cover the directions
    /// evenly.
    PerView(usize),
    /// These, by index from 0; ascending, no duplicates.
    List(Vec<usize>),
}

impl Selection {
    /// So many per cent, to a tenth.
    pub fn percent(percent: f32) -> Self {
        Selection::Share((10.0 * percent).round().clamp(0.0, 1000.0) as u32)
    }

    /// How many of `all` a count or a share is; `None` for what is no number.
    fn count_of(&self, all: usize) -> Option<usize> {
        match self {
            Selection::Count(n) => Some(*n),
            Selection::Share(0) => Some(0),
            Selection::Share(thousandths) => Some(((all * *thousandths as usize + 500) / 1000).clamp(1, all.max(1))),
            Selection::All | Selection::PerView(_) | Selection::List(_) => None,
        }
    }
}

/// Indices above this are refused: no capture has so many views or lights.
const MAX_INDEX: usize = 1_000_000;

/// Characters of a selection that a message repeats.
const MAX_QUOTED: usize = 80;

/// As written on a command line: `all`; a count, `3`; a share, `5%`; so many lights per view, `1/view`; indices, `0,5,7`,
/// ranges included, `0-7` or `0-3,9`; one index alone with a comma, `2,`.
impl FromStr for Selection {
    type Err = DatasetError;

    fn from_str(text: &str) -> Result<Self, DatasetError> {
        let quoted: String = text.chars().take(MAX_QUOTED).collect();
        let bad = |reason: String| DatasetError::Selection {
            what: "selection",
            reason: format!(
                "\"{quoted}\": {reason}; write a count (3), a share (5%), lights per view (1/view), indices (0,5,7 or 2,), ranges (0-7), or all"
            ),
        };
        let number = |part: &str| -> Result<usize, DatasetError> {
            let value =
                part.trim().parse::<usize>().map_err(|_| bad(format!("\"{:.40}\" is no whole number", part.trim())))?;
            if value > MAX_INDEX { Err(bad(format!("{value} is larger than {MAX_INDEX}"))) } else { Ok(value) }
        };
        let trimmed = text.trim();
        if trimmed.eq_ignore_ascii_case("all") {
            return Ok(Selection::All);
        }
        if let Some(percent) = trimmed.strip_suffix('%') {
            return match percent.trim().parse::<f32>() {
                Ok(p) if p > 0.0 && p <= 100.0 && Selection::percent(p) != Selection::Share(0) => Ok(Self::percent(p)),
                _ => Err(bad("a share lies from 0.1 to 100 %".into())),
            };
        }
        if let Some(count) = trimmed.strip_suffix("/view") {
            return match number(count)? {
                0 => Err(bad("0 lights per view select nothing".into())),
                n => Ok(Selection::PerView(n)),
            };
        }
        if !trimmed.contains([',', '-']) {
            return match number(trimmed)? {
                0 => Err(bad("a count of 0 selects nothing".into())),
                n => Ok(Selection::Count(n)),
            };
        }
        let mut list = Vec::new();
        for part in trimmed.split(',').filter(|part| !part.trim().is_empty()) {
            match part.split_once('-') {
                Some((a, b)) => {
                    let (a, b) = (number(a)?, number(b)?);
                    if a > b {
                        return Err(bad(format!("the range {a}-{b} runs backwards")));
                    }
                    list.extend(a..=b);
                    // Ranges that overlap many times take no more memory than one.
                    if list.len() > 2 * MAX_INDEX {
                        list.sort_unstable();
                        list.dedup();
                    }
                }
                None => list.push(number(part)?),
            }
        }
        if list.is_empty() {
            return Err(bad("no index".into()));
        }
        list.sort_unstable();
        list.dedup();
        Ok(Selection::List(list))
    }
}

impl std::fmt::Display for Selection {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Selection::All => write!(f, "all"),
            Selection::Count(n) => write!(f, "{n}"),
            Selection::Share(thousandths) => write!(f, "{}%", f64::from(*thousandths) / 10.0),
            Selection::PerView(n) => write!(f, "{n}/view"),
            Selection::List(list) => {
                let text: Vec<String> = list.iter().map(usize::to_string).collect();
                write!(f, "{}{}", text.join(","), if list.len() == 1 { "," } else { "" })
            }
        }
    }
}

/// Indices of `count` directions spread by farthest-point selection, ascending: the first is the one nearest to the mean
/// direction (index 0 where the mean vanishes), each next is the one farthest from those chosen; the lower index wins a
/// tie. All indices where `count` is no less than their number.
pub fn farthest_points(directions: &[Vec3], count: usize) -> Vec<usize> {
    let mean = directions.iter().sum::<Vec3>() / directions.len().max(1) as f32;
    // A mean this short says nothing: the directions surround the object.
    let first = match mean.length() > 1e-3 {
        true => first_largest(directions.iter().map(|d| d.dot(mean))),
        false => 0,
    };
    farthest_points_from(directions, count, first)
}

/// [`farthest_points`] for a seed: 0 begins as they do, any other seed with an index drawn from it.
pub fn farthest_points_seeded(directions: &[Vec3], count: usize, seed: u64) -> Vec<usize> {
    match seed {
        0 => farthest_points(directions, count),
        _ => farthest_points_from(directions, count, Draw(seed).below(directions.len().max(1))),
    }
}

/// [`farthest_points`] that begin with the index `first`.
fn farthest_points_from(directions: &[Vec3], count: usize, first: usize) -> Vec<usize> {
    if count >= directions.len() {
        return (0..directions.len()).collect();
    }
    let mut chosen = Vec::with_capacity(count);
    let mut nearest = vec![f32::INFINITY; directions.len()];
    let mut next = first;
    while chosen.len() < count {
        chosen.push(next);
        for (gap, d) in nearest.iter_mut().zip(directions) {
            *gap = gap.min(d.distance_squared(directions[next]));
        }
        for &i in &chosen {
            nearest[i] = -1.0;
        }
        next = first_largest(nearest.iter().copied());
    }
    chosen.sort_unstable();
    chosen
}

/// Random numbers of a seed: SplitMix64 (Steele, Lea and Flood 2014).
pub(crate) struct Draw(pub u64);

impl Draw {
    /// The next index below `count` (at least 1).
    pub(crate) fn below(&mut self, count: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        // The high half of a product: a remainder would prefer small numbers.
        ((u128::from(z ^ (z >> 31)) * count as u128) >> 64) as usize
    }
}

/// Index of the first largest value; 0 for none.
fn first_largest(values: impl Iterator<Item = f32>) -> usize {
    let mut best = (0, f32::NEG_INFINITY);
    for (i, v) in values.enumerate() {
        if v > best.1 {
            best = (i, v);
        }
    }
    best.0
}

impl Capture {
    /// [`Capture::select_seeded`] with seed 0.
    pub fn select(&self, views: &Selection, lights: &Selection) -> Result<Capture, DatasetError> {
        self.select_seeded(views, lights, 0)
    }

    /// The capture with only some of its training views and lights; held-out views stay.
    ///
    /// `views` are indices into [`Capture::train`]; a count or share spreads them over the directions from the centre of the
    /// scene to the cameras.
    ///
    /// `lights`: where the rig is shared (all views together have no more different lights than the fullest view alone),
    /// the lights are listed in the order in which they first appear, a choice among them is made once, and each view
    /// keeps what it has of it. Otherwise, as on a turntable, each view chooses for itself: an index is then the place
    /// in the frame ([`Shot::light_index`]), a count or share spreads over the light directions of that view. A view that
    /// has none of the chosen lights of a shared rig chooses for itself too, so that it is not lost; with a list it is left
    /// out. [`Selection::PerView`] goes through the views in order, and each takes those of its lights that are farthest
    /// from what was taken before, until every direction was taken once; then again.
    ///
    /// The seed decides with which view, and with which light, the spreading begins; 0 is the one nearest to the mean.
    ///
    /// Errors: an index that does not exist, a count of 0, lights per view where views are meant, or a choice that leaves
    /// no image.
    pub fn select_seeded(&self, views: &Selection, lights: &Selection, seed: u64) -> Result<Capture, DatasetError> {
        let centre = self.scene().centre;
        let towards = view_directions(&self.train, centre);
        let kept = choose("views", views, &towards, seed)?;
        let mut train: Vec<View> = kept.into_iter().map(|i| self.train[i].clone()).collect();
        let rig = shared_rig(&self.train);
        match (lights, rig) {
            (Selection::PerView(0), _) => return Err(nothing("lights")),
            (Selection::PerView(n), _) => spread_over_views(&mut train, *n, centre, seed),
            (_, Some(rig)) => {
                let directions: Vec<Vec3> = rig.iter().map(|light| light_direction(light, centre)).collect();
                let chosen: Vec<LightKey> =
                    choose("lights", lights, &directions, seed)?.iter().map(|&i| key(&rig[i])).collect();
                for view in &mut train {
                    let present: Vec<Shot> =
                        view.shots.iter().filter(|shot| chosen.contains(&key(&shot.light))).cloned().collect();
                    match (present.is_empty(), lights.count_of(rig.len())) {
                        (true, Some(n)) => spread_lights(view, n, centre, seed),
                        _ => view.shots = present,
                    }
                }
            }
            (lights, None) => {
                if let Selection::List(list) = lights {
                    let last = self.train.iter().flat_map(|v| &v.shots).map(|shot| shot.light_index).max().unwrap_or(0);
                    in_range("lights", list, last + 1)?;
                }
                for view in &mut train {
                    match (lights, lights.count_of(view.shots.len())) {
                        (_, Some(0)) => return Err(nothing("lights")),
                        (_, Some(n)) => spread_lights(view, n, centre, seed),
                        (Selection::List(list), _) => view.shots.retain(|shot| list.contains(&shot.light_index)),
                        _ => {}
                    }
                }
            }
        }
        train.retain(|view| !view.shots.is_empty());
        if train.is_empty() {
            return Err(nothing("lights"));
        }
        Ok(Capture { train, ..self.clone() })
    }
}

impl Capture {
    /// The lights of a split in the order in which they first appear, if all its views share one rig: together they have
    /// no more different lights than the fullest view alone. `None` on a turntable, and for a split without views.
    pub fn shared_rig(&self, split: Split) -> Option<Vec<OlatLight>> {
        shared_rig(self.views(split)).filter(|rig| !rig.is_empty())
    }

    /// The rig: every light of the training images of the capture as opened, whatever is selected; each position or direction once, in the order in
    /// which they first appear. Held-out images have no say.
    pub fn rig(&self) -> &[OlatLight] {
        &self.shared.rig
    }
}

/// Directions from the centre of the scene to the cameras.
pub(crate) fn view_directions(views: &[View], centre: Vec3) -> Vec<Vec3> {
    views.iter().map(|view| (view.camera.pose.centre() - centre).try_normalize().unwrap_or(Vec3::Z)).collect()
}

fn spread_lights(view: &mut View, count: usize, centre: Vec3, seed: u64) {
    let directions: Vec<Vec3> = view.shots.iter().map(|shot| light_direction(&shot.light, centre)).collect();
    let kept = farthest_points_seeded(&directions, count, seed);
    view.shots = kept.into_iter().map(|i| view.shots[i].clone()).collect();
}

/// Directions whose squared distance is below this are one.
const SAME_DIRECTION: f32 = 1e-10;

/// Leaves each view `count` lights, each the farthest from those that this view and the views before it took; where all of
/// a view's were taken, the round begins anew.
fn spread_over_views(views: &mut [View], count: usize, centre: Vec3, seed: u64) {
    let mut taken: Vec<Vec3> = Vec::new();
    for view in views {
        let directions: Vec<Vec3> = view.shots.iter().map(|shot| light_direction(&shot.light, centre)).collect();
        let mut own: Vec<usize> = Vec::new();
        while own.len() < count.min(directions.len()) {
            let next = if taken.is_empty() {
                farthest_points_seeded(&directions, 1, seed)[0]
            } else {
                let gaps = directions.iter().enumerate().map(|(i, d)| match own.contains(&i) {
                    true => -1.0,
                    false => taken.iter().map(|t| t.distance_squared(*d)).fold(f32::INFINITY, f32::min),
                });
                let gaps: Vec<f32> = gaps.collect();
                let next = first_largest(gaps.iter().copied());
                if gaps[next] < SAME_DIRECTION && taken.len() > own.len() {
                    taken = own.iter().map(|&i| directions[i]).collect();
                    continue;
                }
                next
            };
            taken.push(directions[next]);
            own.push(next);
        }
        own.sort_unstable();
        view.shots = own.into_iter().map(|i| view.shots[i].clone()).collect();
    }
}

fn choose(
    what: &'static str,
    selection: &Selection,
    directions: &[Vec3],
    seed: u64,
) -> Result<Vec<usize>, DatasetError> {
    match (selection, selection.count_of(directions.len())) {
        (_, Some(0)) => Err(nothing(what)),
        (_, Some(n)) => Ok(farthest_points_seeded(directions, n, seed)),
        (Selection::PerView(_), _) => Err(DatasetError::Selection {
            what,
            reason: "so many per view is said of lights; write a count (3) or a share (5%) of views".into(),
        }),
        (Selection::List(list), _) => {
            in_range(what, list, directions.len())?;
            let mut list = list.clone();
            list.sort_unstable();
            list.dedup();
            if list.is_empty() { Err(nothing(what)) } else { Ok(list) }
        }
        _ => Ok((0..directions.len()).collect()),
    }
}

fn in_range(what: &'static str, list: &[usize], count: usize) -> Result<(), DatasetError> {
    match list.iter().find(|&&i| i >= count) {
        Some(i) => Err(DatasetError::Selection {
            what,
            reason: format!(
                "index {i} does not exist, there are {count}: choose from 0 to {}",
                count.saturating_sub(1)
            ),
        }),
        None => Ok(()),
    }
}

pub(crate) fn nothing(what: &'static str) -> DatasetError {
    DatasetError::Selection { what, reason: "the selection leaves no image; choose at least one view and light".into() }
}

/// A light's position or direction, bit by bit; intensity is no part of it.
pub(crate) type LightKey = (bool, [u32; 3]);

pub(crate) fn key(light: &OlatLight) -> LightKey {
    let (point, v) = match *light {
        OlatLight::Point { position, .. } => (true, position),
        OlatLight::Directional { direction, .. } => (false, direction),
    };
    // Adding zero makes -0 and 0 the same.
    (point, v.to_array().map(|x| (x + 0.0).to_bits()))
}

/// The lights of views, each position or direction once, in the order in which they first appear.
pub(crate) fn different_lights(views: &[View]) -> Vec<OlatLight> {
    let mut lights = Vec::new();
    let mut seen = BTreeMap::new();
    for shot in views.iter().flat_map(|view| &view.shots) {
        seen.entry(key(&shot.light)).or_insert_with(|| lights.push(shot.light));
    }
    lights
}

/// See [`Capture::shared_rig`].
pub(crate) fn shared_rig(views: &[View]) -> Option<Vec<OlatLight>> {
    let lights = different_lights(views);
    let fullest = views.iter().map(|view| view.shots.len()).max().unwrap_or(0);
    (lights.len() <= fullest).then_some(lights)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_selection_is_read_as_on_the_command_line() {
        let parse = |s: &str| s.parse::<Selection>().unwrap();
        assert_eq!(parse("3"), Selection::Count(3));
        assert_eq!(parse("all"), Selection::All);
        assert_eq!(parse("0,5,7"), Selection::List(vec![0, 5, 7]));
        assert_eq!(parse("2,"), Selection::List(vec![2]));
        assert_eq!(parse("0-7"), Selection::List((0..8).collect()));
        assert_eq!(parse(" 9, 0-2,1 "), Selection::List(vec![0, 1, 2, 9]));
        assert_eq!((parse("5%"), parse("2.5 %")), (Selection::Share(50), Selection::Share(25)));
        assert_eq!(parse("1/view"), Selection::PerView(1));
        for bad in [
            "0%",
            "101%",
            "-3%",
            "x%",
            "0.01%",
            "nan%",
            "0/view",
            "/view",
            "",
            "0",
            "-1",
            "x",
            ",",
            "7-3",
            "1-",
            "1e3",
            "99999999999",
            "0-4000000000",
        ] {
            let error = bad.parse::<Selection>().unwrap_err().to_string();
            assert!(error.contains("write a count"), "{bad}: {error}");
        }
        for text in ["3", "all", "0,5,7", "2,", "5%", "2.5%", "1/view"] {
            assert_eq!(parse(text).to_string(), text);
        }
    }

    #[test]
    fn shares_are_rounded_and_never_nothing() {
        let of = |percent, all| Selection::percent(percent).count_of(all);
        assert_eq!((of(3.0, 100), of(3.0, 112), of(5.0, 112), of(5.0, 7)), (Some(3), Some(3), Some(6), Some(1)));
        assert_eq!((of(100.0, 7), of(50.0, 1), of(0.0, 9)), (Some(7), Some(1), Some(0)));
        assert_eq!(Selection::All.count_of(5), None);
    }

    #[test]
    fn a_seed_begins_elsewhere_and_spreads_as_well() {
        let ring: Vec<Vec3> = (0..12)
            .map(|i| Vec3::new((i as f32 * 30f32.to_radians()).cos(), (i as f32 * 30f32.to_radians()).sin(), 0.2))
            .collect();
        assert_eq!(farthest_points_seeded(&ring, 4, 0), farthest_points(&ring, 4));
        let mut different = std::collections::BTreeSet::new();
        for seed in 1..9 {
            let four = farthest_points_seeded(&ring, 4, seed);
            assert_eq!(four, farthest_points_seeded(&ring, 4, seed));
            assert!((0..4).all(|i| (four[(i + 1) % 4] + 12 - four[i]) % 12 == 3), "{four:?}");
            different.insert(four);
        }
        assert!(different.len() > 1);
    }

    #[test]
    fn farthest_points_spread() {
        let ring: Vec<Vec3> = (0..12)
            .map(|i| Vec3::new((i as f32 * 30f32.to_radians()).cos(), (i as f32 * 30f32.to_radians()).sin(), 0.2))
            .collect();
        assert_eq!(farthest_points(&ring, 1).len(), 1);
        let four = farthest_points(&ring, 4);
        let gaps: Vec<usize> = (0..4).map(|i| (four[(i + 1) % 4] + 12 - four[i]) % 12).collect();
        assert_eq!(gaps, [3; 4]);
        assert_eq!(farthest_points(&ring, 99).len(), 12);
        assert!(farthest_points(&[], 3).is_empty());
        assert_eq!(farthest_points(&[Vec3::X; 3], 2), [0, 1], "equal directions are still different lights");
    }
}
