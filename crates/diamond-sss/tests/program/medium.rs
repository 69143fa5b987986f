//! `inspect-medium` and `render --medium`.
use super::{diamond, scratch, stderr, succeed, text, tiny_capture};

#[test]
fn a_medium_is_shown_edited_and_rendered() {
    let dir = scratch("medium");
    let (capture, out, config) = (dir.join("capture"), dir.join("out"), dir.join("medium.toml"));
    tiny_capture(&capture, 3, 2);
    let settings = "steps = 4\n[initial]\ncount = 200\nhull_resolution = 16\n[residual]\nhidden = [16, 16]\n[subsurface]\n\
                    model = \"profile+mlp\"\nsurfels = 300\nseeds = 300\nresolution = 24\nwidths = 6\n";
    std::fs::write(&config, settings).unwrap();
    let first = succeed(&["reconstruct", text(&capture), "-o", text(&out), "--preset", text(&config)]);
    assert!(stderr(&first).contains("medium: profile inside a surface"), "{}", stderr(&first));
    assert!(out.join("medium.toml").is_file() && out.join("surface.ply").is_file());

    let shown = String::from_utf8(succeed(&["inspect-medium", text(&out)]).stdout).unwrap();
    for word in ["reflectance", "light spreads over", "transport mean free path", "photographs", "medium.svg"] {
        assert!(shown.contains(word), "{word}: {shown}");
    }
    assert!(std::fs::read_to_string(out.join("medium.svg")).unwrap().contains("<polyline"));

    let render = |name: &str, medium: &[&str]| {
        let path = dir.join(name);
        let fixed = ["render", text(&out), "-o", text(&path), "--direction", "0,0,1", "--exposure", "-3"];
        succeed(&[&fixed, medium].concat());
        let picture = image::open(&path).unwrap().to_rgb8();
        picture.as_raw().iter().map(|v| u64::from(*v)).sum::<u64>()
    };
    let plain = render("plain.png", &[]);
    let dark = render("dark.png", &["--medium", "reflectance=*0.25"]);
    assert!(10 * dark < 9 * plain && dark > 0, "{dark} {plain}");
    let file = dir.join("changed.toml");
    std::fs::copy(out.join("medium.toml"), &file).unwrap();
    assert_eq!(render("same.png", &["--medium", text(&file)]), plain);

    let picture = dir.join("never.png");
    for (medium, word) in
        [("albedo=0.5", "reflectance"), ("nothing", "KEY=VALUE"), ("missing.toml", "could not be read")]
    {
        let failed = diamond(&["render", text(&out), "-o", text(&picture), "--medium", medium]);
        assert!(!failed.status.success() && stderr(&failed).contains(word), "{medium}: {}", stderr(&failed));
    }
    let broken = out.join("medium.toml");
    std::fs::write(&broken, "unit = 0\n").unwrap();
    let failed = diamond(&["inspect-medium", text(&out)]);
    assert!(failed.status.code() == Some(3) && stderr(&failed).contains("medium.toml"), "{}", stderr(&failed));
    std::fs::remove_file(&broken).unwrap();
    let failed = diamond(&["inspect-medium", text(&out)]);
    assert!(!failed.status.success() && stderr(&failed).contains("has no medium"), "{}", stderr(&failed));
    assert!(!picture.exists());
    std::fs::remove_dir_all(dir).unwrap();
}
