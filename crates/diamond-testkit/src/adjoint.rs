//! The adjoint identity ⟨ū, J·ẋ⟩ = ⟨Jᵀ·ū, ẋ⟩, and relative errors.

/// ⟨a, b⟩ in f64.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len(), "dot of vectors of different length");
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// Relative L2 error ‖a − b‖ / max(‖b‖, floor).
pub fn relative_l2(a: &[f64], b: &[f64], floor: f64) -> f64 {
    assert_eq!(a.len(), b.len(), "relative_l2 of vectors of different length");
    let diff: f64 = a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum();
    let norm: f64 = b.iter().map(|y| y * y).sum();
    diff.sqrt() / norm.sqrt().max(floor)
}

/// The relative gap between ⟨ū, J·ẋ⟩ (`jvp` = J·ẋ from an oracle) and ⟨Jᵀ·ū, ẋ⟩ (`vjp` = Jᵀ·ū from the code under
/// test), measured against the sum of the magnitudes of the products, so that cancellation does not count as error.
pub fn adjoint_gap(cotangent: &[f64], jvp: &[f64], vjp: &[f64], tangent: &[f64]) -> f64 {
    let left = dot(cotangent, jvp);
    let right = dot(vjp, tangent);
    let magnitude: f64 = cotangent.iter().zip(jvp).map(|(a, b)| (a * b).abs()).sum::<f64>()
        + vjp.iter().zip(tangent).map(|(a, b)| (a * b).abs()).sum::<f64>();
    (left - right).abs() / magnitude.max(1e-300)
}
