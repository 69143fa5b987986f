//! Random clouds for the tests.
use diamond_splat_files::SplatCloud;
use glam::{Quat, Vec3};
use proptest::prelude::*;

/// Values that every format can hold without cutting: |position| < 4, scales e⁻⁸ to e, colours and harmonics within ±0.99.
pub fn cloud(max: usize) -> impl Strategy<Value = SplatCloud> {
    (1..=max, 0usize..=3).prop_flat_map(|(n, degree)| {
        let k = (degree + 1) * (degree + 1) * 3;
        let row = (
            prop::array::uniform3(-4.0f32..4.0),
            prop::array::uniform3(-8.0f32..1.0),
            prop::array::uniform4(-1.0f32..1.0),
            -8.0f32..8.0,
            prop::collection::vec(-0.99f32..0.99, k),
        );
        prop::collection::vec(row, n).prop_map(move |rows| {
            let mut out = SplatCloud::zeros(rows.len(), degree);
            for (i, (mean, log, q, opacity, sh)) in rows.into_iter().enumerate() {
                out.means[i] = Vec3::from(mean);
                out.log_scales[i] = Vec3::from(log);
                out.rotations[i] = Quat::from_array(q);
                out.opacity_logits[i] = opacity;
                out.sh[i * k..(i + 1) * k].copy_from_slice(&sh);
            }
            out
        })
    })
}

/// Angle between two rotations, radians, in double precision.
pub fn angle(a: Quat, b: Quat) -> f64 {
    let (a, b) = (a.as_dquat().normalize(), b.as_dquat().normalize());
    let d = a.conjugate() * b;
    2.0 * d.xyz().length().atan2(d.w.abs())
}

/// A cloud in place of a strategy.
pub fn sample(n: usize, degree: usize) -> SplatCloud {
    let mut state = 0x9e37_79b9_7f4a_7c15u64;
    let mut draw = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1u64 << 24) as f32 * 2.0 - 1.0
    };
    let mut out = SplatCloud::zeros(n, degree);
    for i in 0..n {
        out.means[i] = Vec3::new(draw(), draw(), draw()) * 3.0;
        out.log_scales[i] = Vec3::new(draw(), draw(), draw()) * 2.0 - 3.0;
        out.rotations[i] = Quat::from_xyzw(draw(), draw(), draw(), draw()).normalize();
        out.opacity_logits[i] = draw() * 5.0;
    }
    out.sh.iter_mut().for_each(|v| *v = draw() * 0.9);
    out
}
