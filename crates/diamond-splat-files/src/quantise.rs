//! Numbers in few bits: what the compact formats share.
use glam::Quat;

/// The nearest of 256 values to `v`, which is meant for [0, 255].
pub(crate) fn byte(v: f64) -> u8 {
    // The cast saturates, and takes NaN to 0.
    v.round() as u8
}

/// A quaternion from its three smaller components, in the order of `w, x, y, z` or any other: the largest is positive
/// and makes the length 1.
pub(crate) fn with_largest(largest: usize, others: [f64; 3]) -> [f64; 4] {
    let mut out = [0.0; 4];
    let sum: f64 = others.iter().map(|v| v * v).sum();
    let mut rest = others.iter();
    for (index, slot) in out.iter_mut().enumerate() {
        *slot = if index == largest { (1.0 - sum).max(0.0).sqrt() } else { rest.next().copied().unwrap_or(0.0) };
    }
    out
}

/// Index of the component of largest magnitude (the first of equals) and the others in order, signs turned so that the
/// largest is positive.
pub(crate) fn split_largest(q: [f64; 4]) -> (usize, [f64; 3]) {
    let mut largest = 0;
    for i in 1..4 {
        if q[i].abs() > q[largest].abs() {
            largest = i;
        }
    }
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    let mut others = [0.0; 3];
    for (slot, i) in others.iter_mut().zip((0..4).filter(|i| *i != largest)) {
        *slot = sign * q[i];
    }
    (largest, others)
}

/// From `w, x, y, z`.
pub(crate) fn from_wxyz(q: [f64; 4]) -> Quat {
    Quat::from_xyzw(q[1] as f32, q[2] as f32, q[3] as f32, q[0] as f32)
}

/// A half-precision number.
pub(crate) fn half(bits: u16) -> f32 {
    let sign = if bits >> 15 == 1 { -1.0 } else { 1.0 };
    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f32::from(bits & 1023) / 1024.0);
    sign * match exponent {
        0 => fraction * libm::exp2f(-14.0),
        31 if fraction == 0.0 => f32::INFINITY,
        31 => f32::NAN,
        e => (1.0 + fraction) * libm::exp2f((e - 15) as f32),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn largest_component_round_trips() {
        for q in [[0.5, -0.5, 0.5, 0.5], [0.0, 0.0, -1.0, 0.0], [0.1, 0.7, 0.7, 0.1f64]] {
            let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
            let q = q.map(|v| v / length);
            let (largest, others) = split_largest(q);
            let back = with_largest(largest, others);
            let dot: f64 = q.iter().zip(back).map(|(a, b)| a * b).sum();
            assert!((dot.abs() - 1.0).abs() < 1e-12 && back[largest] > 0.0, "{q:?} {back:?}");
        }
    }

    #[test]
    fn halves() {
        assert_eq!(
            [half(0x3c00), half(0xc000), half(0x7bff), half(1), half(0x8000)],
            [1.0, -2.0, 65504.0, 2f32.powi(-24), 0.0]
        );
        assert!(half(0x7c00).is_infinite() && half(0x7c01).is_nan());
        assert_eq!([byte(-3.0), byte(300.0), byte(f64::NAN), byte(127.5)], [0, 255, 0, 128]);
    }
}
