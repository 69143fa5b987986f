//! Networks of all sizes by shape, and small ones by number.
use super::*;
use crate::error::Result;
use crate::nn::{Scope, Source, Variables, VariablesBuilder};
use crate::noise::Noise;
use candle_core::{DType, Device, Tensor};

fn count(build: impl Fn(&Scope<'_>) -> Result<()>) -> usize {
    let builder = VariablesBuilder::new(Source::Shapes);
    build(&builder.root()).unwrap();
    builder.finish().0.parameters()
}

fn unet_parameters(config: &UNetConfig) -> usize {
    count(|scope| UNet::new(scope, config).map(|_| ()))
}

/// Published counts: 859 520 964 of Stable Diffusion 1.5, 865 910 724 of 2.1, and 361 279 120 of the ControlNet of 1.5.
#[test]
fn large_networks_have_the_published_number_of_parameters() {
    let sd1 = UNetConfig::stable_diffusion_1();
    assert_eq!(unet_parameters(&sd1), 859_520_964);
    assert_eq!(unet_parameters(&UNetConfig::stable_diffusion_2()), 865_910_724);
    let control = |config: &ControlConfig| count(|scope| ControlNet::new(scope, config).map(|_| ()));
    let plain = ControlConfig { unet: sd1.clone(), hints: 3, hint_channels: vec![16, 32, 96, 256] };
    assert_eq!(control(&plain), 361_279_120);
    // Four more channels in: 4 · 320 · 9.
    assert_eq!(unet_parameters(&UNetConfig::marigold()), 865_910_724 + 11_520);
    let views = UNetConfig { in_channels: 8, ..sd1 };
    assert_eq!(unet_parameters(&views), 859_520_964 + 11_520);
    // Rays: (78 + 1) · 2 for each of the 29 760 channels that enter a residual block.
    let rays = UNetConfig { rays: true, ..views.clone() };
    assert_eq!(unet_parameters(&rays) - unet_parameters(&views), 4_702_080);
    // Views: 4·C² + 3·C of each of 5 transformers of 320, 5 of 640 and 6 of 1280 channels.
    assert_eq!(unet_parameters(&UNetConfig::free3d()) - unet_parameters(&rays), 49_599_040);
    // The relighter's: light to timestep and to a token, four more hints, 12 + 1 zero convolutions.
    let light = 9 * 1280 + 10 * 1024;
    assert_eq!(unet_parameters(&UNetConfig::relighter()), 865_910_724 + light);
    let relighter = ControlConfig::relighter();
    let three = ControlConfig { unet: UNetConfig::stable_diffusion_2(), hints: 3, ..relighter.clone() };
    assert_eq!(control(&relighter), control(&three) + 4 * 16 * 9 + light);
    let builder = VariablesBuilder::new(Source::Shapes);
    ControlNet::new(&builder.root(), &relighter).unwrap();
    let (variables, _) = builder.finish();
    let zero_convolutions = variables.shapes().filter(|(name, _)| name.starts_with("controlnet_down_blocks.")).count();
    assert_eq!(zero_convolutions, 2 * 12);
}

#[test]
fn small_networks_are_small() {
    let millions = |parameters: usize| parameters as f64 / 1e6;
    let relighter = millions(unet_parameters(&UNetConfig::tiny_relighter()));
    let views = millions(unet_parameters(&UNetConfig::tiny_views()));
    let config = ControlConfig::tiny_relighter(7);
    let control = millions(count(|scope| ControlNet::new(scope, &config).map(|_| ())));
    assert!((2.0..6.0).contains(&relighter) && (2.0..6.0).contains(&views), "{relighter} {views}");
    assert!((1.0..3.0).contains(&control), "{control}");
}

/// Names of the diffusers layout, as they stand in published files.
#[test]
fn names_are_those_of_published_files() {
    let builder = VariablesBuilder::new(Source::Shapes);
    UNet::new(&builder.root(), &UNetConfig::stable_diffusion_1()).unwrap();
    let (variables, _) = builder.finish();
    let shape = |name: &str| variables.get(name).unwrap_or_else(|| panic!("no {name}")).dims().to_vec();
    assert_eq!(variables.shapes().count(), 686);
    assert_eq!(shape("down_blocks.1.resnets.0.conv_shortcut.weight"), [640, 320, 1, 1]);
    assert_eq!(shape("down_blocks.2.downsamplers.0.conv.bias"), [1280]);
    assert_eq!(shape("down_blocks.0.attentions.1.proj_in.weight"), [320, 320, 1, 1]);
    assert_eq!(shape("mid_block.attentions.0.transformer_blocks.0.attn2.to_k.weight"), [1280, 768]);
    assert_eq!(shape("up_blocks.1.attentions.2.transformer_blocks.0.ff.net.0.proj.weight"), [10240, 1280]);
    assert_eq!(shape("up_blocks.1.resnets.2.conv1.weight"), [1280, 1920, 3, 3]);
    assert_eq!(shape("up_blocks.3.resnets.0.norm1.weight"), [960]);
    assert_eq!(shape("time_embedding.linear_1.weight"), [1280, 320]);
    assert_eq!(shape("conv_norm_out.weight"), [320]);
}

/// A network of all parts, as small as it can be.
fn smallest() -> UNetConfig {
    UNetConfig {
        in_channels: 3,
        out_channels: 2,
        channels: vec![4, 8],
        blocks: 1,
        attention: vec![true, true],
        heads: vec![1, 2],
        context: Some(6),
        linear_projection: false,
        groups: 2,
        rays: true,
        views: ViewAttention::AllAtLowest,
        light: Some(2),
    }
}

fn normal(name: &str, shape: &[usize]) -> Tensor {
    Noise::new(21, name, 0).normal_tensor(shape, &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap()
}

struct Inputs {
    x: Tensor,
    context: Tensor,
    rays: Tensor,
    light: Tensor,
    hints: Tensor,
}

impl Inputs {
    fn new(batch: usize) -> Self {
        Self {
            x: normal("x", &[batch, 3, 4, 6]),
            context: normal("context", &[batch, 2, 6]),
            rays: normal("rays", &[batch, RAY_CHANNELS, 4, 6]),
            light: normal("light", &[batch, LIGHT_CHANNELS]),
            hints: normal("hints", &[batch, 3, 8, 12]),
        }
    }

    fn conditions(&self) -> Conditions<'_> {
        Conditions { context: Some(&self.context), rays: Some(&self.rays), light: Some(&self.light), views: 2 }
    }
}

/// Network and ControlNet whose zeros are replaced, as after some training.
fn trained() -> (UNet, ControlNet, Variables) {
    let builder = VariablesBuilder::new(Source::Seed(5)).dtype(DType::F64);
    let control = ControlConfig { unet: smallest(), hints: 3, hint_channels: vec![4, 4] };
    let unet = UNet::new(&builder.root().at("unet"), &smallest()).unwrap();
    let control = ControlNet::new(&builder.root().at("control"), &control).unwrap();
    let (variables, _) = builder.finish();
    for (name, var) in variables.vars() {
        let moved = (var.as_tensor() + (normal(name, var.dims()) * 0.1).unwrap()).unwrap();
        var.set(&moved).unwrap();
    }
    (unet, control, variables)
}

fn loss(unet: &UNet, control: &ControlNet, inputs: &Inputs, timesteps: &[f32]) -> Tensor {
    let conditions = inputs.conditions();
    let control = control.forward(&inputs.x, timesteps, &inputs.hints, &conditions).unwrap();
    let out = unet.forward(&inputs.x, timesteps, &conditions, Some(&control)).unwrap();
    assert_eq!(out.dims(), [timesteps.len(), 2, 4, 6]);
    crate::gradient_check::weighed_sum(&out).unwrap()
}

/// Every weight has a gradient, and the derivative along a random direction of all weights at once is that of differences.
#[test]
fn every_weight_has_a_gradient_and_it_is_right() {
    let (unet, control, variables) = trained();
    let inputs = Inputs::new(4);
    let timesteps = [3.0, 700.0, 12.0, 250.0];
    let gradients = loss(&unet, &control, &inputs, &timesteps).backward().unwrap();
    let mut along = 0.0;
    let scalar = |t: Tensor| t.to_scalar::<f64>().unwrap();
    for (name, var) in variables.vars() {
        let gradient = gradients.get(var).unwrap_or_else(|| panic!("{name} has no gradient"));
        assert!(scalar(gradient.abs().unwrap().max_all().unwrap()) > 0.0, "{name} has a gradient of zeros");
        along += scalar((gradient * normal(&format!("direction of {name}"), var.dims())).unwrap().sum_all().unwrap());
    }
    let at = |step: f64| {
        for (name, var) in variables.vars() {
            let direction = (normal(&format!("direction of {name}"), var.dims()) * step).unwrap();
            var.set(&(var.as_tensor() + direction).unwrap()).unwrap();
        }
        scalar(loss(&unet, &control, &inputs, &timesteps))
    };
    let step = 1e-6;
    let (ahead, behind) = (at(step), at(-2.0 * step));
    let difference = (ahead - behind) / (2.0 * step);
    assert!((difference - along).abs() < 1e-5 * along.abs().max(1.0), "{difference} against {along}");
}

/// Without attention between views a picture does not depend on its neighbours; with it, it does, but not on other objects.
#[test]
fn views_of_one_object_see_each_other_and_no_other() {
    let (unet, control, _) = trained();
    let run = |inputs: &Inputs| {
        let (t, conditions) = ([5.0; 4], inputs.conditions());
        let control = control.forward(&inputs.x, &t, &inputs.hints, &conditions).unwrap();
        unet.forward(&inputs.x, &t, &conditions, Some(&control)).unwrap()
    };
    let inputs = Inputs::new(4);
    let before = run(&inputs);
    let mut changed = Inputs::new(4);
    let noise = Tensor::cat(&[&changed.x.narrow(0, 0, 3).unwrap(), &normal("other", &[1, 3, 4, 6])], 0).unwrap();
    changed.x = noise;
    let difference = (run(&changed) - before).unwrap().abs().unwrap();
    let moved = |i: usize| difference.get(i).unwrap().max_all().unwrap().to_scalar::<f64>().unwrap();
    assert!(moved(3) > 1e-3 && moved(2) > 1e-6, "{} {}", moved(3), moved(2));
    assert!(moved(0) == 0.0 && moved(1) == 0.0, "{} {}", moved(0), moved(1));
}

#[test]
fn a_new_control_net_changes_nothing() {
    let builder = VariablesBuilder::new(Source::Seed(5)).dtype(DType::F64);
    let config = ControlConfig { unet: smallest(), hints: 3, hint_channels: vec![4, 4] };
    let unet = UNet::new(&builder.root().at("unet"), &smallest()).unwrap();
    let control = ControlNet::new(&builder.root().at("control"), &config).unwrap();
    let inputs = Inputs::new(2);
    let residuals = control.forward(&inputs.x, &[1.0, 2.0], &inputs.hints, &inputs.conditions()).unwrap();
    let with = unet.forward(&inputs.x, &[1.0, 2.0], &inputs.conditions(), Some(&residuals)).unwrap();
    let without = unet.forward(&inputs.x, &[1.0, 2.0], &inputs.conditions(), None).unwrap();
    assert_eq!((with - without).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f64>().unwrap(), 0.0);
}

#[test]
fn what_does_not_fit_is_refused() {
    let (unet, control, _) = trained();
    let inputs = Inputs::new(2);
    let conditions = inputs.conditions();
    let refused = |x: &Tensor, t: &[f32], conditions: &Conditions<'_>| {
        unet.forward(x, t, conditions, None).unwrap_err().to_string()
    };
    assert!(refused(&inputs.x, &[1.0], &conditions).contains("noisy picture"));
    assert!(refused(&normal("odd", &[2, 3, 5, 6]), &[1.0; 2], &conditions).contains("multiples of 2"));
    assert!(refused(&inputs.x, &[1.0; 2], &Conditions { light: None, ..conditions }).contains("light code"));
    assert!(refused(&inputs.x, &[1.0; 2], &Conditions { rays: None, ..conditions }).contains("ray map"));
    assert!(refused(&inputs.x, &[1.0; 2], &Conditions { views: 3, ..conditions }).contains("views"));
    let wrong = normal("context", &[2, 2, 5]);
    assert!(refused(&inputs.x, &[1.0; 2], &Conditions { context: Some(&wrong), ..conditions }).contains("context"));
    let hints = control.forward(&inputs.x, &[1.0; 2], &inputs.x, &conditions).unwrap_err().to_string();
    assert!(hints.contains("hints"), "{hints}");
    for wrong in [
        UNetConfig { channels: vec![], ..smallest() },
        UNetConfig { channels: vec![4, 7], ..smallest() },
        UNetConfig { heads: vec![1, 3], ..smallest() },
        UNetConfig { attention: vec![true], ..smallest() },
        UNetConfig { blocks: 0, ..smallest() },
    ] {
        assert!(wrong.validate().is_err(), "{wrong:?}");
    }
}
