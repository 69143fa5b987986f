//! A scalar trait that `f64` and dual numbers share, so that one oracle gives values and derivatives.
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
