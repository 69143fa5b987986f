//! Exposure through the program: gains are learned and written, evaluation says which gain it used, `--exposure` brightens
//! by stops.
use crate::captures::{scratch, tiny_capture};
use crate::{diamond, stderr, succeed, text};
use diamond_image::Transfer;
use std::path::Path;

fn json(path: &Path) -> serde_json::Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

#[test]
fn gains_are_learned_reported_and_renderings_brightened_by_stops() {
    let dir = scratch("exposure");
    let capture = dir.join("capture");
    tiny_capture(&capture, 3, 2);
    for (mode, names, used) in
        [("fixed", 0, "none"), ("global", 1, "global"), ("per-view", 3, "mean"), ("per-image", 6, "mean")]
    {
        let (out, config) = (dir.join(mode), dir.join(format!("{mode}.toml")));
        let settings = format!(
            "base = \"resolved\"\nname = \"{mode}\"\n[initial]\ncount = 200\nhull_resolution = 16\n[residual]\n\
             hidden = [16, 16]\n[exposure]\nmode = \"{mode}\"\nfrom = 0.0\nuntil = 1.0\n"
        );
        std::fs::write(&config, settings).unwrap();
        let run = ["reconstruct", text(&capture), "-o", text(&out), "--preset", text(&config), "--steps", "12"];
        let printed = String::from_utf8_lossy(&succeed(&run).stdout).into_owned();
        let metrics = json(&out.join("metrics.json"));
        assert_eq!(metrics["gain"], used, "{mode}");
        assert_eq!(metrics["psnr_fitted_gain"].is_number(), used == "mean", "{mode}");
        assert_eq!(metrics["per_image"][0]["fitted_gain"].is_array(), used == "mean", "{mode}");
        assert!(printed.contains("Gain of held-out images: "), "{printed}");
        assert!(std::fs::read_to_string(out.join("report.html")).unwrap().contains("Gain of held-out images"));
        let file = out.join("exposure.toml");
        assert_eq!(file.is_file(), names > 0, "{mode}");
        if names > 0 {
            let gains: toml::Table = std::fs::read_to_string(file).unwrap().parse().unwrap();
            let gains = gains["gain"].as_array().unwrap();
            assert_eq!(gains.len(), names, "{mode}");
            let learned = |g: &toml::Value| g["gain"][0].as_float().unwrap() != 1.0;
            assert!(gains.iter().any(learned), "{mode}: {gains:?}");
        }
        let again = String::from_utf8_lossy(&succeed(&["evaluate", text(&out), text(&capture)]).stdout).into_owned();
        assert!(again.contains("Gain of held-out images: "), "{again}");
    }
    let (run, wrong) = (dir.join("fixed"), dir.join("wrong.toml"));
    let picture = |name: &str, stops: &str| {
        let path = dir.join(name);
        succeed(&["render", text(&run), "-o", text(&path), "--light", "1,3,2", "--size", "24x24", "--exposure", stops]);
        image::open(path).unwrap().to_rgb8().into_raw()
    };
    let (plain, brighter, darker) = (picture("a.png", "0"), picture("b.png", "1.5"), picture("c.png", "-2"));
    let linear = |byte: u8| Transfer::Srgb.decode(f32::from(byte) / 255.0);
    let mut compared = 0;
    for (&a, (&b, &c)) in plain.iter().zip(brighter.iter().zip(&darker)) {
        // A byte is known to half a step, which the slope of the curve makes a relative error in light.
        for (other, factor) in [(b, 1.5f32.exp2()), (c, 0.25)] {
            let expected = linear(a) * factor;
            if a > 40 && other < 255 {
                let step = |byte: u8| linear(byte.saturating_add(1)) - linear(byte);
                assert!((linear(other) - expected).abs() <= step(a) * factor + step(other), "{a} {other} × {factor}");
                compared += 1;
            }
        }
    }
    assert!(compared > 100, "{compared} values compared");
    for stops in ["NaN", "bright", "1e9"] {
        let refused = diamond(&["render", text(&run), "-o", text(&dir.join("d.png")), "--exposure", stops]);
        assert_eq!(refused.status.code(), Some(2), "{stops}: {}", stderr(&refused));
    }
    std::fs::write(&wrong, "[exposure]\nfrom = 2.0\n").unwrap();
    let refused = diamond(&["reconstruct", text(&capture), "-o", text(&dir.join("no")), "--preset", text(&wrong)]);
    assert!(!refused.status.success() && stderr(&refused).contains("exposure.from"), "{}", stderr(&refused));
    std::fs::remove_dir_all(dir).unwrap();
}
