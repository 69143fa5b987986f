//! Real spherical harmonics up to degree 3 (16 coefficients), with gradient in the direction.
