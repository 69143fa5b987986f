//! A picture of a translucent object under three lamps, side by side.
//!
//!     cargo run --release -p diamond-pathtrace --example picture -- OUT.png [OBJECT] [SIDE] [PATHS]
//!
//! OBJECT is the number of a random object, or a file that ends in `.obj`, `.ply`, `.gltf` or `.glb`; SIDE is the width of one of the three
//! pictures in pixels, PATHS how many paths a pixel gets.
use diamond_camera::{Camera, Intrinsics, Pose};
use diamond_image::Transfer;
use diamond_pathtrace::{
    Boundary, Coat, DistanceField, Geometry, Light, Material, Medium, Mesh, ReferenceOptions, RepairOptions, Scene,
    read_gltf, read_obj, read_ply, render_reference,
};
use glam::Vec3;
use std::error::Error;
use std::path::Path;

fn object(name: &str) -> Result<Mesh, Box<dyn Error>> {
    let path = Path::new(name);
    let mesh = match path.extension().and_then(|e| e.to_str()) {
        Some("obj") => read_obj(path)?,
        Some("ply") => read_ply(path)?,
        Some("gltf" | "glb") => read_gltf(path)?.mesh,
        _ => DistanceField::random(name.parse()?).polygonise(96)?,
    };
    Ok(mesh.repair(&RepairOptions::default())?.0.fitted(Vec3::ZERO, 1.0))
}

/// A PNG file of 8-bit RGB, not compressed.
fn png(width: usize, height: usize, rgb: &[u8]) -> Vec<u8> {
    let crc = |bytes: &[u8]| {
        !bytes.iter().fold(!0u32, |crc, byte| {
            (0..8).fold(crc ^ u32::from(*byte), |c, _| if c & 1 == 1 { (c >> 1) ^ 0xedb8_8320 } else { c >> 1 })
        })
    };
    let mut file = b"\x89PNG\r\n\x1a\n".to_vec();
    let mut chunk = |kind: &[u8], data: &[u8]| {
        let body = [kind, data].concat();
        file.extend((data.len() as u32).to_be_bytes());
        file.extend(&body);
        file.extend(crc(&body).to_be_bytes());
    };
    let size = [(width as u32).to_be_bytes(), (height as u32).to_be_bytes()].concat();
    chunk(b"IHDR", &[&size[..], &[8, 2, 0, 0, 0]].concat());
    let rows: Vec<u8> = rgb.chunks_exact(3 * width).flat_map(|row| [&[0], row].concat()).collect();
    let mut data = vec![0x78, 0x01];
    let blocks: Vec<&[u8]> = rows.chunks(65535).collect();
    for (i, block) in blocks.iter().enumerate() {
        data.push(u8::from(i + 1 == blocks.len()));
        data.extend((block.len() as u16).to_le_bytes());
        data.extend((!(block.len() as u16)).to_le_bytes());
        data.extend(*block);
    }
    let (a, b) = rows.iter().fold((1u32, 0u32), |(a, b), v| {
        let a = (a + u32::from(*v)) % 65521;
        (a, (b + a) % 65521)
    });
    data.extend(((b << 16) | a).to_be_bytes());
    chunk(b"IDAT", &data);
    chunk(b"IEND", &[]);
    file
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let word = |i: usize, default: &str| arguments.get(i).cloned().unwrap_or_else(|| default.to_string());
    let out = arguments.first().ok_or("usage: picture OUT.png [OBJECT] [SIDE] [PATHS]")?;
    let (side, samples): (u32, u32) = (word(2, "192").parse()?, word(3, "128").parse()?);
    let medium =
        Medium { sigma_t: Vec3::new(6.0, 9.0, 14.0), albedo: Vec3::new(0.995, 0.98, 0.93), g: 0.4, veins: None };
    let coat = Some(Coat { roughness: 0.25, f0: Vec3::splat(0.04) });
    let lamp = |direction: Vec3| Light::directional(direction.normalize(), Vec3::splat(3.0));
    let scene = Scene {
        geometry: Geometry::from_mesh(object(&word(1, "1"))?)?,
        material: Material { medium, boundary: Boundary::IndexMatched, coat },
        lights: vec![lamp(Vec3::new(0.4, 0.6, 1.0)), lamp(Vec3::new(1.0, 0.5, -0.2)), lamp(Vec3::new(-0.2, 0.5, -1.0))],
    };
    let pose = Pose::look_at(Vec3::new(0.0, 0.8, 3.9), Vec3::ZERO, Vec3::Y);
    let camera = Camera { intrinsics: Intrinsics::from_fov_x(0.56, side, side), pose };
    let pictures = render_reference(&scene, &camera, &ReferenceOptions { samples, ..Default::default() })?;
    let side = side as usize;
    let mut rgb = vec![0u8; 3 * side * side * pictures.lights.len()];
    for (l, light) in pictures.lights.iter().enumerate() {
        for y in 0..side {
            for x in 0..side {
                let at = 3 * ((y * pictures.lights.len() + l) * side + x);
                for (k, v) in light.mean.pixel(x, y).iter().enumerate() {
                    rgb[at + k] = (255.0 * Transfer::Srgb.encode(v.clamp(0.0, 1.0)) + 0.5) as u8;
                }
            }
        }
    }
    std::fs::write(out, png(side * pictures.lights.len(), side, &rgb))?;
    Ok(())
}
