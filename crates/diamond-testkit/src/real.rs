//! A scalar trait that `f64` and dual numbers share, so that one oracle gives values and derivatives.
//!
//! ```
//! use diamond_testkit::{Real, gradient};
//! fn gaussian<R: Real>(x: R, sigma: R) -> R {
//!     (-(x * x) / (R::of(2.0) * sigma * sigma)).exp()
//! }
//! let value = gaussian(0.5, 2.0);
//! let grad = gradient(|v| gaussian(v[0], v[1]), &[0.5, 2.0]);
//! assert!((grad[0] + 0.5 / 4.0 * value).abs() < 1e-15);
//! ```
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

/// The scalar operations that oracles are written with.
pub trait Real:
    Copy
    + std::fmt::Debug
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
{
    /// A constant (zero derivative).
    fn of(v: f64) -> Self;
    /// The value without its derivative.
    fn value(self) -> f64;
    /// e^x.
    fn exp(self) -> Self;
    /// Natural logarithm.
    fn ln(self) -> Self;
    /// Square root (derivative 0 at 0).
    fn sqrt(self) -> Self;
    /// Sine.
    fn sin(self) -> Self;
    /// Cosine.
    fn cos(self) -> Self;
    /// x^n for constant real n (x > 0 unless n is an integer).
    fn powf(self, n: f64) -> Self;
    /// The larger one, with its derivative (the first on a tie).
    fn max(self, other: Self) -> Self {
        if self.value() >= other.value() { self } else { other }
    }
    /// The smaller one, with its derivative (the first on a tie).
    fn min(self, other: Self) -> Self {
        if self.value() <= other.value() { self } else { other }
    }
    /// Absolute value (derivative of the positive branch at 0).
    fn abs(self) -> Self {
        if self.value() < 0.0 { -self } else { self }
    }
    /// Logistic sigmoid.
    fn sigmoid(self) -> Self {
        Self::of(1.0) / (Self::of(1.0) + (-self).exp())
    }
}

impl Real for f64 {
    fn of(v: f64) -> Self {
        v
    }
    fn value(self) -> f64 {
        self
    }
    fn exp(self) -> Self {
        f64::exp(self)
    }
    fn ln(self) -> Self {
        f64::ln(self)
    }
    fn sqrt(self) -> Self {
        f64::sqrt(self)
    }
    fn sin(self) -> Self {
        f64::sin(self)
    }
    fn cos(self) -> Self {
        f64::cos(self)
    }
    fn powf(self, n: f64) -> Self {
        f64::powf(self, n)
    }
}

/// A dual number `v + d·ε` with ε² = 0: forward-mode differentiation in f64.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dual {
    /// Value.
    pub v: f64,
    /// Derivative.
    pub d: f64,
}

impl Dual {
    /// A dual number with value `v` and derivative `d`.
    pub fn new(v: f64, d: f64) -> Self {
        Self { v, d }
    }
}

impl Add for Dual {
    type Output = Self;
    fn add(self, o: Self) -> Self {
        Self::new(self.v + o.v, self.d + o.d)
    }
}
impl AddAssign for Dual {
    fn add_assign(&mut self, o: Self) {
        *self = *self + o;
    }
}
impl Sub for Dual {
    type Output = Self;
    fn sub(self, o: Self) -> Self {
        Self::new(self.v - o.v, self.d - o.d)
    }
}
impl Mul for Dual {
    type Output = Self;
    fn mul(self, o: Self) -> Self {
        Self::new(self.v * o.v, self.d * o.v + self.v * o.d)
    }
}
impl Div for Dual {
    type Output = Self;
    fn div(self, o: Self) -> Self {
        let q = self.v / o.v;
        Self::new(q, (self.d - q * o.d) / o.v)
    }
}
impl Neg for Dual {
    type Output = Self;
    fn neg(self) -> Self {
        Self::new(-self.v, -self.d)
    }
}

impl Real for Dual {
    fn of(v: f64) -> Self {
        Self::new(v, 0.0)
    }
    fn value(self) -> f64 {
        self.v
    }
    fn exp(self) -> Self {
        let e = self.v.exp();
        Self::new(e, self.d * e)
    }
    fn ln(self) -> Self {
        Self::new(self.v.ln(), self.d / self.v)
    }
    fn sqrt(self) -> Self {
        let r = self.v.sqrt();
        Self::new(r, if r > 0.0 { 0.5 * self.d / r } else { 0.0 })
    }
    fn sin(self) -> Self {
        Self::new(self.v.sin(), self.d * self.v.cos())
    }
    fn cos(self) -> Self {
        Self::new(self.v.cos(), -self.d * self.v.sin())
    }
    fn powf(self, n: f64) -> Self {
        Self::new(self.v.powf(n), if n == 0.0 { 0.0 } else { self.d * n * self.v.powf(n - 1.0) })
    }
}

/// The gradient of `f` at `x` by one dual evaluation per input.
pub fn gradient(f: impl Fn(&[Dual]) -> Dual, x: &[f64]) -> Vec<f64> {
    (0..x.len())
        .map(|i| {
            let seeded: Vec<Dual> =
                x.iter().enumerate().map(|(j, &v)| Dual::new(v, if i == j { 1.0 } else { 0.0 })).collect();
            f(&seeded).d
        })
        .collect()
}

/// J·ẋ: the derivative of the vector function `f` at `x` in the direction `tangent`, by one dual evaluation.
pub fn jvp(f: impl Fn(&[Dual]) -> Vec<Dual>, x: &[f64], tangent: &[f64]) -> Vec<f64> {
    assert_eq!(x.len(), tangent.len(), "jvp: point and tangent of different length");
    let seeded: Vec<Dual> = x.iter().zip(tangent).map(|(&v, &d)| Dual::new(v, d)).collect();
    f(&seeded).iter().map(|y| y.d).collect()
}

/// Jᵀ·ū: the gradient of Σ ūᵢ·fᵢ(x), by one dual evaluation per input. What a hand-written `pull` must return.
pub fn vjp(f: impl Fn(&[Dual]) -> Vec<Dual>, x: &[f64], cotangent: &[f64]) -> Vec<f64> {
    gradient(
        |x| {
            let y = f(x);
            assert_eq!(y.len(), cotangent.len(), "vjp: cotangent and output of different length");
            y.iter().zip(cotangent).fold(Dual::of(0.0), |sum, (&y, &u)| sum + y * Dual::of(u))
        },
        x,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    type Binary<R> = fn(R, R) -> R;

    /// Every operation of the trait, as functions of two positive numbers.
    fn operations<R: Real>() -> Vec<(&'static str, Binary<R>)> {
        vec![
            ("add", |a, b| a + b),
            ("add_assign", |a, b| {
                let mut s = a;
                s += b;
                s
            }),
            ("sub", |a, b| a - b),
            ("mul", |a, b| a * b),
            ("div", |a, b| a / b),
            ("neg", |a, b| -(a * b)),
            ("exp", |a, b| (a - b).exp()),
            ("ln", |a, b| (a * b).ln()),
            ("sqrt", |a, b| (a * b).sqrt()),
            ("sin", |a, b| (a * b).sin()),
            ("cos", |a, b| (a * b).cos()),
            ("powf", |a, b| (a * b).powf(2.4)),
            ("powf negative", |a, b| (a * b).powf(-1.5)),
            ("powf integer of a negative", |a, b| (-a * b).powf(3.0)),
            ("max", |a, b| (a * a).max(b)),
            ("min", |a, b| (a * a).min(b)),
            ("abs", |a, b| (a - b).abs()),
            ("sigmoid", |a, b| (a - b).sigmoid()),
        ]
    }

    /// Worst relative gap between the dual derivative and a central difference in f64 (good to about 1e-9).
    fn gap(dual: impl Fn(Dual, Dual) -> Dual, plain: impl Fn(f64, f64) -> f64, a: f64, b: f64) -> f64 {
        let h = 1e-5;
        let numeric =
            [(plain(a + h, b) - plain(a - h, b)) / (2.0 * h), (plain(a, b + h) - plain(a, b - h)) / (2.0 * h)];
        let exact = gradient(|x| dual(x[0], x[1]), &[a, b]);
        let value = (dual(Dual::of(a), Dual::of(b)).v - plain(a, b)).abs();
        crate::adjoint::worst_relative(&exact, &numeric, 1.0).max(value)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        #[test]
        fn every_operation_agrees_with_central_differences(a in 0.3f64..2.5, b in 0.3f64..2.5) {
            // Not within a step of the kinks of max, min and abs.
            prop_assume!((a * a - b).abs() > 1e-3 && (a - b).abs() > 1e-3);
            for ((name, dual), (_, plain)) in operations::<Dual>().into_iter().zip(operations::<f64>()) {
                let gap = gap(dual, plain, a, b);
                prop_assert!(gap <= 1e-7, "{name} at ({a}, {b}): {gap:e}");
            }
        }
    }

    /// The comparison above notices a derivative that is wrong by one part in a thousand, of the wrong sign, or lost.
    #[test]
    fn planted_errors_are_noticed() {
        let broken: [(Binary<Dual>, &str); 3] = [
            (|a, b| Dual::new((a * b).v.exp(), (a * b).exp().d * 1.001), "scaled"),
            (|a, b| Dual::new((a * b).v.exp(), -(a * b).exp().d), "negated"),
            (|a, b| Dual::new((a * b).v.exp(), (a * Dual::of(b.v)).d * (a * b).v.exp()), "one input forgotten"),
        ];
        for (dual, name) in broken {
            assert!(gap(dual, |a, b| (a * b).exp(), 0.8, 1.3) > 1e-4, "{name} went unnoticed");
        }
    }

    #[test]
    fn jvp_and_vjp_are_transposes() {
        let f = |x: &[Dual]| vec![x[0] * x[1], x[1].sin(), x[0].exp() / x[1]];
        let (x, tangent, cotangent) = ([0.4, 1.7], [0.3, -2.0], [1.0, -0.5, 0.25]);
        let forward = jvp(f, &x, &tangent);
        let reverse = vjp(f, &x, &cotangent);
        assert!(crate::adjoint::adjoint_gap(&cotangent, &forward, &reverse, &tangent) <= 1e-14);
    }

    #[test]
    fn kinks_have_the_documented_derivative() {
        assert_eq!(gradient(|x| x[0].sqrt(), &[0.0]), vec![0.0]);
        assert_eq!(gradient(|x| x[0].abs(), &[0.0]), vec![1.0]);
        assert_eq!(gradient(|x| x[0].max(x[1]), &[1.0, 1.0]), vec![1.0, 0.0]);
        assert_eq!(gradient(|x| x[0].powf(0.0), &[0.0]), vec![0.0]);
    }
}
