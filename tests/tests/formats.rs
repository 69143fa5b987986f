//! A reconstruction does not depend on how the capture is written down.
use crate::captures::{scratch, small_config, tiny_capture};
use diamond_dataset::{Capture, ColmapEncoding, ColmapPoints, OpenOptions, Split, write_colmap, write_nerfstudio};
use diamond_sss::{Event, ReconstructOptions, reconstruct};
use std::sync::atomic::AtomicBool;

#[test]
fn blender_nerfstudio_and_colmap_folders_are_reconstructed() {
    let dir = scratch("formats");
    tiny_capture(&dir.join("blender"), 3, 2);
    let source = Capture::open(&dir.join("blender"), &OpenOptions::default()).unwrap();
    let description = source.describe();
    let pixels = |split: Split, v: usize, s: usize| source.pixels_of(split, v, s);
    write_nerfstudio(&dir.join("nerfstudio"), &description, pixels).unwrap();
    let positions: Vec<glam::Vec3> =
        (0..60).map(|i| 0.8 * glam::Vec3::new((i as f32).cos(), (i as f32).sin(), 0.0)).collect();
    let points = ColmapPoints { colours: vec![[200, 100, 50]; 60], positions };
    write_colmap(&dir.join("colmap"), &description, ColmapEncoding::Binary, &points, pixels).unwrap();
    let preset = small_config(&dir).to_str().unwrap().to_owned();
    let run = |name: &str| {
        let mut options = ReconstructOptions::new(dir.join(name), dir.join(format!("{name}-result")));
        options.preset = preset.clone();
        let mut notes = Vec::new();
        let mut events = |event: Event<'_>| {
            if let Event::Note(note) = event {
                notes.push(note);
            }
        };
        reconstruct(&options, &mut events, &AtomicBool::new(false)).unwrap();
        (std::fs::read(dir.join(format!("{name}-result/model.ply"))).unwrap(), notes.join("\n"))
    };
    let (blender, _) = run("blender");
    let (nerfstudio, notes) = run("nerfstudio");
    assert!(notes.contains("read as nerfstudio capture"), "{notes}");
    // A focal length from an angle of view and one in pixels differ in the last bits, and so do the results.
    let table = |bytes: &[u8]| diamond_splat::parse_ply(bytes).unwrap();
    let (blender, nerfstudio) = (table(&blender), table(&nerfstudio));
    for name in ["x", "y", "z", "opacity", "scale_0"] {
        let (a, b) = (blender.column(name).unwrap(), nerfstudio.column(name).unwrap());
        assert_eq!(a.len(), b.len(), "the same views, lights and images give other Gaussians");
        let worst = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 0.05, "{name} differs by {worst}");
    }
    let (_, notes) = run("colmap");
    assert!(notes.contains("read as COLMAP model: sparse/0 holds cameras.bin"), "{notes}");
    assert!(notes.contains("first Gaussians: 60 points of") && notes.contains("points3D.bin"), "{notes}");
    let colmap = Capture::open(&dir.join("colmap"), &OpenOptions::default()).unwrap();
    assert_eq!((colmap.train.len(), colmap.test.len()), (source.train.len(), source.test.len()));
    std::fs::remove_dir_all(dir).unwrap();
}
