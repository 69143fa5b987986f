//! tmp
use diamond_light::OlatLight;
use diamond_splat::*;
use glam::{Quat, Vec3};
use std::time::Instant;
fn main() {
    let t = read_ply(std::env::args().nth(1).unwrap()).unwrap();
    let c = |n: &str| t.column(n).unwrap().to_vec();
    let (x, y, z) = (c("x"), c("y"), c("z"));
    let (nx, ny, nz) = (c("nx"), c("ny"), c("nz"));
    let s = [c("scale_0"), c("scale_1"), c("scale_2")];
    let r = [c("rot_0"), c("rot_1"), c("rot_2"), c("rot_3")];
    let o = c("opacity");
    let mut g = Gaussians::default();
    let mut normals = vec![];
    for i in 0..x.len() {
        let q = Quat::from_xyzw(r[1][i], r[2][i], r[3][i], r[0][i]);
        g.push(Vec3::new(x[i], y[i], z[i]), Vec3::new(s[0][i].exp(), s[1][i].exp(), s[2][i].exp()), q, 1.0 / (1.0 + (-o[i]).exp()));
        normals.push(Vec3::new(nx[i], ny[i], nz[i]));
    }
    let lights: Vec<OlatLight> = (0..28).map(|i| {
        let z = 1.0 - (2 * i + 1) as f32 / 28.0;
        let (sin, cos) = (i as f32 * 2.399_963).sin_cos();
        let r = (1.0 - z * z).sqrt();
        OlatLight::Point { position: 3.5 * Vec3::new(r * cos, r * sin, z), intensity: Vec3::ONE }
    }).collect();
    let all: Vec<u32> = (0..x.len() as u32).collect();
    let config = VisibilityConfig::default();
    let bvh = GaussianBvh::build(&g).unwrap();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    pool.install(|| {
        let grid = LightGrid::new(&g, Some(&normals), &config).unwrap();
        let mut worst = 0.0f32;
        let mut sum = 0.0f64;
        for l in &lights[..4] {
            let a = bvh.visibility_subset(&g, Some(&normals), l, &config, &all).unwrap();
            let b = grid.visibility(l, &all).unwrap().unwrap();
            for (a, b) in a.iter().zip(&b) { worst = worst.max((a - b).abs()); sum += (*a - *b).abs() as f64; }
        }
        println!("worst {worst:e} mean {:e}", sum / all.len() as f64 / 4.0);
        let mut best = [f64::INFINITY; 3];
        for _ in 0..7 {
            let t = Instant::now();
            for l in &lights { std::hint::black_box(bvh.visibility_subset(&g, Some(&normals), l, &config, &all).unwrap()); }
            best[0] = best[0].min(t.elapsed().as_secs_f64());
            let t = Instant::now();
            for l in &lights { std::hint::black_box(grid.visibility(l, &all).unwrap()); }
            best[1] = best[1].min(t.elapsed().as_secs_f64());
            let t = Instant::now();
            for l in &lights { std::hint::black_box(grid.visibility(l, &all[..1]).unwrap()); }
            best[2] = best[2].min(t.elapsed().as_secs_f64());
        }
        println!("ms per light: tree {:.3} grid {:.3} grid with 1 ray {:.3}", best[0] / 28.0 * 1e3, best[1] / 28.0 * 1e3, best[2]/28.0*1e3);
    });
}
