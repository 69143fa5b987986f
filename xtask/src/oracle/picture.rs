//! Pictures in `.npy` files.

use diamond_image::Image;
use std::path::Path;

/// The f32 or f64 picture at `path`, height × width × channels.
///
/// # Errors
/// A message that names the file and what was expected of it.
pub fn read(path: &Path) -> Result<Image, String> {
    let err = |e: String| format!("{}: {e}", path.display());
    let bytes = std::fs::read(path).map_err(|e| err(e.to_string()))?;
    let npy = npyz::NpyFile::new(&bytes[..]).map_err(|e| err(e.to_string()))?;
    let shape: Vec<usize> = npy.shape().iter().map(|&n| n as usize).collect();
    if npy.order() != npyz::Order::C {
        return Err(err("expected row-major order, found column-major".into()));
    }
    let [height, width, channels] = shape[..] else {
        return Err(err(format!("expected height × width × channels, found {} axes", shape.len())));
    };
    let data: Vec<f32> = match npy.try_data::<f32>() {
        Ok(values) => values.collect::<Result<_, _>>().map_err(|e| err(e.to_string()))?,
        Err(npy) => {
            let values = npy.try_data::<f64>().map_err(|_| err("expected f32 or f64 values".into()))?;
            values.map(|v| v.map(|v| v as f32)).collect::<Result<_, _>>().map_err(|e| err(e.to_string()))?
        }
    };
    Image::from_vec(width, height, channels, data).map_err(|e| err(e.to_string()))
}
