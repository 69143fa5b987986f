//! Our rasteriser against pictures, footprints and gradients that a double-precision splat renderer computed.
//!
//! A scene is a pair of files. `NAME.bin`, little-endian: `u32` N, then `f32` means [N][3], scales [N][3], quaternions
//! wxyz [N][4], opacities [N], colours [N][3]. `NAME.npz`: `img`, `alpha`, `xy`, `conic`, `depth`, `radii`,
//! `ambiguous`, and the gradients `g_mean`, `g_scale`, `g_quat` (wxyz), `g_opac`, `g_rgb` of
//! `Σ image · linspace(−1, 1, H·W·3) / (W·H)`. The camera stands at the origin with `fx = fy = W` and a centred principal point;
//! alphas are clamped at 0.999, and the near plane lies at 0.01.
//!
//! `ambiguous` marks pixels within rounding of a hard threshold, where single precision may decide otherwise. They are
//! left out of the pictures. They cannot be left out of the reference's gradients, which sum over all pixels. A gradient
//! column is judged with all Gaussians first. Only where it fails, and some ambiguous pixels were really decided
//! otherwise (their colour or opacity differs), it is judged again without the Gaussians that cover those pixels, and
//! says so, with the error before; leaving out more than half of the Gaussians fails. A wrong picture at a pixel that is
//! not ambiguous leaves nothing out.

use super::{Column, OracleReport};
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_splat::{Features, Gaussians, RasterConfig, RasterGrad, rasterize};
use glam::{Quat, Vec3};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Largest absolute error of a picture.
pub const IMAGE_TOLERANCE: f64 = 1e-5;
/// Largest relative L2 error of a gradient, and of the footprints' arrays.
pub const RELATIVE_TOLERANCE: f64 = 1e-5;
/// Largest share of Gaussians that may be left out of the gradient columns of a scene.
const MAX_LEFT_OUT: f64 = 0.5;

/// Compares every scene of the folder `path`, or the one scene whose `.npz` (or `.bin`) is `path`.
///
/// # Errors
/// A message that names the file, when a scene cannot be read or is not of the form above.
pub fn check(path: &Path) -> Result<OracleReport, String> {
    let mut report = OracleReport { title: format!("splat scenes of {}", path.display()), columns: Vec::new() };
    for scene in scenes(path)? {
        let name = scene.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        let reference = Reference::read(&scene)?;
        let ours = Ours::render(&reference)?;
        report.columns.extend(compare(&name, &reference, &ours));
    }
    Ok(report)
}

/// The `.npz` files to compare, sorted by name.
fn scenes(path: &Path) -> Result<Vec<PathBuf>, String> {
    if path.is_file() {
        return Ok(vec![path.with_extension("npz")]);
    }
    let fail = |e: std::io::Error| format!("{}: cannot list the folder: {e}", path.display());
    let mut found = Vec::new();
    for entry in std::fs::read_dir(path).map_err(fail)? {
        let file = entry.map_err(fail)?.path();
        if file.extension().is_some_and(|e| e == "npz") {
            found.push(file);
        }
    }
    if found.is_empty() {
        return Err(format!("{}: expected scenes (NAME.bin with NAME.npz), found no .npz file", path.display()));
    }
    found.sort();
    Ok(found)
}

/// A scene and what the reference computed of it.
struct Reference {
    gaussians: Gaussians,
    colours: Vec<f32>,
    width: usize,
    height: usize,
    image: Vec<f64>,
    alpha: Vec<f64>,
    xy: Vec<f64>,
    conic: Vec<f64>,
    depth: Vec<f64>,
    radii: Vec<f64>,
    ambiguous: Vec<bool>,
    /// `g_mean`, `g_scale`, `g_quat` (wxyz), `g_opac`, `g_rgb`.
    gradients: [Vec<f64>; 5],
}

/// Name and values per Gaussian of each gradient.
const GRADIENTS: [(&str, usize); 5] = [("g_mean", 3), ("g_scale", 3), ("g_quat", 4), ("g_opac", 1), ("g_rgb", 3)];

impl Reference {
    fn read(npz: &Path) -> Result<Self, String> {
        let (gaussians, colours) = read_scene(&npz.with_extension("bin"))?;
        let n = gaussians.len();
        let file = File::open(npz).map_err(|e| format!("{}: cannot open: {e}", npz.display()))?;
        let mut archive =
            zip::ZipArchive::new(file).map_err(|e| format!("{}: not an npz archive: {e}", npz.display()))?;
        let mut read = |name: &str| read_array(&mut archive, name).map_err(|e| format!("{}: {e}", npz.display()));
        let (shape, image) = read("img")?;
        let &[height, width, 3] = shape.as_slice() else {
            return Err(format!("{}: img: expected shape (H, W, 3), found {shape:?}", npz.display()));
        };
        let mut sized = |name: &str, count: usize| {
            let (shape, values) = read(name)?;
            if values.len() == count {
                return Ok(values);
            }
            Err(format!("{}: {name}: expected {count} values, found shape {shape:?}", npz.display()))
        };
        let pixels = width * height;
        Ok(Self {
            image,
            alpha: sized("alpha", pixels)?,
            xy: sized("xy", 2 * n)?,
            conic: sized("conic", 3 * n)?,
            depth: sized("depth", n)?,
            radii: {
                let (shape, radii) = read("radii")?;
                match radii.len() {
                    len if len == n || len == 2 * n => radii,
                    _ => return Err(format!("{}: radii: expected {n} rows, found shape {shape:?}", npz.display())),
                }
            },
            ambiguous: {
                let (_, values) = read("ambiguous")?;
                if values.len() != pixels {
                    return Err(format!("{}: ambiguous: expected {pixels} values", npz.display()));
                }
                values.iter().map(|&v| v != 0.0).collect()
            },
            gradients: {
                let mut all: [Vec<f64>; 5] = Default::default();
                for (k, (name, per)) in GRADIENTS.iter().enumerate() {
                    let (shape, values) = read(name)?;
                    if values.len() != per * n {
                        return Err(format!("{}: {name}: expected ({n}, {per}), found {shape:?}", npz.display()));
                    }
                    all[k] = values;
                }
                all
            },
            gaussians,
            colours,
            width,
            height,
        })
    }

    fn seen(&self, i: usize) -> bool {
        let per = self.radii.len() / self.gaussians.len().max(1);
        self.radii[i * per..(i + 1) * per].iter().all(|&r| r > 0.0)
    }
}

/// Reads a scene file.
fn read_scene(path: &Path) -> Result<(Gaussians, Vec<f32>), String> {
    let bytes = std::fs::read(path).map_err(|e| format!("{}: cannot read: {e}", path.display()))?;
    let head = bytes.get(..4).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
    let n =
        head.ok_or_else(|| format!("{}: expected a u32 count, found {} bytes", path.display(), bytes.len()))? as usize;
    if bytes.len() != 4 + 56 * n {
        return Err(format!(
            "{}: expected {} bytes for {n} Gaussians, found {}",
            path.display(),
            4 + 56 * n,
            bytes.len()
        ));
    }
    let values: Vec<f32> = bytes[4..].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    let vec3 = |from: usize| values[from..from + 3 * n].chunks_exact(3).map(Vec3::from_slice).collect();
    let gaussians = Gaussians {
        means: vec3(0),
        scales: vec3(3 * n),
        rotations: values[6 * n..10 * n].chunks_exact(4).map(|q| Quat::from_xyzw(q[1], q[2], q[3], q[0])).collect(),
        opacities: values[10 * n..11 * n].to_vec(),
        factors: Vec::new(),
    };
    Ok((gaussians, values[11 * n..].to_vec()))
}

/// Shape and values of one array of an archive, as f64.
fn read_array(archive: &mut zip::ZipArchive<File>, name: &str) -> Result<(Vec<usize>, Vec<f64>), String> {
    let mut bytes = Vec::new();
    let mut member = archive.by_name(&format!("{name}.npy")).map_err(|e| format!("no array {name}: {e}"))?;
    member.read_to_end(&mut bytes).map_err(|e| format!("array {name}: {e}"))?;
    let open = || npyz::NpyFile::new(bytes.as_slice()).map_err(|e| format!("array {name}: {e}"));
    let file = open()?;
    let shape: Vec<usize> = file.shape().iter().map(|&s| s as usize).collect();
    let column_major = file.order() == npyz::Order::Fortran;
    let values = if let Ok(values) = file.into_vec::<f64>() {
        values
    } else if let Ok(values) = open()?.into_vec::<f32>() {
        values.into_iter().map(f64::from).collect()
    } else if let Ok(values) = open()?.into_vec::<i32>() {
        values.into_iter().map(f64::from).collect()
    } else if let Ok(values) = open()?.into_vec::<bool>() {
        values.into_iter().map(|v| v as u8 as f64).collect()
    } else {
        return Err(format!("array {name}: expected f64, f32, i32 or bool"));
    };
    Ok((shape.clone(), if column_major { to_row_major(&shape, &values) } else { values }))
}

/// Reorders values whose first index runs fastest.
fn to_row_major(shape: &[usize], values: &[f64]) -> Vec<f64> {
    (0..values.len())
        .map(|mut at| {
            let mut from = values.len();
            let mut source = 0;
            for &side in shape.iter().rev() {
                from /= side.max(1);
                source += at % side * from;
                at /= side;
            }
            values[source]
        })
        .collect()
}

/// What our rasteriser makes of the scene.
struct Ours {
    image: Vec<f32>,
    alpha: Vec<f32>,
    /// Per Gaussian where visible: xy, conic, depth, half extents.
    footprints: Vec<Option<diamond_splat::Footprint>>,
    gradients: [Vec<f32>; 5],
}

impl Ours {
    fn render(r: &Reference) -> Result<Self, String> {
        let (w, h) = (r.width, r.height);
        let intrinsics = Intrinsics {
            fx: w as f32,
            fy: w as f32,
            cx: 0.5 * w as f32,
            cy: 0.5 * h as f32,
            width: w as u32,
            height: h as u32,
        };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        let config = RasterConfig { max_alpha: 0.999, near: 0.01, ..Default::default() };
        let features = Features { channels: 3, data: r.colours.clone() };
        let say = |e: diamond_splat::SplatError| e.to_string();
        let (raster, pullback) = rasterize(&r.gaussians, &features, &camera, &config).map_err(say)?;
        let mut d = RasterGrad::zeros(w, h, 3);
        let last = (w * h * 3).saturating_sub(1).max(1) as f64;
        for (i, v) in d.features.data_mut().iter_mut().enumerate() {
            *v = ((2.0 * i as f64 / last - 1.0) / (w * h) as f64) as f32;
        }
        let pull = pullback.pull(&d).map_err(say)?;
        let n = r.gaussians.len();
        let g = &pull.gaussians;
        Ok(Self {
            footprints: (0..n).map(|i| pullback.projection().footprint(i)).collect(),
            gradients: [
                g.means.iter().flat_map(|v| v.to_array()).collect(),
                g.scales.iter().flat_map(|v| v.to_array()).collect(),
                g.rotations.iter().flat_map(|q| [q.w, q.x, q.y, q.z]).collect(),
                g.opacities.clone(),
                pull.features,
            ],
            image: raster.features.into_vec(),
            alpha: raster.opacity.into_vec(),
        })
    }
}

fn compare(name: &str, r: &Reference, ours: &Ours) -> Vec<Column> {
    let mut image = Column::new(format!("{name}/image"), IMAGE_TOLERANCE);
    let mut alpha = Column::new(format!("{name}/alpha"), IMAGE_TOLERANCE);
    let mut undecided = Vec::new();
    for pixel in 0..r.width * r.height {
        let at = || format!("pixel ({}, {})", pixel % r.width, pixel / r.width);
        let errors: Vec<f64> =
            (0..3).map(|c| (ours.image[3 * pixel + c] as f64 - r.image[3 * pixel + c]).abs()).collect();
        let alpha_error = (ours.alpha[pixel] as f64 - r.alpha[pixel]).abs();
        if r.ambiguous[pixel] {
            // Not (error ≤ tolerance), so that NaN counts as different.
            if !(alpha_error <= IMAGE_TOLERANCE && errors.iter().all(|&e| e <= IMAGE_TOLERANCE)) {
                undecided.push(((pixel % r.width) as f32 + 0.5, (pixel / r.width) as f32 + 0.5));
            }
            continue;
        }
        errors.iter().for_each(|&e| image.observe(e, at));
        alpha.observe(alpha_error, at);
    }
    let mut columns = vec![image, alpha];
    columns.extend(compare_footprints(name, r, ours));
    // Gaussians that cover a pixel which was decided otherwise.
    let n = r.gaussians.len();
    let left_out: Vec<bool> = (0..n)
        .map(|i| {
            ours.footprints[i].is_some_and(|f| {
                undecided.iter().any(|&(x, y)| (x - f.mean.x).abs() <= f.extent.x && (y - f.mean.y).abs() <= f.extent.y)
            })
        })
        .collect();
    for (k, &(gradient, per)) in GRADIENTS.iter().enumerate() {
        let mut column = Column::new(format!("{name}/{gradient}"), RELATIVE_TOLERANCE);
        let (ours, reference) = (&ours.gradients[k], &r.gradients[k]);
        let (error, at) = gradient_error(ours, reference, per, |_| true);
        let kept = left_out.iter().filter(|&&l| !l).count();
        if error <= RELATIVE_TOLERANCE || kept == n {
            column.observe(error, || format!("most by Gaussian {at}"));
            column.count = n * per;
        } else {
            let (without, at) = gradient_error(ours, reference, per, |i| !left_out[i]);
            column.observe(without, || {
                format!(
                    "most by Gaussian {at}; {error:.1e} before leaving out {} of {n} that cover {} pixels decided otherwise",
                    n - kept,
                    undecided.len()
                )
            });
            column.count = if (kept as f64) < (1.0 - MAX_LEFT_OUT) * n as f64 { 0 } else { kept * per };
        }
        columns.push(column);
    }
    columns
}

/// Relative L2 error over the Gaussians that `keep` keeps, and the Gaussian that contributes most to it.
fn gradient_error(ours: &[f32], reference: &[f64], per: usize, keep: impl Fn(usize) -> bool) -> (f64, usize) {
    let (mut difference, mut norm, mut worst, mut at) = (0.0f64, 0.0f64, -1.0f64, 0);
    for (i, (a, b)) in ours.chunks(per).zip(reference.chunks(per)).enumerate().filter(|(i, _)| keep(*i)) {
        let e: f64 = a.iter().zip(b).map(|(&a, &b)| (a as f64 - b).powi(2)).sum();
        difference += e;
        norm += b.iter().map(|b| b * b).sum::<f64>();
        if e > worst {
            (worst, at) = (e, i);
        }
    }
    (relative(difference, norm), at)
}

/// √difference / √norm; two zero vectors agree.
fn relative(difference: f64, norm: f64) -> f64 {
    if difference == 0.0 { 0.0 } else { difference.sqrt() / norm.sqrt().max(1e-30) }
}

/// Means (px, absolute), conics and depths (relative), where both sides see the Gaussian; and whom only we miss.
fn compare_footprints(name: &str, r: &Reference, ours: &Ours) -> Vec<Column> {
    let mut xy = Column::new(format!("{name}/xy (px)"), 1e-4);
    let mut conic = Column::new(format!("{name}/conic"), RELATIVE_TOLERANCE);
    let mut depth = Column::new(format!("{name}/depth"), RELATIVE_TOLERANCE);
    for i in (0..r.gaussians.len()).filter(|&i| r.seen(i)) {
        let Some(f) = ours.footprints[i] else { continue };
        let at = || format!("Gaussian {i}");
        let far = (f.mean.x as f64 - r.xy[2 * i]).abs().max((f.mean.y as f64 - r.xy[2 * i + 1]).abs());
        xy.observe(far, at);
        let q = f.conic.to_array();
        let difference: f64 = (0..3).map(|c| (q[c] as f64 - r.conic[3 * i + c]).powi(2)).sum();
        let norm: f64 = (0..3).map(|c| r.conic[3 * i + c].powi(2)).sum();
        conic.observe(relative(difference, norm), at);
        depth.observe((f.depth as f64 - r.depth[i]).abs() / r.depth[i].abs().max(1e-30), at);
    }
    vec![xy, conic, depth]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fixtures() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../assets/fixtures/splat")
    }

    fn thin() -> (Reference, Ours) {
        let reference = Reference::read(&fixtures().join("thin_1000.npz")).expect("a fixture");
        let ours = Ours::render(&reference).expect("a picture");
        (reference, ours)
    }

    fn failed(reference: &Reference, ours: &Ours) -> Vec<String> {
        compare("s", reference, ours).into_iter().filter(|c| !c.passed()).map(|c| c.name).collect()
    }

    /// [eq:splat-blend], [eq:splat-blend-pull]: against another renderer's double precision.
    #[test]
    fn our_rasteriser_agrees_with_the_reference() {
        let report = check(&fixtures()).expect("fixtures");
        assert_eq!(report.columns.len(), 30, "three scenes of ten columns");
        assert!(report.passed(), "{report}");
        let one = check(&fixtures().join("big_300.bin")).expect("one scene by its .bin");
        assert_eq!(one.columns.len(), 10);
    }

    #[test]
    fn errors_planted_in_each_column_are_noticed() {
        let (reference, ours) = thin();
        assert_eq!(failed(&reference, &ours), Vec::<String>::new());
        let decided = reference.ambiguous.iter().position(|a| !a).expect("most pixels");
        let mut broken = Ours { image: ours.image.clone(), ..thin().1 };
        broken.image[3 * decided] += 1e-4;
        assert_eq!(failed(&reference, &broken), ["s/image"]);
        let mut broken = thin().1;
        broken.alpha[decided] = f32::NAN;
        assert_eq!(failed(&reference, &broken), ["s/alpha"]);
        for (k, (name, _)) in GRADIENTS.iter().enumerate() {
            let mut broken = thin().1;
            broken.gradients[k].iter_mut().for_each(|v| *v *= 1.0001);
            assert_eq!(failed(&reference, &broken), [format!("s/{name}")]);
            broken.gradients[k][0] = f32::NAN;
            assert_eq!(failed(&reference, &broken), [format!("s/{name}")]);
        }
        let mut broken = thin().1;
        for f in broken.footprints.iter_mut().flatten() {
            (f.mean.x, f.conic.y, f.depth) = (f.mean.x + 1e-3, f.conic.y + 1e-3, f.depth * 1.001);
        }
        assert_eq!(failed(&reference, &broken), ["s/xy (px)", "s/conic", "s/depth"]);
        let mut broken = thin().1;
        broken.footprints.fill(None);
        assert_eq!(failed(&reference, &broken), ["s/xy (px)", "s/conic", "s/depth"], "nothing compared");
    }

    /// A pixel that was decided otherwise excuses the Gaussians that cover it, only if it is ambiguous, and says so.
    #[test]
    fn ambiguous_pixels_excuse_only_what_covers_them() {
        let (mut reference, mut ours) = thin();
        let i = ours.footprints.iter().position(Option::is_some).expect("a visible Gaussian");
        let f = ours.footprints[i].expect("visible");
        let pixel = (f.mean.y as usize).min(127) * 128 + (f.mean.x as usize).min(127);
        ours.image[3 * pixel] += 1e-3;
        ours.gradients[4][3 * i] += 1.0;
        reference.ambiguous[pixel] = false;
        assert_eq!(failed(&reference, &ours), ["s/image", "s/g_rgb"]);
        reference.ambiguous[pixel] = true;
        assert_eq!(failed(&reference, &ours), Vec::<String>::new());
        let columns = compare("s", &reference, &ours);
        assert!(columns[9].at.contains("leaving out") && columns[9].count < 3000, "{:?}", columns[9]);
        assert_eq!(columns[5].count, 3000, "columns that pass leave nothing out");
        // Another Gaussian's error stays an error.
        ours.gradients[4][3 * i] -= 1.0;
        let other = (0..1000).rev().find(|&j| ours.footprints[j].is_some_and(|g| (g.mean - f.mean).length() > 40.0));
        ours.gradients[4][3 * other.expect("one far away")] += 1.0;
        assert_eq!(failed(&reference, &ours), ["s/g_rgb"]);
    }

    #[test]
    fn files_that_are_no_scenes_are_named() {
        let folder = std::env::temp_dir().join(format!("splat-oracle-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a temporary folder");
        assert!(check(&folder).unwrap_err().contains("no .npz file"));
        std::fs::write(folder.join("a.npz"), b"no archive").expect("write");
        assert!(check(&folder).unwrap_err().contains("a.bin"));
        std::fs::write(folder.join("a.bin"), [2, 0, 0, 0, 1]).expect("write");
        assert!(check(&folder).unwrap_err().contains("expected 116 bytes"));
        std::fs::write(folder.join("a.bin"), [0; 4]).expect("write");
        assert!(check(&folder).unwrap_err().contains("not an npz archive"));
        std::fs::remove_dir_all(&folder).expect("clean up");
    }

    #[test]
    fn column_major_arrays_are_turned() {
        assert_eq!(to_row_major(&[2, 3], &[0.0, 3.0, 1.0, 4.0, 2.0, 5.0]), [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
    }
}
