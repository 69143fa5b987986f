//! Holding images out of training, so that what is measured on them was never learned from.
use crate::scene::light_direction;
use crate::select::{Draw, LightKey, farthest_points_seeded, key, shared_rig, view_directions};
use crate::{Capture, DatasetError, Shot, Split, View};
use glam::Vec3;
use std::collections::BTreeSet;

/// What is held out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HoldOut {
    /// (view, light) pairs: their views and their lights are learned from, in other pairs.
    Pairs,
    /// Views, with all their lights.
    Views,
    /// Lights, in all views.
    Lights,
    /// Views and lights: a held-out image has neither its view nor its light in training. Images that have one of the two
    /// are in neither part.
    Novel,
}

/// What a light is told apart by: its place where the rig is shared, else its place in the frame (the lamp on the stand).
#[derive(PartialEq, Eq, PartialOrd, Ord)]
enum Lamp {
    Rig(LightKey),
    Frame(usize),
}

impl Capture {
    /// The capture with `share` (in (0, 1)) of the training views, lights, both or pairs held out in place of what was held
    /// out before. Views and lights are spread evenly over directions by farthest-point selection, pairs are drawn so that
    /// every view keeps at least one; `seed` decides with which the choice begins. At least one is held out and one kept.
    ///
    /// Errors: a share outside (0, 1), and a capture that has not two of what is to be divided.
    pub fn hold_out(&self, what: HoldOut, share: f32, seed: u64) -> Result<Capture, DatasetError> {
        let fail = |reason: String| Err(DatasetError::Selection { what: "held-out images", reason });
        if !(share > 0.0 && share < 1.0) {
            return fail(format!("the share must lie between 0 and 1, found {share}"));
        }
        let count = |all: usize| ((share * all as f32).round() as usize).clamp(1, all - 1);
        let centre = self.scene().centre;
        let (of_views, of_lights) =
            (matches!(what, HoldOut::Views | HoldOut::Novel), matches!(what, HoldOut::Lights | HoldOut::Novel));
        let mut views = BTreeSet::new();
        if of_views {
            if self.train.len() < 2 {
                return fail("one training view cannot be divided; hold out pairs or lights".into());
            }
            let directions = view_directions(&self.train, centre);
            views.extend(farthest_points_seeded(&directions, count(directions.len()), seed));
        }
        let shared = shared_rig(&self.train).is_some();
        let lamp = |shot: &Shot| match shared {
            true => Lamp::Rig(key(&shot.light)),
            false => Lamp::Frame(shot.light_index),
        };
        let mut lamps = BTreeSet::new();
        if of_lights {
            let mut known: Vec<(Lamp, Vec3)> = Vec::new();
            for shot in self.train.iter().flat_map(|v| &v.shots) {
                if !known.iter().any(|(l, _)| *l == lamp(shot)) {
                    known.push((lamp(shot), light_direction(&shot.light, centre)));
                }
            }
            if known.len() < 2 {
                return fail("one light cannot be divided; hold out views or pairs".into());
            }
            let directions: Vec<Vec3> = known.iter().map(|(_, d)| *d).collect();
            let chosen = farthest_points_seeded(&directions, count(directions.len()), seed);
            let mut known: Vec<Option<Lamp>> = known.into_iter().map(|(l, _)| Some(l)).collect();
            lamps.extend(chosen.into_iter().filter_map(|i| known[i].take()));
        }
        let mut pairs = BTreeSet::new();
        if what == HoldOut::Pairs {
            pairs = drawn_pairs(&self.train, share, seed);
            if pairs.is_empty() {
                return fail("every view has a single light, so that holding out a pair would lose its view".into());
            }
        }
        let side = |v: usize, s: usize, shot: &Shot| -> Option<Split> {
            let held = |yes: bool| Some(if yes { Split::Test } else { Split::Train });
            match what {
                HoldOut::Pairs => held(pairs.contains(&(v, s))),
                HoldOut::Views => held(views.contains(&v)),
                HoldOut::Lights => held(lamps.contains(&lamp(shot))),
                HoldOut::Novel => match (views.contains(&v), lamps.contains(&lamp(shot))) {
                    (true, true) => Some(Split::Test),
                    (false, false) => Some(Split::Train),
                    _ => None,
                },
            }
        };
        let part = |split: Split| -> Vec<View> {
            let of_view = |(v, view): (usize, &View)| {
                let kept = |(s, shot): (usize, &Shot)| (side(v, s, shot) == Some(split)).then(|| shot.clone());
                View { shots: view.shots.iter().enumerate().filter_map(kept).collect(), split, ..view.clone() }
            };
            self.train.iter().enumerate().map(of_view).filter(|view| !view.shots.is_empty()).collect()
        };
        let (train, test) = (part(Split::Train), part(Split::Test));
        if train.is_empty() || test.is_empty() {
            return fail("nothing would be left on one side; the grid of views and lights is too incomplete".into());
        }
        Ok(Capture { train, test, ..self.clone() })
    }
}

/// `share` of all pairs, drawn evenly, but never the last one of a view.
fn drawn_pairs(views: &[View], share: f32, seed: u64) -> BTreeSet<(usize, usize)> {
    let mut all: Vec<(usize, usize)> =
        views.iter().enumerate().flat_map(|(v, view)| (0..view.shots.len()).map(move |s| (v, s))).collect();
    let wanted = ((share * all.len() as f32).round() as usize).max(1);
    let mut left: Vec<usize> = views.iter().map(|v| v.shots.len()).collect();
    let mut draw = Draw(seed);
    let mut chosen = BTreeSet::new();
    while chosen.len() < wanted && !all.is_empty() {
        let pair = all.swap_remove(draw.below(all.len()));
        if left[pair.0] > 1 {
            left[pair.0] -= 1;
            chosen.insert(pair);
        }
    }
    chosen
}
