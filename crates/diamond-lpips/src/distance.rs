//! The distance itself, and its gradient with respect to one picture.
use crate::network::{Layer, Network, POOL_STRIDE};
use candle_core::{DType, Device, Tensor, Var};
use diamond_diffusion::nn::{Init, Source, Variables, VariablesBuilder, conv2d, max_pool2d};
use diamond_diffusion::published::Renamed;
use diamond_diffusion::{DiffusionError, Result, read_weights};
use diamond_image::Image;
use std::path::Path;

/// Subtracted from RGB in [−1, 1].
const SHIFT: [f64; 3] = [-0.030, -0.088, -0.188];

/// Divides what [`SHIFT`] leaves.
const SCALE: [f64; 3] = [0.458, 0.448, 0.450];

/// Added to the length of a pixel's activations, so that pixels without any stay zero.
const LENGTH_GUARD: f64 = 1e-10;

/// Added under the root of that length: without it the gradient of a pixel without activations would be 0/0. It changes lengths by
/// 1e-15 at most.
const ROOT_GUARD: f64 = 1e-30;

/// A classifier with its heads.
#[derive(Debug)]
pub struct Lpips {
    network: Network,
    layers: Vec<Layer>,
    convolutions: Vec<(Tensor, Tensor)>,
    heads: Vec<Tensor>,
}

impl Lpips {
    /// Weights from a file; anything missing, left over, or of another shape is an error.
    pub fn load(network: Network, path: &Path) -> Result<Self> {
        let builder = VariablesBuilder::new(Source::Tensors(read_weights(path)?)).frozen();
        let lpips = Self::build(network, network.layers(), &builder)?;
        builder.finish().1.into_result(&path.display().to_string())?;
        for (k, head) in lpips.heads.iter().enumerate() {
            if head.min_all()?.to_scalar::<f32>()? < 0.0 {
                let problem =
                    format!("lin{k}.weight has negative entries, and a distance cannot be negative: not LPIPS's heads");
                return Err(DiffusionError::Weights { origin: path.display().to_string(), problem });
            }
        }
        Ok(lpips)
    }

    /// Weights from the file that [`Network::variable`] names; where it names none, the reason why there is no LPIPS.
    pub fn from_environment(network: Network) -> Result<std::result::Result<Self, String>> {
        match std::env::var_os(network.variable()) {
            Some(path) => Ok(Ok(Self::load(network, Path::new(&path))?)),
            None => Ok(Err(format!(
                "no weights of {}: set {} to a safetensors file of them",
                network.name(),
                network.variable()
            ))),
        }
    }

    fn build(network: Network, layers: &[Layer], builder: &VariablesBuilder) -> Result<Self> {
        let root = builder.root();
        let (mut convolutions, mut heads) = (Vec::new(), Vec::new());
        let mut c_in = 3;
        for layer in layers {
            match *layer {
                Layer::Convolution { index, channels, kernel, .. } => {
                    let at = root.at("features").at(index);
                    let init = Init::FanIn(c_in * kernel * kernel);
                    let weight = at.weight("weight", (channels, c_in, kernel, kernel), init)?;
                    convolutions.push((weight, at.weight("bias", channels, init)?));
                    c_in = channels;
                }
                Layer::Tap => {
                    let at = root.at(format!("lin{}", heads.len()));
                    heads.push(at.weight("weight", (1, c_in, 1, 1), Init::Ones)?);
                }
                Layer::Pool { .. } => {}
            }
        }
        Ok(Self { network, layers: layers.to_vec(), convolutions, heads })
    }

    /// Activations of unit length at each tap, from pictures (batch, 3, height, width) in [−1, 1].
    fn taps(&self, pictures: &Tensor) -> Result<Vec<Tensor>> {
        let constant =
            |values: [f64; 3]| Tensor::new(&values, &Device::Cpu)?.to_dtype(pictures.dtype())?.reshape((1, 3, 1, 1));
        let mut h = pictures.broadcast_sub(&constant(SHIFT)?)?.broadcast_div(&constant(SCALE)?)?;
        let mut convolutions = self.convolutions.iter();
        let mut taps = Vec::new();
        for layer in &self.layers {
            match *layer {
                Layer::Convolution { stride, padding, .. } => {
                    let Some((weight, bias)) = convolutions.next() else { break };
                    h = conv2d(&h, weight, stride, padding)?.broadcast_add(&bias.reshape((1, (), 1, 1))?)?.relu()?;
                }
                Layer::Pool { kernel } => h = max_pool2d(&h, kernel, POOL_STRIDE)?,
                Layer::Tap => {
                    let length = (h.sqr()?.sum_keepdim(1)? + ROOT_GUARD)?.sqrt()?;
                    taps.push(h.broadcast_div(&(length + LENGTH_GUARD)?)?);
                }
            }
        }
        Ok(taps)
    }

    /// The distance of each pair of pictures (batch, 3, height, width) in [−1, 1]: (batch).
    /// `[eq:lpips]`
    pub fn distance(&self, a: &Tensor, b: &Tensor) -> Result<Tensor> {
        let side = self.network.smallest_side();
        let fits = matches!(a.dims(), [_, 3, height, width] if *height >= side && *width >= side);
        if !fits || a.dims() != b.dims() {
            return Err(DiffusionError::Shape {
                what: format!("pictures for LPIPS with {}", self.network.name()),
                expected: format!("twice [batch, 3, height, width] with sides of at least {side}"),
                found: format!("{:?} and {:?}", a.dims(), b.dims()),
            });
        }
        let mut sum = Tensor::zeros(a.dim(0)?, a.dtype(), a.device())?;
        for ((a, b), head) in self.taps(a)?.iter().zip(&self.taps(b)?).zip(&self.heads) {
            let weighed = (a - b)?.sqr()?.broadcast_mul(head)?.sum(1)?;
            sum = (sum + weighed.flatten_from(1)?.mean(1)?)?;
        }
        Ok(sum)
    }

    /// The distance of two pictures of encoded (display) RGB in [0, 1].
    pub fn value(&self, a: &Image, b: &Image) -> Result<f32> {
        Ok(self.distance(&tensor_of(a)?, &tensor_of(b)?)?.sum_all()?.to_scalar()?)
    }

    /// [`Lpips::value`] and its gradient with respect to `a`, of `a`'s shape.
    pub fn value_and_grad(&self, a: &Image, b: &Image) -> Result<(f32, Image)> {
        let var = Var::from_tensor(&tensor_of(a)?)?;
        let distance = self.distance(&var, &tensor_of(b)?)?.sum_all()?;
        let gradients = distance.backward()?;
        let missing = || DiffusionError::NonFinite { what: "gradient of LPIPS".into() };
        // The picture is 2·a − 1.
        let d_a = (gradients.get(&var).ok_or_else(missing)? * 2.0)?.squeeze(0)?.permute((1, 2, 0))?.contiguous()?;
        let (width, height, channels) = a.shape();
        let d_a = Image::from_vec(width, height, channels, d_a.flatten_all()?.to_vec1()?);
        Ok((distance.to_scalar()?, d_a.map_err(|_| missing())?))
    }
}

impl Network {
    /// Names and shapes of its weights, without memory for them.
    pub fn shapes(self) -> Result<Variables> {
        let builder = VariablesBuilder::new(Source::Shapes);
        Lpips::build(self, self.layers(), &builder)?;
        Ok(builder.finish().0)
    }

    /// What a name of torchvision's classifier, or of LPIPS's own file of heads, is here. The classifier's last layers are not used.
    pub fn rename(self, name: &str) -> Renamed {
        if name.starts_with("classifier.") || name.starts_with("scaling_layer.") {
            return Renamed::Elsewhere;
        }
        // Dropout stands before each head there.
        Renamed::As(name.replace(".model.1.", "."))
    }
}

/// (1, 3, height, width) in [−1, 1] of a picture in [0, 1].
fn tensor_of(image: &Image) -> Result<Tensor> {
    let (width, height, channels) = image.shape();
    if channels != 3 {
        return Err(DiffusionError::Shape {
            what: "picture for LPIPS".into(),
            expected: "3 channels".into(),
            found: format!("{channels}"),
        });
    }
    if let Some((x, y, _)) = image.first_non_finite() {
        return Err(DiffusionError::NonFinite { what: format!("picture for LPIPS, pixel ({x}, {y})") });
    }
    let rows = Tensor::from_slice(image.data(), (1, height, width, 3), &Device::Cpu)?;
    Ok(rows.permute((0, 3, 1, 2))?.contiguous()?.to_dtype(DType::F32)?.affine(2.0, -1.0)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use diamond_diffusion::{Noise, NumberType, write_weights};

    /// A classifier of the published form with a thirty-second of the channels and drawn weights.
    fn narrow(network: Network, dtype: DType) -> Lpips {
        let narrowed = network.layers().iter().map(|layer| match *layer {
            Layer::Convolution { index, channels, kernel, stride, padding } => {
                Layer::Convolution { index, channels: channels / 32, kernel, stride, padding }
            }
            other => other,
        });
        let layers: Vec<Layer> = narrowed.collect();
        let builder = VariablesBuilder::new(Source::Seed(3)).dtype(dtype).frozen();
        let mut lpips = Lpips::build(network, &layers, &builder).unwrap();
        for (k, head) in lpips.heads.iter_mut().enumerate() {
            let drawn = Noise::new(1, "head", k as u64).normal_tensor(head.shape(), &Device::Cpu).unwrap();
            *head = drawn.abs().unwrap().to_dtype(dtype).unwrap();
        }
        lpips
    }

    fn picture(name: &str, side: usize) -> Image {
        let mut noise = Noise::new(2, name, 0);
        Image::from_vec(side, side, 3, (0..3 * side * side).map(|_| noise.uniform()).collect()).unwrap()
    }

    /// The definition, with loops.
    fn by_hand(lpips: &Lpips, pictures: [&Image; 2]) -> f64 {
        let layers = &lpips.layers;
        let side = pictures[0].width();
        let mut planes = pictures.map(|image| {
            let at = |c: usize, p: usize| (2.0 * f64::from(image.data()[p * 3 + c]) - 1.0 - SHIFT[c]) / SCALE[c];
            (0..3).map(|c| (0..side * side).map(|p| at(c, p)).collect()).collect::<Vec<Vec<f64>>>()
        });
        let (mut side, mut sum, mut convolution, mut head) = (side, 0.0, 0, 0);
        for layer in layers {
            match *layer {
                Layer::Convolution { channels, kernel, stride, padding, .. } => {
                    let (weight, bias) = &lpips.convolutions[convolution];
                    let weight: Vec<f64> = weight.flatten_all().unwrap().to_vec1().unwrap();
                    let bias: Vec<f64> = bias.to_vec1().unwrap();
                    let out = (side + 2 * padding - kernel) / stride + 1;
                    planes = planes.map(|planes| {
                        let value = |o: usize, y: usize, x: usize| {
                            let mut sum = bias[o];
                            for (i, plane) in planes.iter().enumerate() {
                                for (ky, kx) in (0..kernel * kernel).map(|k| (k / kernel, k % kernel)) {
                                    let (row, column) = (y * stride + ky, x * stride + kx);
                                    let inside = padding..side + padding;
                                    if inside.contains(&row) && inside.contains(&column) {
                                        let w = weight[((o * planes.len() + i) * kernel + ky) * kernel + kx];
                                        sum += w * plane[(row - padding) * side + column - padding];
                                    }
                                }
                            }
                            sum.max(0.0)
                        };
                        let plane = |o| (0..out * out).map(|p| value(o, p / out, p % out)).collect();
                        (0..channels).map(plane).collect()
                    });
                    (side, convolution) = (out, convolution + 1);
                }
                Layer::Pool { kernel } => {
                    let out = (side - kernel) / 2 + 1;
                    planes = planes.map(|planes| {
                        let largest = |plane: &Vec<f64>, p: usize| {
                            let (y, x) = (2 * (p / out), 2 * (p % out));
                            let window = (0..kernel * kernel).map(|k| plane[(y + k / kernel) * side + x + k % kernel]);
                            window.fold(f64::MIN, f64::max)
                        };
                        planes.iter().map(|plane| (0..out * out).map(|p| largest(plane, p)).collect()).collect()
                    });
                    side = out;
                }
                Layer::Tap => {
                    let heads: Vec<f64> = lpips.heads[head].flatten_all().unwrap().to_vec1().unwrap();
                    for p in 0..side * side {
                        let length =
                            |planes: &Vec<Vec<f64>>| planes.iter().map(|v| v[p] * v[p]).sum::<f64>().sqrt() + 1e-10;
                        let lengths = [length(&planes[0]), length(&planes[1])];
                        for (c, head) in heads.iter().enumerate() {
                            let difference = planes[0][c][p] / lengths[0] - planes[1][c][p] / lengths[1];
                            sum += head * difference * difference / (side * side) as f64;
                        }
                    }
                    head += 1;
                }
            }
        }
        sum
    }

    /// [eq:lpips]
    #[test]
    fn value_and_gradient_are_those_of_the_definition() {
        for (network, side) in [(Network::Vgg, 17), (Network::Alex, 34)] {
            let double = narrow(network, DType::F64);
            let (a, b) = (picture("a", side), picture("b", side));
            let expected = by_hand(&double, [&a, &b]);
            let lpips = narrow(network, DType::F32);
            let (value, gradient) = lpips.value_and_grad(&a, &b).unwrap();
            assert!((f64::from(value) - expected).abs() < 1e-5 * expected, "{network:?}: {value} against {expected}");
            assert_eq!(value, lpips.value(&a, &b).unwrap());
            assert_eq!(lpips.value(&a, &a).unwrap(), 0.0);
            // Along a direction, by differences of the definition in double precision.
            let direction = picture("direction", side);
            let along: f64 = gradient.data().iter().zip(direction.data()).map(|(g, d)| f64::from(g * d)).sum();
            let double_of = |image: &Image| tensor_of(image).unwrap().to_dtype(DType::F64).unwrap();
            let at = |step: f64| {
                let moved =
                    (double_of(&a) + (double_of(&direction).affine(1.0, 1.0).unwrap() * step).unwrap()).unwrap();
                double.distance(&moved, &double_of(&b)).unwrap().to_vec1::<f64>().unwrap()[0]
            };
            let difference = (at(1e-6) - at(-1e-6)) / 2e-6;
            assert!(
                (difference - along).abs() < 1e-3 * along.abs() + 1e-6,
                "{network:?}: {difference} against {along}"
            );
        }
    }

    #[test]
    fn black_pictures_have_a_finite_gradient() {
        let mut lpips = narrow(Network::Vgg, DType::F32);
        // No pixel of the first tap has an activation.
        let (weight, bias) = &lpips.convolutions[1];
        lpips.convolutions[1] = (weight.zeros_like().unwrap(), (bias.abs().unwrap() * -1.0).unwrap());
        let (value, gradient) = lpips.value_and_grad(&Image::new(16, 16, 3), &picture("b", 16)).unwrap();
        assert!(value.is_finite() && gradient.data().iter().all(|g| g.is_finite()));
    }

    #[test]
    fn files_of_weights_are_checked() {
        let folder = std::env::temp_dir().join(format!("diamond-lpips-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("alex.safetensors");
        let builder = VariablesBuilder::new(Source::Seed(3)).frozen();
        Lpips::build(Network::Alex, Network::Alex.layers(), &builder).unwrap();
        let (variables, _) = builder.finish();
        assert_eq!(variables.parameters(), 2_469_696 + 64 + 192 + 384 + 256 + 256);
        write_weights(&path, variables.tensors(), NumberType::F16, "drawn").unwrap();
        let lpips = Lpips::load(Network::Alex, &path).unwrap();
        assert!(lpips.value(&picture("a", 32), &picture("b", 32)).unwrap() > 0.0);
        let wrong = Lpips::load(Network::Vgg, &path).unwrap_err().to_string();
        assert!(wrong.contains("not the weights of this model") && wrong.contains("missing"), "{wrong}");
        let negative = variables.get("lin2.weight").unwrap().neg().unwrap();
        let tensors = variables.tensors().map(|(n, t)| if n == "lin2.weight" { (n, &negative) } else { (n, t) });
        write_weights(&path, tensors, NumberType::F32, "broken").unwrap();
        assert!(Lpips::load(Network::Alex, &path).unwrap_err().to_string().contains("lin2.weight has negative"));
        for (a, b) in [(picture("a", 30), picture("b", 30)), (picture("a", 32), picture("b", 33))] {
            assert!(lpips.value(&a, &b).unwrap_err().to_string().contains("at least 31"));
        }
        assert!(lpips.value(&Image::new(32, 32, 1), &Image::new(32, 32, 1)).is_err());
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn absent_weights_are_absent_with_the_reason() {
        for network in [Network::Vgg, Network::Alex] {
            if std::env::var_os(network.variable()).is_none() {
                let reason = Lpips::from_environment(network).unwrap().unwrap_err();
                assert!(reason.contains(network.variable()), "{reason}");
            }
        }
        assert_eq!(Network::Vgg.shapes().unwrap().parameters(), 14_714_688 + 64 + 128 + 256 + 512 + 512);
    }
}
