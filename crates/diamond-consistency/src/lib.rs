//! Do two views of an object agree about its shape? Reprojection, visibility filtering, and the silhouette and depth terms
//! that measure disagreement, with gradients to everything that was compared.
//!
//! Invariant: cameras, depth and silhouettes come in, no radiance does. Nothing here can depend on light.
//!
//! A pixel x of a first view with depth D_i(x) shows the point X = π_i⁻¹(x, D_i(x)), which lies at x' = π_j(X) in a second
//! view. If both views are of one object, the second shows an object there (its silhouette S_j(x') is that of x), and,
//! unless something stands before the point, its depth D_j(x') is that of X.
//!
//! | part | function |
//! |---|---|
//! | both terms of a pair, and their gradient | [`pair_consistency`], [`PairPullback::pull`] |
//! | what became of each pixel | [`PairPullback::correspondences`], [`Fate`] |
//! | a figure for tables, without gradient | [`Disagreement`] |
//! | rendered, given and estimated depth | [`DepthSource`] |
//! | scale and shift of an estimated depth | [`align_depth`] |
//! | which views, which pixels | [`nearest_views`], [`draw_pixels`] |
//!
//! # What is exact
//!
//! The second view is read between pixels. On a plane 1/z is affine in pixel coordinates, so that bilinear interpolation of
//! 1/z ([`DepthSampling::Inverse`]) makes no error there and the depth term of a true plane is rounding. On anything curved
//! interpolation leaves an error of the order of h² times the curvature, h a pixel's width on the surface: it falls by four
//! when the resolution doubles (more slowly next to an outline, where a pixel covers ever more), and is 0 only where points
//! land on pixel centres. A silhouette is a step; the term of true silhouettes is 0 but for points within a pixel of the
//! second view's outline. Their share falls only with the root of the pixel on smooth objects, which turn away from the view
//! toward their outline: on a sphere of 80 pixels radius it is some 3 %, and nothing can be learned below that.
//!
//! ```
//! use diamond_camera::{Camera, Intrinsics, Pose};
//! use diamond_consistency::*;
//! use diamond_image::Image;
//! use glam::Vec3;
//! // Two cameras side by side before a wall at z = 2.
//! let intrinsics = Intrinsics::from_fov_x(0.9, 32, 32);
//! let left = Camera { intrinsics, pose: Pose::IDENTITY };
//! let right = Camera { intrinsics, pose: Pose { translation: Vec3::new(-0.1, 0.0, 0.0), ..Pose::IDENTITY } };
//! let silhouette = Image::filled(32, 32, 1, 1.0);
//! let wall = DepthMap { kind: DepthKind::Z, values: Image::filled(32, 32, 1, 2.0) };
//! let near = DepthMap { kind: DepthKind::Z, values: Image::filled(32, 32, 1, 1.95) };
//! let view = |camera, depth| ViewGeometry { camera, silhouette: &silhouette, depth: DepthSource::Given(depth), mask: None };
//! let options = ConsistencyOptions::new(DepthRange { near: 1.0, far: 3.0 });
//! let pixels = draw_pixels(&view(&left, &wall), &options, 256, 0);
//! let (same, _) = pair_consistency(&view(&left, &wall), &view(&right, &wall), &pixels, &options)?;
//! let (other, pullback) = pair_consistency(&view(&left, &wall), &view(&right, &near), &pixels, &options)?;
//! assert!(same.depth < 1e-6 && (other.depth - 0.025).abs() < 1e-6);
//! // Bringing the second wall nearer still would make it worse: the derivatives add up to −1/(far − near).
//! let grad = pullback.pull(&PairValueGrad { silhouette: 0.0, depth: 1.0 });
//! assert!((grad.to.depth.data().iter().sum::<f32>() + 0.5).abs() < 1e-5);
//! # Ok::<(), ConsistencyError>(())
//! ```
mod align;
mod disagreement;
mod error;
mod options;
mod pair;
mod reproject;
mod select;
mod silhouette;
mod view;

pub use align::{Alignment, AlignmentFit, EstimateForm, align_depth};
pub use disagreement::Disagreement;
pub use error::ConsistencyError;
pub use options::{ConsistencyOptions, DepthRange, DepthSampling, Detach, SilhouettePenalty};
pub use pair::{PairGrad, PairPullback, PairValue, PairValueGrad, pair_consistency};
pub use reproject::{Correspondence, Fate};
pub use select::{draw_pixels, nearest_views};
pub use silhouette::SILHOUETTE_MARGIN;
pub use view::{DepthKind, DepthMap, DepthSource, ViewGeometry, ViewGeometryGrad};
