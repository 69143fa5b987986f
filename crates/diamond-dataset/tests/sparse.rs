//! Regimes, held-out parts and manifests on the captures that are shipped.
use diamond_dataset::{Capture, HoldOut, OpenOptions, Regime, Selection, SelectionManifest, View, light_direction};
use glam::Vec3;
use std::collections::BTreeSet;
use std::path::Path;

fn open(name: &str) -> Capture {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/captures").join(name);
    Capture::open(&path, &OpenOptions::default()).unwrap()
}

fn images(views: &[View]) -> BTreeSet<String> {
    views.iter().flat_map(|v| &v.shots).map(|s| s.path.display().to_string()).collect()
}

fn lights(views: &[View]) -> BTreeSet<String> {
    views.iter().flat_map(|v| &v.shots).map(|s| format!("{:?}", s.light)).collect()
}

/// Least angle between two of them, radians.
fn least_gap(directions: &[Vec3]) -> f32 {
    let pairs = (0..directions.len()).flat_map(|i| (0..i).map(move |j| (i, j)));
    pairs.map(|(i, j)| directions[i].angle_between(directions[j])).fold(f32::INFINITY, f32::min)
}

fn views_of(capture: &Capture) -> Vec<Vec3> {
    let centre = capture.scene().centre;
    capture.train.iter().map(|v| (v.camera.pose.centre() - centre).normalize()).collect()
}

/// Counts of the paper's regimes, and that they never touch what is held out.
#[test]
fn regimes_have_their_counts() {
    let whole = open("spot-small");
    let (views, rig) = (whole.train.len(), lights(&whole.train).len());
    let count = |share: f32, all: usize| ((share * all as f32).round() as usize).max(1);
    for name in Regime::PAPER.into_iter().chain(["v50-l50", "3x2", "full-l25"]) {
        let regime: Regime = name.parse().unwrap();
        for seed in [0, 1, 9] {
            let chosen = regime.apply(&whole, seed).unwrap();
            assert_eq!(chosen.test, whole.test, "{name}");
            let (v, l) = match name {
                "full-full" => (views, rig),
                "full-one" => (views, 1),
                "v5-full" => (count(0.05, views), rig),
                "v3-full" => (count(0.03, views), rig),
                "v5-l5" => (count(0.05, views), count(0.05, rig)),
                "v3-l3" => (count(0.03, views), count(0.03, rig)),
                "v50-l50" => (count(0.5, views), count(0.5, rig)),
                "3x2" => (3, 2),
                _ => (views, count(0.25, rig)),
            };
            assert_eq!(chosen.train.len(), v, "{name}");
            assert!(chosen.train.iter().all(|view| view.shots.len() == l), "{name}");
            assert!(images(&chosen.train).is_subset(&images(&whole.train)));
            assert_eq!(chosen.train, regime.apply(&whole, seed).unwrap().train);
        }
    }
}

/// Chosen views are farther apart than those that come first, for any seed.
#[test]
fn views_are_spread() {
    let whole = open("candle-small");
    for seed in 0..6 {
        let spread = whole.select_seeded(&Selection::Count(3), &Selection::All, seed).unwrap();
        let first = whole.select(&"0-2".parse().unwrap(), &Selection::All).unwrap();
        assert!(least_gap(&views_of(&spread)) >= least_gap(&views_of(&first)), "seed {seed}");
    }
    assert!(whole.select(&Selection::PerView(1), &Selection::All).is_err());
}

/// One light per view: as many different lights as views, or all of them equally often, on a rig and on a turntable.
#[test]
fn lights_per_view_cover_the_rig() {
    for name in ["spot-small", "turntable-small"] {
        let whole = open(name);
        let rig = lights(&whole.train).len();
        for seed in [0, 3] {
            for n in [1, 2] {
                let chosen = whole.select_seeded(&Selection::All, &Selection::PerView(n), seed).unwrap();
                assert!(chosen.train.iter().all(|v| v.shots.len() == n.min(v.shots.len().max(1))), "{name}");
                let all = chosen.train.iter().map(|v| v.shots.len()).sum::<usize>();
                assert_eq!(lights(&chosen.train).len(), all.min(rig), "{name}, {n} per view, seed {seed}");
            }
        }
        let one = whole.select(&Selection::All, &Selection::PerView(1)).unwrap();
        let centre = whole.scene().centre;
        let mean = one.train.iter().map(|v| light_direction(&v.shots[0].light, centre)).sum::<Vec3>();
        let all: Vec<Vec3> =
            whole.train.iter().flat_map(|v| &v.shots).map(|s| light_direction(&s.light, centre)).collect();
        let expected = all.iter().sum::<Vec3>() / all.len() as f32;
        assert!((mean / one.train.len() as f32 - expected).length() < 0.45, "{name}: lights lean to one side");
    }
}

/// What is held out is not learned from: not the pair, and where it says so neither its view nor its light.
#[test]
fn held_out_parts_do_not_touch() {
    for name in ["spot-small", "turntable-small", "jade-small"] {
        let whole = open(name);
        let names = |views: &[View]| views.iter().map(|v| v.name.clone()).collect::<BTreeSet<String>>();
        for seed in [0, 5] {
            for what in [HoldOut::Pairs, HoldOut::Views, HoldOut::Lights, HoldOut::Novel] {
                let split = whole.hold_out(what, 0.3, seed).unwrap();
                let (train, test) = (images(&split.train), images(&split.test));
                assert!(!train.is_empty() && !test.is_empty() && train.is_disjoint(&test), "{name} {what:?}");
                let all = train.len() + test.len();
                match what {
                    HoldOut::Novel => assert!(all < images(&whole.train).len()),
                    _ => assert_eq!(all, images(&whole.train).len()),
                }
                let views_apart = names(&split.train).is_disjoint(&names(&split.test));
                let lights_apart = lights(&split.train).is_disjoint(&lights(&split.test));
                assert!(views_apart || matches!(what, HoldOut::Pairs | HoldOut::Lights), "{name} {what:?}");
                assert!(lights_apart || matches!(what, HoldOut::Pairs | HoldOut::Views), "{name} {what:?}");
                if what == HoldOut::Pairs {
                    assert_eq!(split.train.len(), whole.train.len(), "no view is lost");
                }
                assert!(split.test.iter().all(|v| v.split == diamond_dataset::Split::Test));
                // A regime on what is left.
                let sparse = "v50-l50".parse::<Regime>().unwrap().apply(&split, 0).unwrap();
                assert!(images(&sparse.train).is_subset(&train) && images(&sparse.test) == test);
            }
        }
    }
    let whole = open("spot-small");
    for share in [0.0, 1.0, -1.0, f32::NAN] {
        assert!(whole.hold_out(HoldOut::Views, share, 0).is_err());
    }
    let one = whole.select(&Selection::Count(1), &Selection::Count(1)).unwrap();
    for what in [HoldOut::Pairs, HoldOut::Views, HoldOut::Lights, HoldOut::Novel] {
        assert!(one.hold_out(what, 0.5, 0).is_err(), "{what:?}");
    }
}

/// A manifest gives back the selection that it was made from, through its text, and refuses what is not of its capture.
#[test]
fn manifests_give_back_the_selection() {
    for name in ["spot-small", "turntable-small"] {
        let whole = open(name);
        let split = whole.hold_out(HoldOut::Novel, 0.25, 2).unwrap();
        for regime in ["v50-l50", "full-one"] {
            let chosen = regime.parse::<Regime>().unwrap().apply(&split, 2).unwrap();
            let text = chosen.manifest(regime, 2).unwrap().to_json().unwrap();
            let manifest = SelectionManifest::parse("selection.json".as_ref(), text.as_bytes()).unwrap();
            let again = open(name).with_manifest(&manifest).unwrap();
            assert_eq!((&again.train, &again.test), (&chosen.train, &chosen.test), "{name} {regime}");
        }
    }
    let whole = open("spot-small");
    let manifest = whole.manifest("full-full", 0).unwrap();
    let refused = |change: &dyn Fn(&mut SelectionManifest)| {
        let mut wrong = manifest.clone();
        change(&mut wrong);
        whole.with_manifest(&wrong).unwrap_err().to_string()
    };
    assert!(refused(&|m| m.capture = "0".repeat(64)).contains("hash"));
    assert!(refused(&|m| m.train[0].images[0] = "train/none.png".into()).contains("not in the capture"));
    assert!(refused(&|m| m.train[0].images[0] = m.train[0].images[1].clone()).contains("twice"));
    assert!(refused(&|m| m.train[0].images[0] = m.train[1].images.pop().unwrap()).contains("does not belong"));
    assert!(refused(&|m| m.train.clear()).contains("no image"));
    let parse = |text: &str| SelectionManifest::parse("s.json".as_ref(), text.as_bytes()).unwrap_err().to_string();
    let text = manifest.to_json().unwrap();
    assert!(parse(&text.replace("\"format\": 1", "\"format\": 2")).contains("format"));
    assert!(parse(&text[..text.len() / 2]).contains("s.json"));
    assert!(parse(&text.replace("\"seed\"", "\"sead\"")).contains("sead"));
}
