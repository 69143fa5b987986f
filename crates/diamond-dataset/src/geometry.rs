//! True geometry of rendered captures, for evaluation only: no reconstruction may look at it.
use crate::{DatasetError, Place, View};
use diamond_image::Image;
use exr::prelude::{
    AnyChannel, AnyChannels, Encoding, FlatSamples, Layer, LayerAttributes, MetaData, WritableImage,
    read_first_flat_layer_from_file,
};

/// Depth and normal of what each pixel sees.
#[derive(Debug, Clone, PartialEq)]
pub struct Geometry {
    /// View-space z, scene units, one channel; 0 where nothing is hit.
    pub depth: Image,
    /// World normal, three channels; 0 where nothing is hit.
    pub normal: Image,
}

impl Geometry {
    /// As an EXR file that [`View::ground_truth_geometry`] reads: the same bytes for the same geometry.
    ///
    /// # Errors
    /// Depth and normals that are not of one size, with one and three channels.
    pub fn encode(&self) -> Result<Vec<u8>, DatasetError> {
        let (width, height, _) = self.depth.shape();
        let sizes = self.depth.expect_shape((width, height, 1), "depth");
        sizes
            .and_then(|()| self.normal.expect_shape((width, height, 3), "normals"))
            .map_err(|e| DatasetError::Write { path: "geometry".into(), reason: e.to_string() })?;
        let normal = |c: usize| self.normal.data().iter().skip(c).step_by(3).copied().collect();
        let channels = [
            ("depth.z", self.depth.data().to_vec()),
            ("normal.x", normal(0)),
            ("normal.y", normal(1)),
            ("normal.z", normal(2)),
        ];
        encode_exr(width, height, channels)
    }
}

/// Channels of 32-bit floats, `width · height` numbers each, as an EXR file without loss: the same bytes for the same numbers.
///
/// # Errors
/// Numbers that the encoder refuses.
pub fn encode_exr<const N: usize>(
    width: usize,
    height: usize,
    channels: [(&str, Vec<f32>); N],
) -> Result<Vec<u8>, DatasetError> {
    let list = channels.into_iter().map(|(name, values)| AnyChannel::new(name, FlatSamples::F32(values)));
    let channels = AnyChannels::sort(list.collect());
    let layer = Layer::new((width, height), LayerAttributes::default(), Encoding::SMALL_LOSSLESS, channels);
    let mut out = std::io::Cursor::new(Vec::new());
    // On one thread: in parallel, chunks are written in the order in which they are done.
    let written = exr::prelude::Image::from_layer(layer).write().non_parallel().to_buffered(&mut out);
    written.map_err(|e| DatasetError::Write { path: "EXR".into(), reason: format!("cannot be encoded: {e}") })?;
    Ok(out.into_inner())
}

const ADVICE: &str =
    "write channels depth.z, normal.x, normal.y and normal.z, as large as the view, or remove the file";

impl View {
    /// Whether there is a file of true geometry for this view.
    pub fn has_ground_truth_geometry(&self) -> bool {
        self.geometry.is_some()
    }

    /// The true geometry of this view, from `geometry/<train|test>_<view name>.exr` in the capture's folder (channels
    /// `depth.z`, `normal.x`, `normal.y`, `normal.z`); `None` where there is no such file.
    ///
    /// Errors: the file is no EXR, lacks a channel, has another size than the view, or holds NaN or infinity.
    pub fn ground_truth_geometry(&self) -> Result<Option<Geometry>, DatasetError> {
        let Some(path) = &self.geometry else { return Ok(None) };
        let bad = |reason: String| DatasetError::Image {
            path: path.clone(),
            named_by: Place::file(path).into(),
            reason,
            advice: ADVICE,
        };
        let (width, height) = (self.camera.intrinsics.width as usize, self.camera.intrinsics.height as usize);
        // The header first: nothing is allocated for a file that claims to be larger than the view.
        let meta =
            MetaData::read_from_file(path, false).map_err(|e| bad(format!("cannot read the EXR header ({e})")))?;
        for header in &meta.headers {
            let size = header.layer_size;
            if (size.0, size.1) != (width, height) {
                return Err(bad(format!("it is {}×{} pixels, the view {width}×{height}", size.0, size.1)));
            }
        }
        let image = read_first_flat_layer_from_file(path).map_err(|e| bad(format!("cannot decode the EXR ({e})")))?;
        let channel = |name: &str| -> Result<Vec<f32>, DatasetError> {
            let list = &image.layer_data.channel_data.list;
            let found = list.iter().find(|c| c.name.eq(name)).ok_or_else(|| bad(format!("no channel {name}")))?;
            let values: Vec<f32> = match &found.sample_data {
                FlatSamples::F16(v) => v.iter().map(|x| x.to_f32()).collect(),
                FlatSamples::F32(v) => v.clone(),
                FlatSamples::U32(v) => v.iter().map(|&x| x as f32).collect(),
            };
            if values.len() != width * height {
                return Err(bad(format!("channel {name} has {} values", values.len())));
            }
            match values.iter().position(|v| !v.is_finite()) {
                Some(i) => Err(bad(format!("channel {name} is not finite at ({}, {})", i % width, i / width))),
                None => Ok(values),
            }
        };
        let shape = |e: diamond_image::ImageError| bad(e.to_string());
        let depth = Image::from_vec(width, height, 1, channel("depth.z")?).map_err(shape)?;
        let (x, y, z) = (channel("normal.x")?, channel("normal.y")?, channel("normal.z")?);
        let interleaved = x.iter().zip(&y).zip(&z).flat_map(|((&x, &y), &z)| [x, y, z]).collect();
        Ok(Some(Geometry { depth, normal: Image::from_vec(width, height, 3, interleaved).map_err(shape)? }))
    }
}
