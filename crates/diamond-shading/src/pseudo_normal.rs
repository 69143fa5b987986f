//! Normals of the depth map: what the surface's orientation must be if the depth is right.
//!
//! Every pixel's point is back-projected, P = z·q with q the pixel's direction at z = 1; Sobel differences across the 3×3
//! neighbourhood give two tangents, a along +x and b along +y of the image; the normal is −(a×b)/|a×b|. With x right, y
//! down and z forward a×b points away from the camera, hence the sign: on any surface that is seen from its front the
//! result faces the camera, n·(direction to the camera) > 0. On a plane it is exact, in perspective too.
//!
//! A pixel has no normal (zero, no gradient) at the border, where one of the nine pixels is covered by
//! [`MIN_COVERAGE`] or less or lies behind the camera, and where the differences across a jump in depth give a normal that
//! faces away.
use crate::ShadingError;
use crate::error::check_image;
use crate::row_chunks::map_chunks_mut;
use diamond_camera::Camera;
use diamond_image::Image;
use glam::{Vec2, Vec3};

/// Opacity above which a pixel counts as surface.
pub const MIN_COVERAGE: f32 = 0.5;

/// sin of the smallest angle between the two tangents that still spans a plane.
const MIN_SINE: f32 = 1e-6;

/// Sobel weights of the central difference along x, by `[row][column]`; along y they are transposed. The sum over one side
/// is ½, so that the result is the difference per pixel.
const SOBEL: [[f32; 3]; 3] = [[-0.125, 0.0, 0.125], [-0.25, 0.0, 0.25], [-0.125, 0.0, 0.125]];

/// Pullback of [`pseudo_normals`] to the depth; borrows what the forward function read.
#[derive(Debug, Clone, Copy)]
pub struct PseudoNormalPullback<'a> {
    camera: &'a Camera,
    depth: &'a Image,
    opacity: &'a Image,
}

/// The tangents of one pixel in camera axes and its normal.
struct Tangents {
    a: Vec3,
    b: Vec3,
    /// |a×b|.
    area: f32,
    /// −(a×b)/|a×b|, camera axes.
    normal: Vec3,
}

/// Normals of a depth map.
///
/// `depth`: one channel, opacity-normalised view-space z (D/O), scene units; `opacity`: one channel in `[0, 1]`; both of
/// the camera's size. Returns unit normals in world axes (three channels; zero where there is none, see the module) and
/// the pullback to `depth`. The opacity only decides where there is a normal, and has no gradient.
/// `[eq:pseudo-normal]`
///
/// # Errors
/// [`ShadingError::Shape`] where an image does not have the camera's size or one channel.
pub fn pseudo_normals<'a>(
    camera: &'a Camera,
    depth: &'a Image,
    opacity: &'a Image,
) -> Result<(Image, PseudoNormalPullback<'a>), ShadingError> {
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    check_image("pseudo_normals: depth", depth, (width, height, 1))?;
    check_image("pseudo_normals: opacity", opacity, (width, height, 1))?;
    let pullback = PseudoNormalPullback { camera, depth, opacity };
    let to_world = camera.pose.rotation.transpose();
    let mut normals = Image::new(width, height, 3);
    map_chunks_mut(normals.data_mut(), width * 3, |y, row| {
        for (x, out) in row.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            if let Some(t) = pullback.tangents(x, y) {
                *out = (to_world * t.normal).to_array();
            }
        }
    });
    Ok((normals, pullback))
}

impl PseudoNormalPullback<'_> {
    /// The direction through the centre of a pixel, z = 1.
    fn direction(&self, x: usize, y: usize) -> Vec3 {
        self.camera.pixel_direction(Vec2::new(x as f32 + 0.5, y as f32 + 0.5))
    }

    /// The tangents at an inner pixel, `None` where it has no normal.
    fn tangents(&self, x: usize, y: usize) -> Option<Tangents> {
        let (width, height, _) = self.depth.shape();
        if x == 0 || y == 0 || x + 1 >= width || y + 1 >= height {
            return None;
        }
        let (mut a, mut b) = (Vec3::ZERO, Vec3::ZERO);
        for j in 0..3 {
            for i in 0..3 {
                let (u, v) = (x + i - 1, y + j - 1);
                let z = self.depth.pixel(u, v)[0];
                let covered = self.opacity.pixel(u, v)[0] > MIN_COVERAGE && z > 0.0 && z.is_finite();
                if !covered {
                    return None;
                }
                let p = self.direction(u, v) * z;
                a += p * SOBEL[j][i];
                b += p * SOBEL[i][j];
            }
        }
        let cross = a.cross(b);
        let area = cross.length();
        let spans = area > MIN_SINE * a.length() * b.length() && area > f32::MIN_POSITIVE;
        let faces = cross.dot(self.direction(x, y)) > 0.0;
        (spans && faces && area.is_finite()).then(|| Tangents { a, b, area, normal: -cross / area })
    }

    /// Cotangent of the depth (one channel) for the cotangent `d_normals` of the normals (three channels, world axes).
    /// `[eq:pseudo-normal]`
    ///
    /// # Errors
    /// [`ShadingError::Shape`] where `d_normals` has another shape than the normals.
    pub fn pull(&self, d_normals: &Image) -> Result<Image, ShadingError> {
        let (width, height, _) = self.depth.shape();
        check_image("PseudoNormalPullback::pull: d_normals", d_normals, (width, height, 3))?;
        // Cotangents of both tangents for every pixel, then each depth gathers from the nine that read it.
        let mut d_tangents = Image::new(width, height, 6);
        map_chunks_mut(d_tangents.data_mut(), width * 6, |y, row| {
            for (x, out) in row.as_chunks_mut::<6>().0.iter_mut().enumerate() {
                let Some(t) = self.tangents(x, y) else { continue };
                let d_n = self.camera.pose.rotation * Vec3::from_slice(d_normals.pixel(x, y));
                let d_cross = (t.normal * t.normal.dot(d_n) - d_n) / t.area;
                let (d_a, d_b) = (t.b.cross(d_cross), d_cross.cross(t.a));
                *out = [d_a.x, d_a.y, d_a.z, d_b.x, d_b.y, d_b.z];
            }
        });
        let mut d_depth = Image::new(width, height, 1);
        map_chunks_mut(d_depth.data_mut(), width, |y, row| {
            for (x, out) in row.iter_mut().enumerate() {
                let mut d_point = Vec3::ZERO;
                for j in 0..3 {
                    for i in 0..3 {
                        // Pixel (x, y) is the neighbour (i, j) of (u, v).
                        let (u, v) = ((x + 1).wrapping_sub(i), (y + 1).wrapping_sub(j));
                        if u < width && v < height {
                            let d = d_tangents.pixel(u, v);
                            d_point += Vec3::from_slice(d) * SOBEL[j][i] + Vec3::from_slice(&d[3..]) * SOBEL[i][j];
                        }
                    }
                }
                *out = d_point.dot(self.direction(x, y));
            }
        });
        Ok(d_depth)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_camera::{Intrinsics, Pose};
    use diamond_testkit::adjoint::{adjoint_gap, worst_relative};
    use diamond_testkit::strategies::{unit_vector, values};
    use diamond_testkit::{Dual, jvp, pseudo_normal as naive};
    use proptest::prelude::*;

    const W: usize = 7;
    const H: usize = 6;

    fn camera() -> Camera {
        let intrinsics = Intrinsics { fx: 9.0, fy: 8.0, cx: 3.1, cy: 3.3, width: W as u32, height: H as u32 };
        Camera { intrinsics, pose: Pose::look_at(Vec3::new(2.0, -1.0, 3.0), Vec3::new(0.1, 0.0, 0.2), Vec3::Y) }
    }

    fn oracle(camera: &Camera, opacity: &[f32], x: &[Dual]) -> Vec<Dual> {
        let k = &camera.intrinsics;
        let pinhole = [k.fx, k.fy, k.cx, k.cy].map(f64::from);
        let r = camera.pose.rotation.transpose().to_cols_array_2d().map(|row| row.map(f64::from));
        let covered: Vec<bool> = opacity.iter().map(|&o| o > 0.5).collect();
        naive::pseudo_normals(pinhole, r, W, H, &covered, x)
    }

    fn widen(v: &[f32]) -> Vec<f64> {
        v.iter().map(|&v| f64::from(v)).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// `[eq:pseudo-normal]`: a rough depth map with a few holes.
        #[test]
        fn values_and_pullback_agree_with_the_oracle(
            z in values(W * H, 2.0..3.0), d in values(3 * W * H, -1.0..1.0), tangent in values(W * H, -1.0..1.0),
            hole in 0..W * H, rough in prop::bool::ANY,
        ) {
            let camera = camera();
            let z: Vec<f32> = z.iter().map(|z| if rough { *z } else { 2.5 + 0.1 * (z - 2.5) }).collect();
            let mut o = vec![1.0; W * H];
            o[hole] = 0.5;
            let depth = Image::from_vec(W, H, 1, z.clone()).expect("shape");
            let opacity = Image::from_vec(W, H, 1, o.clone()).expect("shape");
            let (normals, pullback) = pseudo_normals(&camera, &depth, &opacity).expect("shapes agree");
            let x = widen(&z);
            let constants: Vec<Dual> = x.iter().map(|&v| Dual::new(v, 0.0)).collect();
            let expected: Vec<f64> = oracle(&camera, &o, &constants).iter().map(|d| d.v).collect();
            let actual = widen(normals.data());
            prop_assert!(worst_relative(&actual, &expected, 1.0) <= 1e-5);
            prop_assert!(actual.iter().any(|v| *v != 0.0));
            let d_normals = Image::from_vec(W, H, 3, d.clone()).expect("shape");
            let d_depth = pullback.pull(&d_normals).expect("shapes agree");
            let forward = jvp(|x| oracle(&camera, &o, x), &x, &widen(&tangent));
            let gap = adjoint_gap(&widen(&d), &forward, &widen(d_depth.data()), &widen(&tangent));
            prop_assert!(gap <= 1e-5, "{gap:e}");
            // One depth at a time.
            for i in [hole, 17, 24] {
                let mut one = vec![0.0; W * H];
                one[i] = 1.0;
                let forward = jvp(|x| oracle(&camera, &o, x), &x, &one);
                let gap = adjoint_gap(&widen(&d), &forward, &widen(d_depth.data()), &one);
                let both_zero = d_depth.data()[i] == 0.0 && forward.iter().all(|v| *v == 0.0);
                prop_assert!(both_zero || gap <= 1e-4, "depth {i}: {gap:e}");
            }
        }

        /// `[eq:pseudo-normal]`: a plane has its own normal everywhere, facing the camera.
        #[test]
        fn planes_have_their_normal(n in unit_vector()) {
            let camera = camera();
            let (eye, n) = (camera.pose.centre(), Vec3::from(n));
            // The plane through the point 3 units ahead; n·ray must not vanish in the image.
            let ahead = camera.ray(Vec2::new(3.5, 3.0));
            let point = eye + ahead.direction * 3.0;
            let n = if n.dot(ahead.direction) > 0.0 { -n } else { n };
            let mut depth = Image::new(W, H, 1);
            for y in 0..H {
                for x in 0..W {
                    let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
                    prop_assume!(n.dot(ray.direction) < -0.1);
                    let t = (point - eye).dot(n) / ray.direction.dot(n);
                    depth.pixel_mut(x, y)[0] = camera.pose.transform_point(eye + ray.direction * t).z;
                }
            }
            let opacity = Image::filled(W, H, 1, 1.0);
            let (normals, _) = pseudo_normals(&camera, &depth, &opacity).expect("shapes agree");
            for y in 1..H - 1 {
                for x in 1..W - 1 {
                    let found = Vec3::from_slice(normals.pixel(x, y));
                    prop_assert!((found - n).length() < 2e-4, "{x},{y}: {found} {n}");
                    prop_assert!(found.dot(camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)).direction) < 0.0);
                }
            }
            prop_assert_eq!(normals.pixel(0, 2), &[0.0, 0.0, 0.0]);
        }
    }

    /// The adjoint comparison notices a flipped sign and a forgotten neighbour.
    #[test]
    fn planted_errors_are_noticed() {
        let camera = camera();
        let z: Vec<f32> = (0..W * H).map(|i| 2.0 + ((i * 37) % 11) as f32 / 40.0).collect();
        let o = vec![1.0; W * H];
        let d: Vec<f32> = (0..3 * W * H).map(|i| ((i * 53) % 17) as f32 / 8.0 - 1.0).collect();
        let depth = Image::from_vec(W, H, 1, z.clone()).expect("shape");
        let opacity = Image::from_vec(W, H, 1, o.clone()).expect("shape");
        let (_, pullback) = pseudo_normals(&camera, &depth, &opacity).expect("shapes agree");
        let g = widen(pullback.pull(&Image::from_vec(W, H, 3, d.clone()).expect("shape")).expect("shapes").data());
        let i = 2 * W + 3;
        let mut one = vec![0.0; W * H];
        one[i] = 1.0;
        let forward = jvp(|x| oracle(&camera, &o, x), &widen(&z), &one);
        let gap = |g: &[f64]| adjoint_gap(&widen(&d), &forward, g, &one);
        assert!(gap(&g) <= 1e-5);
        let negated: Vec<f64> = g.iter().map(|v| -v).collect();
        let scaled: Vec<f64> = g.iter().map(|v| v * 1.001).collect();
        assert!(gap(&negated) > 1e-4 && gap(&scaled) > 1e-5);
    }

    #[test]
    fn shapes_are_checked_and_tiny_images_have_no_normals() {
        let mut camera = camera();
        let image = Image::filled(W, H, 1, 1.0);
        assert!(pseudo_normals(&camera, &image, &Image::filled(W, H, 2, 1.0)).is_err());
        assert!(pseudo_normals(&camera, &Image::new(H, W, 1), &image).is_err());
        (camera.intrinsics.width, camera.intrinsics.height) = (1, 2);
        let tiny = Image::filled(1, 2, 1, 1.0);
        let (normals, pullback) = pseudo_normals(&camera, &tiny, &tiny).expect("shapes agree");
        assert!(normals.data().iter().all(|v| *v == 0.0));
        assert!(pullback.pull(&Image::filled(1, 2, 3, 1.0)).expect("shape").data().iter().all(|v| *v == 0.0));
        assert!(pullback.pull(&Image::new(2, 1, 3)).is_err());
    }
}
