//! What is missing in a capture, and what that means for its reconstruction.
use super::findings::Findings;
use diamond_dataset::{Capture, Split};

/// Fewer views than this leave the shape open where only silhouettes speak.
const FEW_VIEWS: usize = 6;
/// Fewer lights than this leave normals and the extent of scattering open.
const FEW_LIGHTS: usize = 3;
/// A larger part of clipped object pixels than this hides highlights.
const MANY_CLIPPED: f64 = 0.01;
/// A larger part of black object pixels than this means underexposure, or that most lights are behind the object.
const MANY_BLACK: f64 = 0.4;
/// Optical axes that miss the centre by more than this part of the camera distance are worth a look.
const WIDE_MISS: f32 = 0.1;

/// One sentence for each thing that is missing or doubtful, the gravest first.
pub(super) fn advice(capture: &Capture, f: &Findings) -> Vec<String> {
    let mut out = Vec::new();
    const SHOWN: usize = 5;
    for failure in f.failures.iter().take(SHOWN) {
        out.push(format!("cannot be loaded: {failure}"));
    }
    if f.failures.len() > SHOWN {
        out.push(format!("{} more images cannot be loaded", f.failures.len() - SHOWN));
    }
    if f.examined.0 > 0 && f.masked == 0 {
        out.push(
            "masks (no alpha channel): everything in the picture counts as object, the background must be black, and \
             no visual hull can be built to start from"
                .into(),
        );
    } else if f.masked < f.examined.0 {
        out.push("masks of some images: the mask term leaves these out".into());
    }
    match capture.train.len() {
        1 => {
            out.push("a second view: depth is open, new views will be guesses; relighting this view still works".into())
        }
        n if n < FEW_VIEWS => out.push(format!(
            "views: {n} silhouettes leave the shape open; expect errors in views far from these, add views first"
        )),
        _ => {}
    }
    let lights = capture.shared_rig(Split::Train).map_or(f.train.columns, |rig| rig.len());
    if lights < FEW_LIGHTS {
        out.push(format!(
            "lights: {} cannot tell base colour, normals and scattering apart; expect errors under new ones",
            if lights == 1 { "one".to_string() } else { lights.to_string() }
        ));
    }
    let (images, cells) = f.train.filled();
    if images < cells {
        out.push(format!(
            "{} of {cells} training images of the grid: no harm, pairs that exist are used",
            cells - images
        ));
    }
    if !capture.test.is_empty() && f.seen_unseen.1 == 0 {
        out.push("held-out images under unseen lights: figures will say nothing about relighting".into());
    }
    if capture.points.is_none() {
        let start = if f.masked > 0 { "the visual hull of the masks" } else { "random points in the framed sphere" };
        out.push(format!("points3d.ply: the reconstruction starts from {start}"));
    }
    let (clipped, black) = f.exposure.fractions();
    if clipped > MANY_CLIPPED {
        out.push(format!(
            "headroom: {:.1} % of the object is clipped, so highlights are cut and roughness comes out too high; expose less",
            100.0 * clipped
        ));
    }
    if black > MANY_BLACK && f.masked > 0 {
        out.push(format!(
            "exposure: {:.0} % of the object is black; if that is not shadow, the transfer (sRGB, linear, gamma) is wrong \
             or the images are underexposed",
            100.0 * black
        ));
    }
    if let Some((_, far)) = f.camera_distance
        && f.axis_miss > WIDE_MISS * far
    {
        out.push(format!(
            "a common centre: optical axes miss it by up to {:.3}; check the poses (OpenGL axes, camera to world), or give \
             the scene bounds yourself",
            f.axis_miss
        ));
    }
    out.extend(capture.notes.iter().cloned());
    out
}
