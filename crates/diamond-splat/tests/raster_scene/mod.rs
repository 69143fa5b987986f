//! Random scenes for the rasteriser's tests, as our types and as the oracle's.
#![allow(dead_code)]
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_splat::{Cutoff, Features, Gaussians, RasterConfig, RasterGrad, RasterPull, rasterize};
use diamond_testkit::splat::{SplatCamera, SplatRules};
use glam::{Quat, Vec3};

/// SplitMix64.
pub struct Random(pub u64);

impl Random {
    pub fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 40) as f64 / (1u64 << 24) as f64
    }

    pub fn signed(&mut self) -> f64 {
        2.0 * self.unit() - 1.0
    }
}

pub struct Case {
    pub gaussians: Gaussians,
    pub features: Features,
    pub camera: Camera,
    pub config: RasterConfig,
}

impl Case {
    /// Gaussians of all shapes before an oblique camera with an off-centre principal point; some lie behind the near
    /// plane, some beyond the image's border, some quaternions are far from unit length.
    pub fn random(seed: u64, n: usize, channels: usize, cutoff: Cutoff) -> Self {
        let mut r = Random(seed);
        let mut gaussians = Gaussians::default();
        let mut features = Features { channels, data: Vec::new() };
        for _ in 0..n {
            let mean = Vec3::new(r.signed() as f32, r.signed() as f32, 0.8 * r.signed() as f32);
            let scale = Vec3::from_array(std::array::from_fn(|_| (-4.5 + 3.0 * r.unit()).exp() as f32));
            let q: [f32; 4] = std::array::from_fn(|_| (0.2 + 2.0 * r.unit()) as f32 * r.signed() as f32);
            gaussians.push(mean, scale, Quat::from_array(q), (0.02 + 0.979 * r.unit()) as f32);
            features.data.extend((0..channels).map(|_| r.signed() as f32));
        }
        let eye = Vec3::new(1.3 * r.signed() as f32, r.signed() as f32, -1.6);
        let pose = Pose::look_at(eye, Vec3::new(0.1, -0.05, 0.0), Vec3::new(0.2, 1.0, 0.1));
        let intrinsics = Intrinsics { fx: 24.0, fy: 21.0, cx: 9.3, cy: 11.6, width: 23, height: 19 };
        let config = RasterConfig { cutoff, near: 1.2, ..Default::default() };
        Self { gaussians, features, camera: Camera { intrinsics, pose }, config }
    }

    /// For each Gaussian: mean, scale, rotation xyzw, opacity, features.
    pub fn parameters(&self) -> Vec<f64> {
        let g = &self.gaussians;
        (0..g.len())
            .flat_map(|i| {
                let mut row: Vec<f32> = g.means[i].to_array().to_vec();
                row.extend(g.scales[i].to_array());
                row.extend(g.rotations[i].to_array());
                row.push(g.opacities[i]);
                row.extend(self.features.row(i));
                row
            })
            .map(f64::from)
            .collect()
    }

    pub fn oracle_camera(&self) -> SplatCamera {
        let k = &self.camera.intrinsics;
        let r = self.camera.pose.rotation.to_cols_array_2d();
        SplatCamera {
            rotation: std::array::from_fn(|row| std::array::from_fn(|col| r[col][row] as f64)),
            translation: self.camera.pose.translation.to_array().map(f64::from),
            focal: [k.fx as f64, k.fy as f64],
            centre: [k.cx as f64, k.cy as f64],
            size: [k.width as usize, k.height as usize],
        }
    }

    pub fn rules(&self) -> SplatRules {
        SplatRules {
            low_pass: self.config.low_pass as f64,
            max_alpha: self.config.max_alpha as f64,
            min_alpha: self.config.min_alpha as f64,
            min_transmittance: self.config.min_transmittance as f64,
            near: self.config.near as f64,
            smooth: self.config.cutoff == Cutoff::Smooth,
        }
    }

    /// The picture in the oracle's layout.
    pub fn render(&self) -> Vec<f64> {
        let (raster, _) = rasterize(&self.gaussians, &self.features, &self.camera, &self.config).unwrap();
        let mut out = Vec::new();
        for i in 0..raster.opacity.pixels() {
            let c = self.features.channels;
            out.extend(raster.features.data()[i * c..(i + 1) * c].iter().map(|&v| v as f64));
            out.push(raster.opacity.data()[i] as f64);
            out.push(raster.depth.data()[i] as f64);
        }
        out
    }

    /// A cotangent in the oracle's layout, of values that f32 represents.
    pub fn random_cotangent(&self, r: &mut Random) -> Vec<f64> {
        let k = &self.camera.intrinsics;
        let count = (k.width * k.height) as usize * (self.features.channels + 2);
        (0..count).map(|_| r.signed() as f32 as f64).collect()
    }

    pub fn pull_images(&self, u: &[f64]) -> RasterPull {
        let k = &self.camera.intrinsics;
        let c = self.features.channels;
        let mut d = RasterGrad::zeros(k.width as usize, k.height as usize, c);
        for (i, pixel) in u.chunks(c + 2).enumerate() {
            for j in 0..c {
                d.features.data_mut()[i * c + j] = pixel[j] as f32;
            }
            d.opacity.data_mut()[i] = pixel[c] as f32;
            d.depth.data_mut()[i] = pixel[c + 1] as f32;
        }
        let (_, pullback) = rasterize(&self.gaussians, &self.features, &self.camera, &self.config).unwrap();
        pullback.pull(&d).unwrap()
    }

    /// The gradient in the order of [`Case::parameters`].
    pub fn pull(&self, u: &[f64]) -> Vec<f64> {
        let pull = self.pull_images(u);
        let (g, c) = (&pull.gaussians, self.features.channels);
        (0..g.len())
            .flat_map(|i| {
                let mut row: Vec<f32> = g.means[i].to_array().to_vec();
                row.extend(g.scales[i].to_array());
                row.extend(g.rotations[i].to_array());
                row.push(g.opacities[i]);
                row.extend(&pull.features[i * c..(i + 1) * c]);
                row
            })
            .map(f64::from)
            .collect()
    }
}
