//! Names of the original (LDM) layout.
//!
//! Blocks are counted through all levels there: `input_blocks.0` is the first convolution, then each level has its residual blocks and
//! one more for the change of resolution; `output_blocks` has no such extra one, the change stands last inside the level's last block.
use super::comparison::Renamed;
use crate::unet::{ControlConfig, UNetConfig};

/// Prefixes of the parts of a whole published file.
const PARTS: [&str; 7] = [
    "model.diffusion_model.",
    "first_stage_model.",
    "cond_stage_model.",
    "control_model.",
    "model_ema.",
    "conditioner.",
    "cc_projection.",
];

/// Buffers of the training schedule that are stored beside weights.
const BUFFERS: [&str; 6] = ["betas", "alphas_cumprod", "sqrt_", "log_one_minus", "posterior_", "logvar"];

/// The part of a name behind `prefix`; names of other parts are theirs, names without any part stay.
fn inside<'a>(name: &'a str, prefix: &str) -> Result<&'a str, Renamed> {
    if let Some(rest) = name.strip_prefix(prefix) {
        return Ok(rest);
    }
    let elsewhere = PARTS.iter().any(|part| name.starts_with(part)) || BUFFERS.iter().any(|b| name.starts_with(b));
    if elsewhere { Err(Renamed::Elsewhere) } else { Ok(name) }
}

/// A leading number and what follows it.
fn number(text: &str) -> Option<(usize, &str)> {
    let (digits, rest) = text.split_once('.')?;
    Some((digits.parse().ok()?, rest))
}

/// Names inside a residual block.
fn residual(rest: &str) -> Option<String> {
    const PAIRS: [(&str, &str); 6] = [
        ("in_layers.0.", "norm1."),
        ("in_layers.2.", "conv1."),
        ("emb_layers.1.", "time_emb_proj."),
        ("out_layers.0.", "norm2."),
        ("out_layers.3.", "conv2."),
        ("skip_connection.", "conv_shortcut."),
    ];
    PAIRS.iter().find_map(|(theirs, ours)| Some(format!("{ours}{}", rest.strip_prefix(theirs)?)))
}

/// A residual block (0) or a transformer (1) of `block`.
fn stage(block: &str, index: usize, rest: &str) -> Option<String> {
    match number(rest)? {
        (0, rest) => Some(format!("{block}.resnets.{index}.{}", residual(rest)?)),
        (1, rest) => Some(format!("{block}.attentions.{index}.{rest}")),
        _ => None,
    }
}

/// The way down and the middle, which UNet and ControlNet share.
fn encoder(rest: &str, config: &UNetConfig) -> Option<String> {
    let per_level = config.blocks + 1;
    if let Some(rest) = rest.strip_prefix("time_embed.") {
        return match number(rest)? {
            (0, rest) => Some(format!("time_embedding.linear_1.{rest}")),
            (2, rest) => Some(format!("time_embedding.linear_2.{rest}")),
            _ => None,
        };
    }
    if let Some(rest) = rest.strip_prefix("middle_block.") {
        return match number(rest)? {
            (0, rest) => Some(format!("mid_block.resnets.0.{}", residual(rest)?)),
            (1, rest) => Some(format!("mid_block.attentions.0.{rest}")),
            (2, rest) => Some(format!("mid_block.resnets.1.{}", residual(rest)?)),
            _ => None,
        };
    }
    let (block, rest) = number(rest.strip_prefix("input_blocks.")?)?;
    let Some(block) = block.checked_sub(1) else {
        return Some(format!("conv_in.{}", rest.strip_prefix("0.")?));
    };
    let (level, index) = (block / per_level, block % per_level);
    if index == config.blocks {
        return Some(format!("down_blocks.{level}.downsamplers.0.conv.{}", rest.strip_prefix("0.op.")?));
    }
    stage(&format!("down_blocks.{level}"), index, rest)
}

fn decoder(rest: &str, config: &UNetConfig) -> Option<String> {
    let per_level = config.blocks + 1;
    if let Some(rest) = rest.strip_prefix("out.") {
        return match number(rest)? {
            (0, rest) => Some(format!("conv_norm_out.{rest}")),
            (2, rest) => Some(format!("conv_out.{rest}")),
            _ => None,
        };
    }
    let (block, rest) = number(rest.strip_prefix("output_blocks.")?)?;
    let (level, index) = (block / per_level, block % per_level);
    let attention = *config.attention.iter().rev().nth(level)?;
    // The change of resolution stands behind the transformer, or in its place.
    match number(rest)? {
        (2, rest) if attention => Some(format!("up_blocks.{level}.upsamplers.0.{rest}")),
        (1, rest) if !attention => Some(format!("up_blocks.{level}.upsamplers.0.{rest}")),
        _ => stage(&format!("up_blocks.{level}"), index, rest),
    }
}

/// A name of a UNet.
pub(super) fn unet(name: &str, config: &UNetConfig, prefix: &str) -> Renamed {
    match inside(name, prefix) {
        Err(elsewhere) => elsewhere,
        Ok(rest) => Renamed::As(encoder(rest, config).or_else(|| decoder(rest, config)).unwrap_or_else(|| rest.into())),
    }
}

/// A name of a ControlNet.
pub(super) fn control(name: &str, config: &ControlConfig) -> Renamed {
    let rest = match inside(name, "control_model.") {
        Err(elsewhere) => return elsewhere,
        Ok(rest) => rest,
    };
    let own = || {
        if let Some(rest) = rest.strip_prefix("zero_convs.") {
            let (index, rest) = number(rest)?;
            return Some(format!("controlnet_down_blocks.{index}.{}", rest.strip_prefix("0.")?));
        }
        if let Some(rest) = rest.strip_prefix("middle_block_out.0.") {
            return Some(format!("controlnet_mid_block.{rest}"));
        }
        // Convolutions stand at even numbers, activations between them.
        let (index, rest) = number(rest.strip_prefix("input_hint_block.")?)?;
        let last = 2 * (2 * (config.hint_channels.len() - 1) + 1);
        Some(match index {
            0 => format!("controlnet_cond_embedding.conv_in.{rest}"),
            index if index == last => format!("controlnet_cond_embedding.conv_out.{rest}"),
            index => format!("controlnet_cond_embedding.blocks.{}.{rest}", (index / 2).checked_sub(1)?),
        })
    };
    Renamed::As(own().or_else(|| encoder(rest, &config.unet)).unwrap_or_else(|| rest.into()))
}

/// A name of the autoencoder; also the first diffusers names of its attention.
pub(super) fn autoencoder(name: &str) -> Renamed {
    let rest = match inside(name, "first_stage_model.") {
        Err(elsewhere) => return elsewhere,
        Ok(rest) => rest,
    };
    if rest.starts_with("loss.") {
        return Renamed::Elsewhere;
    }
    Renamed::As(autoencoder_part(rest).unwrap_or_else(|| rest.into()))
}

fn autoencoder_part(rest: &str) -> Option<String> {
    /// Levels of the published autoencoder.
    const LEVELS: usize = 4;
    let (part, rest) = rest.split_once('.').filter(|(part, _)| ["encoder", "decoder"].contains(part))?;
    let attention = |rest: &str| {
        const PAIRS: [(&str, &str); 9] = [
            ("norm.", "group_norm."),
            ("q.", "to_q."),
            ("k.", "to_k."),
            ("v.", "to_v."),
            ("proj_out.", "to_out.0."),
            ("query.", "to_q."),
            ("key.", "to_k."),
            ("value.", "to_v."),
            ("proj_attn.", "to_out.0."),
        ];
        PAIRS.iter().find_map(|(theirs, ours)| Some(format!("{ours}{}", rest.strip_prefix(theirs)?)))
    };
    if let Some(rest) = rest.strip_prefix("mid.") {
        let (block, rest) = rest.split_once('.')?;
        return Some(match block {
            "block_1" => format!("{part}.mid_block.resnets.0.{rest}"),
            "attn_1" => format!("{part}.mid_block.attentions.0.{}", attention(rest)?),
            "block_2" => format!("{part}.mid_block.resnets.1.{rest}"),
            _ => return None,
        });
    }
    if let Some(rest) = rest.strip_prefix("mid_block.attentions.0.") {
        return Some(format!("{part}.mid_block.attentions.0.{}", attention(rest)?));
    }
    if let Some(rest) = rest.strip_prefix("norm_out.") {
        return Some(format!("{part}.conv_norm_out.{rest}"));
    }
    let (blocks, level, rest) = match (rest.strip_prefix("down."), rest.strip_prefix("up.")) {
        (Some(rest), _) => number(rest).map(|(level, rest)| ("down_blocks", level, rest))?,
        // Levels of the way up are counted from the finest there, from the deepest here.
        (_, Some(rest)) => {
            let (level, rest) = number(rest)?;
            ("up_blocks", (LEVELS - 1).checked_sub(level)?, rest)
        }
        _ => return None,
    };
    if let Some(rest) = rest.strip_prefix("block.") {
        let (index, rest) = number(rest)?;
        return Some(format!(
            "{part}.{blocks}.{level}.resnets.{index}.{}",
            rest.replace("nin_shortcut", "conv_shortcut")
        ));
    }
    let samplers = [("downsample.", "downsamplers.0."), ("upsample.", "upsamplers.0.")];
    samplers
        .iter()
        .find_map(|(theirs, ours)| Some(format!("{part}.{blocks}.{level}.{ours}{}", rest.strip_prefix(theirs)?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(renamed: Renamed) -> String {
        match renamed {
            Renamed::As(name) => name,
            Renamed::Elsewhere => "elsewhere".into(),
        }
    }

    #[test]
    fn names_of_a_unet() {
        let config = UNetConfig::stable_diffusion_1();
        let unet = |rest: &str| name(unet(&format!("model.diffusion_model.{rest}"), &config, "model.diffusion_model."));
        for (theirs, ours) in [
            ("input_blocks.0.0.weight", "conv_in.weight"),
            ("time_embed.2.bias", "time_embedding.linear_2.bias"),
            ("input_blocks.3.0.op.weight", "down_blocks.0.downsamplers.0.conv.weight"),
            ("input_blocks.4.0.skip_connection.bias", "down_blocks.1.resnets.0.conv_shortcut.bias"),
            ("input_blocks.8.1.proj_in.weight", "down_blocks.2.attentions.1.proj_in.weight"),
            ("input_blocks.11.0.out_layers.3.weight", "down_blocks.3.resnets.1.conv2.weight"),
            ("middle_block.2.emb_layers.1.bias", "mid_block.resnets.1.time_emb_proj.bias"),
            ("output_blocks.2.1.conv.weight", "up_blocks.0.upsamplers.0.conv.weight"),
            ("output_blocks.5.1.norm.weight", "up_blocks.1.attentions.2.norm.weight"),
            ("output_blocks.5.2.conv.bias", "up_blocks.1.upsamplers.0.conv.bias"),
            ("output_blocks.11.0.in_layers.0.weight", "up_blocks.3.resnets.2.norm1.weight"),
            ("out.2.bias", "conv_out.bias"),
        ] {
            assert_eq!(unet(theirs), ours);
        }
        let plain = |name_of: &str| name(super::unet(name_of, &config, "model.diffusion_model."));
        assert_eq!(plain("down_blocks.0.resnets.0.norm1.weight"), "down_blocks.0.resnets.0.norm1.weight");
        assert_eq!(plain("first_stage_model.quant_conv.bias"), "elsewhere");
        assert_eq!(plain("alphas_cumprod_prev"), "elsewhere");
    }

    #[test]
    fn names_of_a_control_net_and_an_autoencoder() {
        let config = ControlConfig::relighter();
        for (theirs, ours) in [
            ("control_model.zero_convs.11.0.weight", "controlnet_down_blocks.11.weight"),
            ("control_model.input_hint_block.0.bias", "controlnet_cond_embedding.conv_in.bias"),
            ("control_model.input_hint_block.2.bias", "controlnet_cond_embedding.blocks.0.bias"),
            ("control_model.input_hint_block.12.weight", "controlnet_cond_embedding.blocks.5.weight"),
            ("control_model.input_hint_block.14.weight", "controlnet_cond_embedding.conv_out.weight"),
            ("control_model.middle_block_out.0.weight", "controlnet_mid_block.weight"),
            ("control_model.input_blocks.1.1.norm.bias", "down_blocks.0.attentions.0.norm.bias"),
        ] {
            assert_eq!(name(control(theirs, &config)), ours);
        }
        for (theirs, ours) in [
            (
                "first_stage_model.encoder.down.1.block.0.nin_shortcut.bias",
                "encoder.down_blocks.1.resnets.0.conv_shortcut.bias",
            ),
            ("first_stage_model.encoder.down.2.downsample.conv.bias", "encoder.down_blocks.2.downsamplers.0.conv.bias"),
            ("first_stage_model.decoder.up.0.block.2.norm1.bias", "decoder.up_blocks.3.resnets.2.norm1.bias"),
            ("first_stage_model.decoder.up.3.upsample.conv.bias", "decoder.up_blocks.0.upsamplers.0.conv.bias"),
            ("first_stage_model.encoder.mid.attn_1.q.weight", "encoder.mid_block.attentions.0.to_q.weight"),
            ("decoder.mid_block.attentions.0.proj_attn.bias", "decoder.mid_block.attentions.0.to_out.0.bias"),
            ("encoder.norm_out.weight", "encoder.conv_norm_out.weight"),
            ("quant_conv.weight", "quant_conv.weight"),
        ] {
            assert_eq!(name(autoencoder(theirs)), ours);
        }
    }
}
