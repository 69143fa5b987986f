//! Laws of cameras, poses and rays.
use diamond_camera::{Camera, Depth, Intrinsics, Pose, Trajectory, plucker_map};
use diamond_testkit::adjoint::relative_l2;
use diamond_testkit::strategies::{finite, rotation_wxyz, unit_vector, vector};
use glam::{Mat3, Quat, Vec2, Vec3};
use proptest::prelude::*;

fn pose() -> impl Strategy<Value = Pose> + Clone {
    (rotation_wxyz(), vector(-2.0..2.0)).prop_map(|([w, x, y, z], t)| {
        Pose::from_quaternion(Quat::from_xyzw(x, y, z, w), t.into()).expect("a unit quaternion")
    })
}

/// Off-centre principal points, also outside the image; pixels that are not square.
fn camera() -> impl Strategy<Value = Camera> + Clone {
    let pinhole = [finite(60.0..300.0), finite(60.0..300.0), finite(-40.0..200.0), finite(-40.0..200.0)];
    (pinhole, pose()).prop_map(|([fx, fy, cx, cy], pose)| Camera {
        intrinsics: Intrinsics { fx, fy, cx, cy, width: 160, height: 120 },
        pose,
    })
}

fn angle(a: Vec3, b: Vec3) -> f32 {
    a.cross(b).length().atan2(a.dot(b))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    /// [eq:project] [eq:unproject]: π⁻¹∘π = id for both kinds of depth.
    #[test]
    fn unproject_undoes_project(c in camera(), x in finite(-1.0..1.0), y in finite(-1.0..1.0), z in finite(0.2..10.0)) {
        let world = c.pose.inverse_transform_point(Vec3::new(x * z, y * z, z));
        let (pixel, z) = c.project(world).unwrap();
        let distance = world.distance(c.pose.centre());
        for depth in [Depth::Z(z), Depth::Distance(distance)] {
            let back = c.unproject(pixel, depth);
            prop_assert!((back - world).length() <= 1e-5 * (1.0 + distance), "{depth:?}: {back} instead of {world}");
        }
    }

    /// [eq:project] [eq:unproject]: π∘π⁻¹ = id for both kinds of depth.
    #[test]
    fn project_undoes_unproject(c in camera(), u in finite(-20.0..180.0), v in finite(-20.0..140.0), d in finite(0.5..10.0)) {
        let pixel = Vec2::new(u, v);
        for depth in [Depth::Z(d), Depth::Distance(d)] {
            let world = c.unproject(pixel, depth);
            let (back, z) = c.project(world).unwrap();
            prop_assert!((back - pixel).length() <= 5e-3, "{depth:?}: {back} instead of {pixel}");
            let (got, expected) = match depth {
                Depth::Z(_) => (z, d),
                Depth::Distance(_) => (world.distance(c.pose.centre()), d),
            };
            prop_assert!((got - expected).abs() <= 1e-5 * (4.0 + d));
        }
    }

    /// [eq:depth-kinds]: the two kinds of depth convert into each other, and name the same point.
    #[test]
    fn depth_kinds_agree(c in camera(), u in finite(0.0..160.0), v in finite(0.0..120.0), z in finite(0.1..10.0)) {
        let pixel = Vec2::new(u, v);
        let distance = c.to_distance(pixel, Depth::Z(z));
        prop_assert!(distance >= z * (1.0 - 1e-6));
        prop_assert!((c.to_z(pixel, Depth::Distance(distance)) - z).abs() <= 1e-5 * z);
        let gap = (c.unproject(pixel, Depth::Z(z)) - c.unproject(pixel, Depth::Distance(distance))).length();
        prop_assert!(gap <= 1e-5 * (1.0 + distance));
        prop_assert_eq!(c.to_z(pixel, Depth::Z(z)), z);
        prop_assert_eq!(c.to_distance(pixel, Depth::Distance(z)), z);
    }

    /// The ray through a pixel meets every point that projects there, at its Euclidean distance.
    #[test]
    fn rays_meet_their_points(c in camera(), u in finite(0.0..160.0), v in finite(0.0..120.0), d in finite(0.1..10.0)) {
        let pixel = Vec2::new(u, v);
        let ray = c.ray(pixel);
        prop_assert!((ray.direction.length() - 1.0).abs() < 1e-5);
        prop_assert!((ray.at(d) - c.unproject(pixel, Depth::Distance(d))).length() <= 1e-5 * (1.0 + d));
        prop_assert_eq!(ray.origin, c.pose.centre());
    }

    /// World → camera → world, and rigid: distances do not change.
    #[test]
    fn poses_are_rigid(p in pose(), a in vector(-5.0..5.0), b in vector(-5.0..5.0)) {
        let (a, b) = (Vec3::from(a), Vec3::from(b));
        prop_assert!((p.inverse_transform_point(p.transform_point(a)) - a).length() < 2e-5);
        let moved = p.transform_point(a).distance(p.transform_point(b));
        prop_assert!((moved - a.distance(b)).abs() < 2e-5);
        prop_assert!(p.transform_point(p.centre()).length() < 2e-5);
    }

    /// To OpenGL axes and back: the rotation to the bit, the translation to rounding; and the axes are OpenGL's.
    #[test]
    fn opengl_round_trip(p in pose()) {
        let m = p.to_opengl_camera_to_world();
        let back = Pose::from_opengl_camera_to_world(m).unwrap();
        prop_assert_eq!(back.rotation, p.rotation);
        prop_assert!((back.translation - p.translation).length() < 1e-5);
        // OpenGL looks along −z with y up: a point one unit ahead and one that is up, in world coordinates.
        let ahead = m.transform_point3(-Vec3::Z);
        prop_assert!((p.transform_point(ahead) - Vec3::Z).length() < 1e-5);
        let above = m.transform_point3(Vec3::Y);
        prop_assert!((p.transform_point(above) + Vec3::Y).length() < 1e-5);
    }

    /// look_at: the target is ahead on the axis, up is upward and not tilted sideways, the eye is the centre.
    #[test]
    fn look_at_keeps_up(eye in vector(-4.0..4.0), target in vector(-1.0..1.0), up in unit_vector()) {
        let (eye, target, up) = (Vec3::from(eye), Vec3::from(target), Vec3::from(up));
        let view = target - eye;
        prop_assume!(view.length() > 0.1 && view.normalize().cross(up).length() > 0.05);
        let p = Pose::look_at(eye, target, up);
        prop_assert!(p.validate().is_ok());
        prop_assert!((p.centre() - eye).length() < 1e-5);
        let t = p.transform_point(target);
        prop_assert!(t.truncate().length() < 1e-5 && (t.z - view.length()).abs() < 1e-5);
        let u = p.rotation * up;
        prop_assert!(u.y < 0.0 && u.x.abs() < 1e-5, "{u}");
    }

    /// Mirrored axes are an error whatever the pose; so is a NaN in any place.
    #[test]
    fn mirrored_and_nan_matrices_are_errors(p in pose(), axis in 0usize..3, column in 0usize..4, row in 0usize..4) {
        let good = p.to_opengl_camera_to_world();
        let mut mirrored = good;
        *mirrored.col_mut(axis) = -mirrored.col(axis);
        prop_assert!(Pose::from_opengl_camera_to_world(mirrored).is_err());
        let mut broken = good;
        broken.col_mut(column)[row] = f32::NAN;
        prop_assert!(Pose::from_opengl_camera_to_world(broken).is_err());
    }

    /// [eq:plucker]: unit direction, moment perpendicular to it, the same whatever point of the line is taken.
    #[test]
    fn plucker_coordinates_name_the_line(c in camera(), u in finite(0.0..160.0), v in finite(0.0..120.0), d in finite(-5.0..5.0)) {
        let l = c.plucker(Vec2::new(u, v));
        let (direction, moment) = (Vec3::new(l[0], l[1], l[2]), Vec3::new(l[3], l[4], l[5]));
        prop_assert!((direction.length() - 1.0).abs() < 1e-5);
        prop_assert!(direction.dot(moment).abs() < 1e-5);
        let other = c.ray(Vec2::new(u, v)).at(d);
        prop_assert!((other.cross(direction) - moment).length() < 1e-5);
        let of = |v: f32| f64::from(v);
        let k = c.intrinsics;
        let expected = diamond_testkit::camera::plucker(
            [k.fx, k.fy, k.cx, k.cy].map(of),
            [0, 1, 2].map(|i| c.pose.rotation.row(i).to_array().map(of)),
            c.pose.translation.to_array().map(of),
            [of(u), of(v)],
        );
        prop_assert!(relative_l2(&l.map(of), &expected, 1.0) <= 1e-5);
    }

    /// Resampling or cropping the image moves pixels and leaves rays alone.
    #[test]
    fn resized_and_cropped_cameras_see_the_same(c in camera(), x in finite(-0.5..0.5), y in finite(-0.5..0.5), z in finite(0.5..5.0)) {
        let world = c.pose.inverse_transform_point(Vec3::new(x * z, y * z, z));
        let (pixel, _) = c.project(world).unwrap();
        let (half, _) = c.resized(80, 40).project(world).unwrap();
        prop_assert!((half - pixel * Vec2::new(0.5, 1.0 / 3.0)).length() < 1e-3);
        let cropped = Camera { intrinsics: c.intrinsics.cropped(7, 11, 50, 40), ..c };
        prop_assert!((cropped.project(world).unwrap().0 - (pixel - Vec2::new(7.0, 11.0))).length() < 1e-3);
    }

    /// [eq:pose-slerp]: the ends are met, the angle to the start grows in proportion, the short way round is taken.
    #[test]
    fn interpolation_turns_evenly(a in pose(), b in pose(), t in finite(0.0..1.0)) {
        let turn = |p: &Pose, q: &Pose| {
            let r: Mat3 = p.rotation.transpose() * q.rotation;
            // The angle from the antisymmetric part and the trace: exact near 0 and π alike.
            let axis = Vec3::new(r.y_axis.z - r.z_axis.y, r.z_axis.x - r.x_axis.z, r.x_axis.y - r.y_axis.x);
            axis.length().atan2(r.x_axis.x + r.y_axis.y + r.z_axis.z - 1.0)
        };
        let whole = turn(&a, &b);
        prop_assume!(whole < 3.1);
        let p = a.interpolate(&b, t);
        prop_assert!(p.validate().is_ok());
        prop_assert!((turn(&a, &p) - t * whole).abs() < 2e-3);
        prop_assert!((turn(&p, &b) - (1.0 - t) * whole).abs() < 2e-3);
        prop_assert!((p.centre() - a.centre().lerp(b.centre(), t)).length() < 2e-5);
    }

    /// An orbit looks at its target from one distance and one height all the way.
    #[test]
    fn orbits_are_circles(target in vector(-1.0..1.0), up in unit_vector(), distance in finite(0.5..5.0),
                          elevation in finite(-1.3..1.3), t in finite(0.0..1.0)) {
        let (target, up) = (Vec3::from(target), Vec3::from(up));
        let p = Trajectory::orbit(target, up, distance, elevation).unwrap().at(t);
        let offset = p.centre() - target;
        prop_assert!((offset.length() - distance).abs() < 2e-5);
        prop_assert!((offset.dot(up) - distance * elevation.sin()).abs() < 2e-5);
        prop_assert!(angle(p.forward(), -offset) < 1e-4);
    }
}

#[test]
fn the_plucker_map_is_row_major_over_pixel_centres() {
    let pose = Pose::look_at(Vec3::new(2.0, 1.0, 3.0), Vec3::ZERO, Vec3::Y);
    let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.9, 5, 3), pose };
    let map = plucker_map(&camera);
    assert_eq!(map.len(), 15);
    assert_eq!(map[5 + 3], camera.plucker(Vec2::new(3.5, 1.5)));
}
