//! Three numbers, or three vectors of numbers: positions, directions and colours of one pixel or of many.
use crate::number::Number;
use glam::{Mat3, Vec3};
use std::ops::{Add, Div, Mul, Sub};

/// Three components, of one pixel or of as many as [`Number`] has lanes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Vector<T> {
    pub x: T,
    pub y: T,
    pub z: T,
}

impl From<Vec3> for Vector<f32> {
    #[inline(always)]
    fn from(v: Vec3) -> Self {
        Self { x: v.x, y: v.y, z: v.z }
    }
}

impl From<Vector<f32>> for Vec3 {
    #[inline(always)]
    fn from(v: Vector<f32>) -> Self {
        Vec3::new(v.x, v.y, v.z)
    }
}

impl<T: Number> Vector<T> {
    #[inline(always)]
    pub fn new(x: T, y: T, z: T) -> Self {
        Self { x, y, z }
    }

    /// The same vector in every lane; `like` is any number.
    #[inline(always)]
    pub fn same(like: T, v: Vec3) -> Self {
        Self { x: like.same(v.x), y: like.same(v.y), z: like.same(v.z) }
    }

    #[inline(always)]
    pub fn array(self) -> [T; 3] {
        [self.x, self.y, self.z]
    }

    #[inline(always)]
    pub fn dot(self, b: Self) -> T {
        self.x * b.x + self.y * b.y + self.z * b.z
    }

    /// 1 − self, per component.
    #[inline(always)]
    pub fn complement(self) -> Self {
        Self { x: self.x.complement(), y: self.y.complement(), z: self.z.complement() }
    }

    /// Each component between `low` and `high`.
    #[inline(always)]
    pub fn within(self, low: f32, high: f32) -> Self {
        Self {
            x: self.x.at_least(low).at_most(high),
            y: self.y.at_least(low).at_most(high),
            z: self.z.at_least(low).at_most(high),
        }
    }

    /// `self` where the mask is true, else `other`.
    #[inline(always)]
    pub fn or_where_not(self, mask: T::Mask, other: Self) -> Self {
        Self {
            x: self.x.or_where_not(mask, other.x),
            y: self.y.or_where_not(mask, other.y),
            z: self.z.or_where_not(mask, other.z),
        }
    }

    /// `self` where the mask is true, else 0.
    #[inline(always)]
    pub fn only_where(self, mask: T::Mask) -> Self {
        Self { x: self.x.only_where(mask), y: self.y.only_where(mask), z: self.z.only_where(mask) }
    }

    /// m·self.
    #[inline(always)]
    pub fn rotated(self, m: &Mat3) -> Self {
        let (a, b, c) = (m.x_axis, m.y_axis, m.z_axis);
        Self {
            x: self.x * a.x + self.y * b.x + self.z * c.x,
            y: self.x * a.y + self.y * b.y + self.z * c.y,
            z: self.x * a.z + self.y * b.z + self.z * c.z,
        }
    }
}

macro_rules! componentwise {
    ($operator:ident, $method:ident) => {
        impl<T: Number> $operator for Vector<T> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, b: Self) -> Self {
                Self { x: self.x.$method(b.x), y: self.y.$method(b.y), z: self.z.$method(b.z) }
            }
        }
    };
}

macro_rules! scaled {
    ($operator:ident, $method:ident) => {
        impl<T: Number> $operator<T> for Vector<T> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, b: T) -> Self {
                Self { x: self.x.$method(b), y: self.y.$method(b), z: self.z.$method(b) }
            }
        }
    };
}

componentwise!(Add, add);
componentwise!(Sub, sub);
componentwise!(Mul, mul);
scaled!(Mul, mul);
scaled!(Div, div);
