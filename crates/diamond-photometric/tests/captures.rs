//! Translucent objects whose geometry is known: half the naive error or less, and confidence that means something.
use diamond_dataset::{Capture, OpenOptions};
use diamond_image::Image;
use diamond_light::{Falloff, OlatLight};
use diamond_photometric::*;
use glam::Vec3;

/// Median angle to the truth in degrees over three views under the first `count` lights, of estimate, naive estimate and
/// silhouette; and confidence and error of each pixel of the estimate.
fn medians(name: &str, count: usize) -> ([f32; 3], Vec<(f32, f32)>) {
    let folder = format!("{}/../../assets/captures/{name}", env!("CARGO_MANIFEST_DIR"));
    let capture = Capture::open(folder.as_ref(), &OpenOptions::default()).unwrap();
    let mut errors: [Vec<f32>; 3] = Default::default();
    let mut confident: Vec<(f32, f32)> = Vec::new();
    for view in [0, capture.train.len() / 2, capture.train.len() - 1].map(|v| &capture.train[v]) {
        let truth = view.ground_truth_geometry().unwrap().unwrap().normal;
        let shots = &view.shots[..count];
        let observations: Vec<_> = shots.iter().map(|s| capture.observation(s).unwrap()).collect();
        let images: Vec<&Image> = observations.iter().map(|o| &o.radiance).collect();
        let lights: Vec<OlatLight> = shots.iter().map(|s| s.light).collect();
        let mask = observations[0].mask.as_ref().unwrap();
        let view = PhotometricView {
            camera: &view.camera,
            mask,
            images: &images,
            lights: &lights,
            falloff: Falloff::InverseSquare { reference: 4.5 },
            distance: view.camera.pose.centre().distance(capture.scene().centre),
        };
        let found = photometric_stereo(&view, &PhotometricOptions::default()).unwrap();
        let all = [found.normals, naive_normals(&view).unwrap(), silhouette_normals(view.camera, mask).unwrap()];
        for (k, normals) in all.iter().enumerate() {
            for i in 0..mask.data().len() {
                let [n, t] = [normals, &truth].map(|m| Vec3::from_slice(&m.data()[3 * i..]));
                if mask.data()[i] > 0.99 && t.length() > 0.5 {
                    errors[k].push(n.angle_between(t).to_degrees());
                    if k == 0 {
                        confident.push((found.confidence.data()[i], n.angle_between(t).to_degrees()));
                    }
                }
            }
        }
    }
    (errors.map(median), confident)
}

fn median(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    values[values.len() / 2]
}

#[test]
fn errors_are_at_most_half_of_the_naive_ones() {
    let mut all: Vec<(f32, f32)> = Vec::new();
    for (name, lights, share) in
        [("candle-small", 6, 0.5), ("candle-small", 3, 0.5), ("jade-small", 6, 0.65), ("jade-small", 3, 0.5)]
    {
        let ([estimate, naive, silhouette], confident) = medians(name, lights);
        all.extend(confident);
        println!("{name}, {lights} lights: {estimate:.1}°, naive {naive:.1}°, silhouette {silhouette:.1}°");
        assert!(estimate <= share * naive, "{name}, {lights} lights: {estimate}° against {naive}°");
        assert!(estimate <= silhouette * if lights > 3 { 0.85 } else { 1.1 }, "{name}: {estimate}° {silhouette}°");
    }
    all.sort_by(|a, b| a.0.total_cmp(&b.0));
    let thirds: Vec<f32> =
        (0..3).map(|k| median(all[all.len() * k / 3..all.len() * (k + 1) / 3].iter().map(|p| p.1).collect())).collect();
    println!("from the least confident third to the most: {thirds:.1?}°");
    assert!(thirds[0] > thirds[1] && thirds[1] > thirds[2], "{thirds:?}");
}
