//! Nanoseconds per element of the elementary functions, next to the standard library's.
use diamond_simd::{Lanes, Level, Simd, WithSimd, exp, ln, root_2_4, sin_cos_pi};
use divan::{Bencher, black_box, counter::ItemsCount};

const N: usize = 4096;

macro_rules! kernel {
    ($name:ident, $x:ident => $body:expr) => {
        struct $name<'a>(&'a [f32], &'a mut [f32]);
        impl WithSimd for $name<'_> {
            type Output = ();
            #[inline(always)]
            fn with_simd<S: Simd>(self, s: S) {
                for (x, y) in self.0.chunks_exact(S::F32_LANES).zip(self.1.chunks_exact_mut(S::F32_LANES)) {
                    let $x = Lanes::load(s, x);
                    $body.store(y);
                }
            }
        }
    };
}

kernel!(Exp, x => exp(x));
kernel!(Ln, x => ln(x));
kernel!(Root, x => root_2_4(x));
kernel!(Sine, x => { let (a, b) = sin_cos_pi(x); a + b });

fn inputs() -> Vec<f32> {
    (0..N).map(|i| 0.01 + i as f32 / N as f32).collect()
}

macro_rules! pair {
    ($kernel:ident, $vector:ident, $standard:ident, $f:expr) => {
        #[divan::bench]
        fn $vector(bencher: Bencher) {
            let (x, mut y) = (inputs(), vec![0.0; N]);
            bencher
                .counter(ItemsCount::new(N))
                .bench_local(|| Level::current().dispatch($kernel(black_box(&x), &mut y)));
        }

        #[divan::bench]
        fn $standard(bencher: Bencher) {
            let (x, mut y) = (inputs(), vec![0.0f32; N]);
            let f: fn(f32) -> f32 = $f;
            bencher.counter(ItemsCount::new(N)).bench_local(|| {
                for (y, x) in y.iter_mut().zip(black_box(&x)) {
                    *y = f(*x);
                }
            });
        }
    };
}

pair!(Exp, exp_vector, exp_standard, f32::exp);
pair!(Ln, ln_vector, ln_standard, f32::ln);
pair!(Root, root_2_4_vector, root_2_4_standard, |x| x.powf(1.0 / 2.4));
pair!(Sine, sin_cos_vector, sin_cos_standard, |x| {
    let (a, b) = (std::f32::consts::PI * x).sin_cos();
    a + b
});

fn main() {
    divan::main();
}
