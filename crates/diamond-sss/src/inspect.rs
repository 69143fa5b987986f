//! What is in a capture, for the person who took it: in words and as a picture.
//!
//! Both measure the same findings: cameras and their distance, lights, which pairs of view and light exist, exposure,
//! masks, and what is missing. The picture shows a contact sheet, cameras and lights from above and from the side, the
//! coverage of views × lights, and a histogram of the object's brightness.
mod advice;
mod canvas;
mod findings;
mod font;
mod map;
mod picture;
mod text;

pub use picture::inspect_picture;
pub use text::inspect_text;

/// `1 view`, `2 views`.
fn counted(n: usize, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_dataset::{Capture, OpenOptions, Selection};
    use std::path::Path;

    fn example() -> Capture {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/captures/spot-small");
        Capture::open(&path, &OpenOptions::default()).unwrap()
    }

    #[test]
    fn the_text_says_what_is_there() {
        let text = inspect_text(&example());
        for part in [
            "144 images: 24 views × 6 lights, complete",
            "16 images: 4 views × 4 lights, complete",
            "28 views  128×128 pixels, field of view 35.00°",
            "one rig of 6 lights",
            "8 images under lights seen in training, 8 under unseen ones",
            "all 160 images examined have alpha",
            "already multiplied by alpha",
            "points3d.ply",
        ] {
            assert!(text.contains(part), "no \"{part}\" in:\n{text}");
        }
        assert!(text.ends_with("what that means\n  nothing\n"), "{text}");
        assert_eq!(text, inspect_text(&example()));
    }

    #[test]
    fn little_is_said_to_be_little() {
        let sparse = example().select(&Selection::Count(1), &Selection::Count(1)).unwrap();
        let text = inspect_text(&sparse);
        assert!(text.contains("a second view") && text.contains("lights: one cannot"), "{text}");
        assert!(text.contains("distance  4.000 scene units from the centre"), "{text}");
        assert!(inspect_picture(&sparse).is_ok());
    }

    #[test]
    fn the_picture_is_a_picture() {
        let picture = inspect_picture(&example()).unwrap();
        assert_eq!((picture.width(), picture.channels()), (1280, 3));
        assert!(picture.data().iter().all(|v| (0.0..=1.0).contains(v)));
        assert_eq!(picture, inspect_picture(&example()).unwrap());
    }
}
