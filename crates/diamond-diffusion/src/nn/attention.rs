//! Attention between tokens, and the gated feed-forward layer that follows it in a transformer.
use super::activation::{gelu, softmax};
use super::attention_op::BlockAttention;
use super::linear::Linear;
use super::variables::Scope;
use crate::error::{DiffusionError, Result};
use candle_core::{D, Tensor};

/// softmax(q·kᵀ/√channels)·v for (heads, queries, channels), (heads, keys, channels) and (heads, keys, values).
/// `[eq:attention]`
///
/// On the CPU memory grows with the number of keys and not with keys × queries.
pub fn attend(q: &Tensor, k: &Tensor, v: &Tensor) -> candle_core::Result<Tensor> {
    let scale = 1.0 / (q.dim(D::Minus1)? as f64).sqrt();
    if q.device().is_cpu() {
        q.contiguous()?.apply_op3(&k.contiguous()?, &v.contiguous()?, BlockAttention { scale })
    } else {
        composed(q, k, v, scale)
    }
}

/// [`attend`] of candle's operations.
fn composed(q: &Tensor, k: &Tensor, v: &Tensor, scale: f64) -> candle_core::Result<Tensor> {
    let scores = (q.contiguous()?.matmul(&k.transpose(1, 2)?.contiguous()?)? * scale)?;
    softmax(&scores)?.matmul(&v.contiguous()?)
}

/// Attention with several heads: `to_q`, `to_k`, `to_v` without bias, `to_out.0` with one.
#[derive(Debug, Clone)]
pub struct Attention {
    to_q: Linear,
    to_k: Linear,
    to_v: Linear,
    to_out: Linear,
    heads: usize,
}

impl Attention {
    /// Tokens of `channels` that look at tokens of `context` channels; `heads` must divide `channels`.
    pub fn new(scope: &Scope<'_>, channels: usize, context: usize, heads: usize) -> Result<Self> {
        let to_out = Linear::new(&scope.at("to_out.0"), channels, channels)?;
        Self::with_output(scope, channels, context, heads, to_out)
    }

    /// With an output projection of zeros: the layer adds nothing before it has learned, but its output projection learns from
    /// the first step.
    pub fn silent(scope: &Scope<'_>, channels: usize, context: usize, heads: usize) -> Result<Self> {
        let to_out = Linear::zeros(&scope.at("to_out.0"), channels, channels)?;
        Self::with_output(scope, channels, context, heads, to_out)
    }

    fn with_output(scope: &Scope<'_>, channels: usize, context: usize, heads: usize, to_out: Linear) -> Result<Self> {
        if heads == 0 || !channels.is_multiple_of(heads) {
            return Err(DiffusionError::setting("heads", format!("a divisor of {channels} channels"), heads));
        }
        Ok(Self {
            to_q: Linear::without_bias(&scope.at("to_q"), channels, channels)?,
            to_k: Linear::without_bias(&scope.at("to_k"), context, channels)?,
            to_v: Linear::without_bias(&scope.at("to_v"), context, channels)?,
            to_out,
            heads,
        })
    }

    /// `x` is (batch, tokens, channels), `context` (batch, tokens, context channels); without it the tokens look at each other.
    pub fn forward(&self, x: &Tensor, context: Option<&Tensor>) -> Result<Tensor> {
        let context = context.unwrap_or(x);
        let (batch, tokens, channels) = x.dims3()?;
        let split = |t: Tensor| {
            let (_, tokens, _) = t.dims3()?;
            let t = t.reshape((batch, tokens, self.heads, channels / self.heads))?.transpose(1, 2)?.contiguous()?;
            t.reshape((batch * self.heads, tokens, channels / self.heads))
        };
        let (q, k, v) = (self.to_q.forward(x)?, self.to_k.forward(context)?, self.to_v.forward(context)?);
        let out = attend(&split(q)?, &split(k)?, &split(v)?)?;
        let out = out.reshape((batch, self.heads, tokens, channels / self.heads))?.transpose(1, 2)?;
        self.to_out.forward(&out.contiguous()?.reshape((batch, tokens, channels))?)
    }
}

/// The feed-forward layer of a transformer: a·gelu(b) of a projection to 4 times the channels each (GEGLU), and back.
#[derive(Debug, Clone)]
pub struct FeedForward {
    project: Linear,
    back: Linear,
}

impl FeedForward {
    /// Weights `net.0.proj` and `net.2`.
    pub fn new(scope: &Scope<'_>, channels: usize) -> Result<Self> {
        let project = Linear::new(&scope.at("net.0.proj"), channels, 8 * channels)?;
        Ok(Self { project, back: Linear::new(&scope.at("net.2"), 4 * channels, channels)? })
    }

    /// `x` is (…, channels).
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let both = self.project.forward(x)?.chunk(2, D::Minus1)?;
        self.back.forward(&both[0].contiguous()?.mul(&gelu(&both[1].contiguous()?)?)?)
    }
}

#[cfg(test)]
mod tests {
    use super::super::variables::{Source, VariablesBuilder};
    use super::*;
    use crate::gradient_check::{check, variable};
    use candle_core::DType;

    /// [eq:attention]: one block and several, as many keys as queries and not.
    #[test]
    fn the_fused_operation_agrees_with_differences_and_with_the_composed_one() {
        for (queries, keys) in [(5, 5), (70, 3), (1, 130)] {
            let (q, k) = (variable("q", &[2, queries, 4]), variable("k", &[2, keys, 4]));
            let v = variable("v", &[2, keys, 6]);
            let what = format!("attention of {queries} queries and {keys} keys");
            check(&what, &[&q, &k, &v], || attend(&q, &k, &v));
            check(&format!("composed {what}"), &[&q, &k, &v], || composed(&q, &k, &v, 0.5));
            let worst = (attend(&q, &k, &v).unwrap() - composed(&q, &k, &v, 0.5).unwrap()).unwrap().abs().unwrap();
            assert!(worst.max_all().unwrap().to_scalar::<f64>().unwrap() < 1e-12, "{what}");
        }
    }

    #[test]
    fn layers_have_gradients() {
        let builder = VariablesBuilder::new(Source::Seed(3)).dtype(DType::F64);
        let attention = Attention::new(&builder.root().at("attn"), 4, 3, 2).unwrap();
        let own = Attention::new(&builder.root().at("self"), 4, 4, 1).unwrap();
        let feed = FeedForward::new(&builder.root().at("ff"), 4).unwrap();
        assert!(Attention::new(&builder.root().at("wrong"), 4, 4, 3).is_err());
        let (x, context) = (variable("x", &[2, 5, 4]), variable("c", &[2, 3, 3]));
        let run = || {
            let y = attention.forward(&x, Some(&context)).unwrap();
            Ok(feed.forward(&own.forward(&y, None).unwrap()).unwrap())
        };
        // The layer that was refused had asked for its output weights: they are dropped before the check.
        let (variables, _) = builder.finish();
        let used: Vec<&candle_core::Var> =
            variables.vars().filter(|(name, _)| !name.starts_with("wrong")).map(|(_, var)| var).collect();
        check("attention layers", &[used, vec![&x, &context]].concat(), run);
    }

    #[test]
    fn a_silent_layer_begins_with_zeros() {
        let builder = VariablesBuilder::new(Source::Seed(3));
        let layer = Attention::silent(&builder.root(), 4, 4, 2).unwrap();
        let x = variable("x", &[1, 3, 4]).to_dtype(DType::F32).unwrap();
        let y = layer.forward(&x, None).unwrap();
        assert_eq!(y.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap(), 0.0);
    }
}
