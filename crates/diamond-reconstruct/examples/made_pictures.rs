//! How good the prior's pictures of missing lights are, where the missing photographs exist after all: the difference from them, and whether what is
//! believed less is also worse.
//!
//!     cargo run --release -p diamond-reconstruct --example made_pictures -- CAPTURE REGIME [KEY=VALUE…]
//!
//! The regime's photographs are learned from (`from` steps in, by default none), the prior is fitted, and every missing light of the rig is made for
//! every view that the regime has. KEY=VALUE are settings of `[augmentation]`. PSNR in display sRGB over all pixels and over the pixels of the mask, mean over pictures; error
//! by tenth of confidence, least believed first, mean over channels and pixels of the masks.
use diamond_dataset::{Capture, OpenOptions, Regime};
use diamond_image::{Image, Transfer};
use diamond_reconstruct::{Config, Reconstruction};

type Failure = Box<dyn std::error::Error>;

fn display(image: &Image) -> Image {
    image.map(|v| Transfer::Srgb.encode(v.clamp(0.0, 1.0)))
}

fn decibel(squares: f64, count: f64) -> f64 {
    -10.0 * (squares / count.max(1.0)).max(1e-15).log10()
}

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [path, regime, settings @ ..] = arguments.as_slice() else {
        return Err("usage: made_pictures CAPTURE REGIME [KEY=VALUE…]".into());
    };
    let whole = Capture::open(path.as_ref(), &OpenOptions::default())?;
    let capture = regime.parse::<Regime>()?.apply(&whole, 0)?;
    let lines: String = settings.iter().map(|s| format!("{s}\n")).collect();
    let text = format!("steps = 1000\n[augmentation]\nsource = \"prior\"\nlights = 1000\n{lines}");
    let mut run = Reconstruction::new(capture, &Config::parse(&text, "command line")?)?;
    while !run.pictures_due() {
        run.step()?;
    }
    run.make_pictures(&mut |_, _| ())?;
    run.take_notes().iter().for_each(|note| println!("{note}"));
    let (mut all, mut masked, mut pictures) = (0.0, 0.0, 0.0f64);
    let mut pixels: Vec<(f32, f32)> = Vec::new();
    for frame in run.made_pictures() {
        let view = whole.train.iter().find(|v| v.camera == frame.target.camera);
        let Some(shot) = view.and_then(|v| v.shots.iter().find(|s| s.light == frame.target.light)) else { continue };
        let (truth, made) = (whole.observation(shot)?, frame.load()?);
        let (a, b) = (display(&truth.radiance), display(&made.radiance));
        let (mut squares, mut inside, mut area) = (0.0f64, 0.0f64, 0.0f64);
        for i in 0..a.pixels() {
            let mask = truth.mask.as_ref().map_or(1.0, |m| m.data()[i]);
            let d = [0, 1, 2].map(|c| a.data()[3 * i + c] - b.data()[3 * i + c]);
            let square: f64 = d.iter().map(|d| f64::from(d * d)).sum();
            squares += square;
            inside += f64::from(mask) * square;
            area += f64::from(mask);
            if mask >= 0.5 {
                pixels.push((made.confidence.data()[i], d.iter().map(|d| d.abs()).sum::<f32>() / 3.0));
            }
        }
        all += decibel(squares, 3.0 * a.pixels() as f64);
        masked += decibel(inside, 3.0 * area);
        pictures += 1.0;
    }
    if pixels.is_empty() {
        return Err(
            "no picture that was made has a photograph to be compared with: does the regime leave lights out?".into()
        );
    }
    println!("{pictures} pictures with a photograph: {:.2} dB (masked {:.2})", all / pictures, masked / pictures);
    pixels.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mean = |part: &[(f32, f32)], f: fn(&(f32, f32)) -> f32| part.iter().map(f).sum::<f32>() / part.len() as f32;
    for tenth in pixels.chunks(pixels.len().div_ceil(10)) {
        println!("believed to {:.2}: error {:.4}", mean(tenth, |p| p.0), mean(tenth, |p| p.1));
    }
    Ok(())
}
