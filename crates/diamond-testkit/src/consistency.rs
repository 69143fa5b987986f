//! Oracle of geometric consistency between two views, pixel by pixel as the definition writes it.
use crate::Real;
use crate::camera::{project, to_camera, unproject_distance, unproject_z};
use crate::image::bilinear;

/// What a view says; images are row-major with one channel.
#[derive(Debug, Clone)]
pub struct View<R> {
    /// fx, fy, cx, cy.
    pub pinhole: [R; 4],
    /// World → camera, row-major.
    pub rotation: [[R; 3]; 3],
    /// World origin in camera coordinates.
    pub translation: [R; 3],
    /// Width and height, pixels.
    pub size: [usize; 2],
    /// Soft silhouette.
    pub silhouette: Vec<R>,
    /// Σ w·z where rendered, else a depth.
    pub depth: Vec<R>,
    /// Whether `depth` is to be divided by the silhouette.
    pub rendered: bool,
    /// Whether a depth that is not rendered is a Euclidean distance.
    pub distance: bool,
    /// What takes the silhouette's place as the label.
    pub mask: Option<Vec<f64>>,
}

/// How they are compared.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Cross-entropy, or absolute difference.
    pub bce: bool,
    /// Compare Euclidean distances.
    pub distance: bool,
    /// Interpolate 1/z.
    pub inverse: bool,
    /// Depth that counts as 0.
    pub near: f64,
    /// Depth that counts as 1.
    pub far: f64,
    /// A pixel shows the object above this.
    pub min_silhouette: f64,
    /// Relative gap from which a point is hidden.
    pub max_gap: f64,
    /// Whether the label has a derivative.
    pub label_gradient: bool,
}

/// Cost of a silhouette value where the label is `m`.
pub fn penalty<R: Real>(bce: bool, m: R, o: R) -> R {
    if !bce {
        return (m - o).abs();
    }
    let (low, high) = (1e-7, 1.0 - 1e-7);
    let o = if o.value() < low {
        R::of(low)
    } else if o.value() > high {
        R::of(high)
    } else {
        o
    };
    -(m * o.ln() + (R::of(1.0) - m) * (R::of(1.0) - o).ln())
}

impl<R: Real> View<R> {
    fn shows(&self, i: usize, s: &Settings) -> bool {
        let label = self.mask.as_ref().map_or(self.silhouette[i].value(), |m| m[i]);
        self.silhouette[i].value() > s.min_silhouette && label > s.min_silhouette
    }

    fn centre(&self, i: usize) -> [R; 2] {
        [R::of((i % self.size[0]) as f64 + 0.5), R::of((i / self.size[0]) as f64 + 0.5)]
    }

    fn world(&self, i: usize) -> [R; 3] {
        let at = self.centre(i);
        match (self.rendered, self.distance) {
            (true, _) => {
                unproject_z(self.pinhole, self.rotation, self.translation, at, self.depth[i] / self.silhouette[i])
            }
            (_, true) => unproject_distance(self.pinhole, self.rotation, self.translation, at, self.depth[i]),
            _ => unproject_z(self.pinhole, self.rotation, self.translation, at, self.depth[i]),
        }
    }

    fn z(&self, i: usize) -> R {
        to_camera(self.rotation, self.translation, self.world(i))[2]
    }

    fn known(&self, i: usize) -> bool {
        let z = self.z(i).value();
        z.is_finite() && z > 0.0
    }

    /// Share of each pixel in a bilinear sample.
    fn weights(&self, x: f64, y: f64) -> Vec<f64> {
        let [w, h] = self.size;
        let tent =
            |v: f64, i: usize, n: usize| (1.0 - ((v - 0.5).clamp(0.0, (n - 1) as f64) - i as f64).abs()).max(0.0);
        (0..w * h).map(|i| tent(x, i % w, w) * tent(y, i / w, h)).collect()
    }
}

/// Silhouette cost and depth cost of one pixel, where they count, and how far the nearest decision or kink is: a change of
/// inputs that moves things by less (in pixels, shares, silhouette) changes neither.
pub fn pixel<R: Real>(from: &View<R>, to: &View<R>, i: usize, s: &Settings) -> (Option<R>, Option<R>, f64) {
    let own = from.silhouette[i];
    let own = if s.label_gradient { own } else { R::of(own.value()) };
    let label = from.mask.as_ref().map_or(own, |m| R::of(m[i]));
    let mut margin = (from.silhouette[i].value() - s.min_silhouette).abs();
    margin = margin.min((label.value() - s.min_silhouette).abs());
    if !from.shows(i, s) || !from.known(i) {
        return (None, None, margin);
    }
    let world = from.world(i);
    let z = to_camera(to.rotation, to.translation, world)[2];
    margin = margin.min((z.value() - s.near).abs());
    if z.value() <= s.near.max(1e-6) {
        return (None, None, margin);
    }
    let [x, y, z] = project(to.pinhole, to.rotation, to.translation, world);
    let [w, h] = to.size;
    for (v, n) in [(x.value(), w), (y.value(), h)] {
        margin = margin.min((v - 0.499).abs()).min((v - (n as f64 - 0.499)).abs());
        // Pixel centres, where the slope jumps.
        let u = v - 0.5;
        if u > -1.0 && u < n as f64 {
            margin = margin.min((u - u.round()).abs());
        }
    }
    // Between the outermost pixel centres, a thousandth of a pixel more.
    let inside = |v: f64, n: usize| v >= 0.499 && v <= n as f64 - 0.499;
    if !inside(x.value(), w) || !inside(y.value(), h) {
        return (None, None, margin);
    }
    let found = bilinear(&to.silhouette, w, h, 1, x, y)[0];
    margin = margin.min((found.value() - s.min_silhouette).abs()).min((found.value() - label.value()).abs());
    let silhouette = Some(penalty(s.bce, label, found));
    let weights = to.weights(x.value(), y.value());
    let read: Vec<usize> = (0..w * h).filter(|&k| weights[k] > 0.0).collect();
    for &k in &read {
        margin = margin.min((to.silhouette[k].value() - s.min_silhouette).abs());
    }
    let whole = read.iter().all(|&k| to.silhouette[k].value() > s.min_silhouette && to.known(k));
    if found.value() <= s.min_silhouette || !whole {
        return (silhouette, None, margin);
    }
    // What is not read has weight 0; its value must only be a number.
    let depths: Vec<R> = (0..w * h)
        .map(|k| match (read.contains(&k), s.inverse) {
            (false, _) => R::of(0.0),
            (_, true) => R::of(1.0) / to.z(k),
            _ => to.z(k),
        })
        .collect();
    let sampled = bilinear(&depths, w, h, 1, x, y)[0];
    let surface = if s.inverse { R::of(1.0) / sampled } else { sampled };
    let gap = (z.value() - surface.value()).abs() / z.value();
    margin = margin.min((gap - s.max_gap).abs()).min(gap);
    if gap >= s.max_gap {
        return (silhouette, None, margin);
    }
    let length = |p: [R; 3]| (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
    let camera = |world| to_camera(to.rotation, to.translation, world);
    let (here, there) = match s.distance {
        false => (z, surface),
        true => {
            let hit = unproject_z(to.pinhole, to.rotation, to.translation, [x, y], surface);
            (length(camera(world)), length(camera(hit)))
        }
    };
    (silhouette, Some((here - there).abs() / R::of(s.far - s.near)), margin)
}

/// Mean silhouette cost and mean depth cost over the pixels where they count, 0 where there are none, and their numbers.
pub fn pair<R: Real>(from: &View<R>, to: &View<R>, pixels: &[u32], s: &Settings) -> ([R; 2], [usize; 2]) {
    let (mut sums, mut counts) = ([R::of(0.0); 2], [0; 2]);
    for &i in pixels {
        let (silhouette, depth, _) = pixel(from, to, i as usize, s);
        for (k, cost) in [silhouette, depth].into_iter().enumerate() {
            if let Some(cost) = cost {
                sums[k] += cost;
                counts[k] += 1;
            }
        }
    }
    ([0, 1].map(|k| sums[k] / R::of(counts[k].max(1) as f64)), counts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wall_seen_by_two_cameras_worked_by_hand() {
        let eye = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let view = |t: f64, depth: f64| View {
            pinhole: [4.0, 4.0, 2.0, 2.0],
            rotation: eye,
            translation: [t, 0.0, 0.0],
            size: [4, 4],
            silhouette: vec![0.8; 16],
            depth: vec![depth; 16],
            rendered: false,
            distance: false,
            mask: None,
        };
        let s = Settings {
            bce: false,
            distance: false,
            inverse: true,
            near: 1.0,
            far: 3.0,
            min_silhouette: 0.5,
            max_gap: 0.5,
            label_gradient: true,
        };
        // One pixel to the left: column 0 leaves the picture.
        let all: Vec<u32> = (0..16).collect();
        let ([silhouette, depth], counts) = pair(&view(0.0, 2.0), &view(-0.5, 1.5), &all, &s);
        assert_eq!((silhouette, depth, counts), (0.0, 0.25, [12, 12]));
        let distance = Settings { distance: true, ..s };
        // Corner (3.5, 3.5) of the second view: 0.5·√(1 + 2·0.375²)/2.
        let (_, cost, _) = pixel(&view(0.0, 2.0), &view(0.0, 1.5), 15, &distance);
        assert!((cost.unwrap() - 0.25 * (1.0f64 + 2.0 * 0.375 * 0.375).sqrt()).abs() < 1e-15);
        assert!((penalty(true, 1.0, 0.5) - std::f64::consts::LN_2).abs() < 1e-15);
    }
}
