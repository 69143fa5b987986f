//! Instruction sets: which ones the machine has, which one the program uses, and arithmetic on vectors of any width.
//!
//! A kernel is a value that implements [`WithSimd`]; [`Level::dispatch`] compiles it once per instruction set and runs the
//! variant of the process-wide choice. Inside, [`Lanes`] has the operators, and this crate the elementary functions that the
//! standard library offers for single numbers only.
//!
//! # Bits
//!
//! The kernels of this workspace are written so that a result does not depend on the number of lanes: what is computed per
//! element is the same expression at any width, and a sum over lanes is made in blocks of sixteen by a fixed tree
//! ([`Block`]). Multiplications and additions are fused ([`Lanes::mul_add`]) on every instruction set but one. It follows:
//!
//! - AVX2 + FMA, AVX-512 and NEON give the same bits as each other;
//! - [`InstructionSet::Portable`] multiplies and adds with two roundings, because fusing in software is a hundred times
//!   slower; it gives the same bits on all machines, and others than the three above.
//!
//! So `portable` is the setting for results that are identical everywhere, and any fixed one of the others for results that
//! are identical wherever that instruction set exists. Both statements are about what goes through this crate; functions
//! such as `f32::exp`, where scalar code still calls them, are the platform's.
//!
//! # Closures
//!
//! No vector operation may sit in a closure or a function without `#[inline(always)]`: it would be compiled without the
//! instruction set, and every operation in it would become a call.
//!
//! ```
//! use diamond_simd::{Lanes, Level, Simd, WithSimd, exp};
//!
//! struct Exponentials<'a>(&'a mut [f32]);
//! impl WithSimd for Exponentials<'_> {
//!     type Output = ();
//!     #[inline(always)]
//!     fn with_simd<S: Simd>(self, s: S) {
//!         let mut chunks = self.0.chunks_exact_mut(S::F32_LANES);
//!         for chunk in &mut chunks {
//!             exp(Lanes::load(s, chunk)).store(chunk);
//!         }
//!         let rest = chunks.into_remainder();
//!         exp(Lanes::load_partial(s, rest)).store_partial(rest);
//!     }
//! }
//!
//! let mut values = vec![1.0; 21];
//! Level::current().dispatch(Exponentials(&mut values));
//! assert!(values.iter().all(|v| (v - std::f32::consts::E).abs() < 1e-6));
//! ```
mod block;
mod eight;
mod elementary;
mod instruction_set;
mod lanes;
mod level;

pub use block::{BLOCK, Block, any_positive, load_block, store_block, sum_block, tree_sum};
pub use eight::{Eight, Octet, WithEight};
pub use elementary::{exp, exp2, exp2_of, exp2_of_all, ln, ln_1p_exp, log2, root_2_2, root_2_4, sigmoid, sin_cos_pi};
pub use instruction_set::{ENVIRONMENT_VARIABLE, InstructionSet, InstructionSetError, current, fix, from_environment};
pub use lanes::{Lanes, Mask};
pub use level::Level;
pub use pulp::{Scalar, Simd, WithSimd};
