//! The light control: pictures of one view under many single lights, blended in the page. Light is linear, so a weighted
//! sum of such pictures in linear light is the picture under all these lights at once.
use super::maps::data_uri;
use crate::picture::encode_png_linear;
use crate::{AtOnce, SssError, render_lights};
use diamond_camera::Camera;
use diamond_dataset::{farthest_points, light_direction};
use diamond_light::OlatLight;
use diamond_reconstruct::Model;
use glam::Vec3;
use serde_json::{Value, json};

/// At most this many lights are rendered.
const MAX_LIGHTS: usize = 24;
/// Longer side of the pictures at most, pixels.
const MAX_SIDE: u32 = 384;

/// The data of the control: a picture per light, and the light's direction in the axes of the camera (x right, y up, z
/// toward the viewer).
pub fn light_control(model: &Model, at_once: &AtOnce, camera: &Camera, rig: &[OlatLight]) -> Result<Value, SssError> {
    let centre = model.scene.centre();
    let directions: Vec<Vec3> = rig.iter().map(|l| light_direction(l, centre)).collect();
    let chosen: Vec<OlatLight> = farthest_points(&directions, MAX_LIGHTS).into_iter().map(|i| rig[i]).collect();
    let k = &camera.intrinsics;
    let longer = k.width.max(k.height);
    let camera = if longer > MAX_SIDE {
        let side = |v: u32| (v * MAX_SIDE / longer).max(1);
        camera.resized(side(k.width), side(k.height))
    } else {
        *camera
    };
    let mut lights = Vec::new();
    render_lights(&at_once.renderer(model), &camera, &chosen, |i, picture| {
        let d = camera.pose.rotation * light_direction(&chosen[i], centre);
        lights.push(json!({
            "direction": [d.x, -d.y, -d.z],
            "picture": data_uri(&encode_png_linear(picture)?),
        }));
        Ok(())
    })?;
    Ok(json!({ "width": camera.intrinsics.width, "height": camera.intrinsics.height, "lights": lights }))
}
