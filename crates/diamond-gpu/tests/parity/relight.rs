//! Pictures under many lights from one projection on the device, against the CPU's renderer.
use crate::compare::relative_l2;
use crate::steps::{self, FITTED, MEDIUM, MLP, SCENARIOS, Scenario};
use diamond_gpu::{Device, DeviceRelighter};
use diamond_image::Image;
use diamond_light::OlatLight;
use diamond_reconstruct::Renderer;
use glam::Vec3;
use std::sync::Arc;

/// More than are blended together, point lights and one at infinity.
fn lights() -> Vec<OlatLight> {
    let shots = steps::shots(2);
    let mut lights = shots.lights;
    for k in 0..3 {
        let position = Vec3::new(k as f32 - 1.0, 1.5, -2.5 + k as f32);
        lights.push(OlatLight::Point { position, intensity: Vec3::new(0.5, 1.0, 2.0) });
    }
    lights
}

/// Pictures of a scenario's model, by the CPU and by the device.
fn pictures(device: &Arc<Device>, scenario: &Scenario) -> Result<[Vec<Image>; 2], String> {
    let model = steps::model(scenario)?;
    let (camera, lights) = (steps::shots(1).cameras[0], lights());
    let cpu = Renderer::new(&model).radiance(&camera, &lights).map_err(|e| e.to_string())?;
    let relighter = DeviceRelighter::new(device.clone()).map_err(|e| e.to_string())?;
    let (renderer, lacking) = Renderer::new(&model).with_lights_together(4).relight_by(Box::new(relighter));
    if let Some(lacking) = lacking {
        return Err(format!("the device lacks {lacking}"));
    }
    let found = renderer.radiance(&camera, &lights).map_err(|e| e.to_string())?;
    let mut again = Vec::new();
    let see = |_, image: &Image| -> Result<(), diamond_reconstruct::ReconstructError> {
        again.push(image.clone());
        Ok(())
    };
    renderer.each_radiance(&camera, &lights, see).map_err(|e| e.to_string())?;
    if found != again {
        return Err("the second time pictures have other bits".into());
    }
    Ok([cpu, found])
}

/// Every picture agrees to 1e-5.
pub fn agrees(device: &Arc<Device>) -> Result<(), String> {
    let mut worst = 0.0f64;
    for scenario in [&MLP, &MEDIUM, &FITTED, &SCENARIOS[5], &SCENARIOS[6]] {
        let [expected, found] = pictures(device, scenario)?;
        for (k, (a, b)) in found.iter().zip(&expected).enumerate() {
            let error = relative_l2(a.data(), b.data());
            if error > 1e-5 || b.data().iter().all(|v| *v == 0.0) {
                return Err(format!("{}, light {k}: relative error {error:.2e}", scenario.name));
            }
            worst = worst.max(error);
        }
        if found.len() != lights().len() {
            return Err(format!("{} pictures", found.len()));
        }
    }
    println!("parity: relit: {worst:.1e}");
    Ok(())
}
