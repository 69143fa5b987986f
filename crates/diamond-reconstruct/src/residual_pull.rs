//! The residual's pull toward nothing, where a medium explains the light.
//!
//! What a few photographs leave open, network and transfer vectors fill with anything: for places that no view shows, for lights that
//! were not lit. So at every step some Gaussians are taken at random, each with a random light and a random direction from which it may be seen, and what the
//! residual adds there is asked to be 0: [eq:residual-pull] Σ r² / 3N. Photographs win where they speak, and nothing wins where they do not.
use crate::objective::TermValue;
use crate::random::Random;
use crate::rows::{LightRows, Rows, input_scaling, residual_inputs, transfer_config};
use crate::{Activated, ActivatedGrad, Attribute, Model, PullSample, ReconstructError, StepPull, error};
use diamond_shading::{InputGradients, transfer_radiance};
use glam::Vec3;

/// Gaussians that are looked at in a step.
const SAMPLES: usize = 1024;

/// Draws who is asked: in order and each once, as rows are.
pub(crate) fn draw(model: &Model, views: usize, random: &mut Random) -> StepPull {
    let n = model.len();
    let mut visible: Vec<u32> = (0..SAMPLES.min(n)).map(|_| random.below(n) as u32).collect();
    visible.sort_unstable();
    visible.dedup();
    let views_drawn: Vec<Vec3> = visible.iter().map(|_| random.direction()).collect();
    let lights: Vec<Vec3> = visible.iter().map(|_| random.direction()).collect();
    let drawn = visible.into_iter().zip(views_drawn).zip(lights);
    let one = |((gaussian, view), light)| PullSample { gaussian, view, light, visibility: random.uniform() };
    StepPull {
        weight: model.config.subsurface.residual_weight / views.max(1) as f32,
        samples: drawn.map(one).collect(),
        distance: model.scene.light_distance,
    }
}

/// Value of the term; adds its gradient, times its weight, to codes, transfer vectors and network.
pub(crate) fn pull_to_nothing(
    model: &Model,
    activated: &Activated,
    views: usize,
    random: &mut Random,
    total: &mut ActivatedGrad,
    network_grad: &mut Vec<Vec<f32>>,
) -> Result<TermValue, ReconstructError> {
    let n = model.len();
    let StepPull { weight, samples, distance } = draw(model, views, random);
    let visible: Vec<u32> = samples.iter().map(|s| s.gaussian).collect();
    let normal = |s: &PullSample| activated.normals[s.gaussian as usize];
    let outward = samples.iter().map(|s| if s.view.dot(normal(s)) < 0.0 { -s.view } else { s.view });
    let rows = Rows::with_view_directions(model, activated, outward.collect(), &visible);
    let directions: Vec<Vec3> = samples.iter().map(|s| s.light).collect();
    // Those whose light is in front of the normal take the numbers that were drawn, one after the other.
    let mut drawn = samples.iter().map(|s| s.visibility);
    let seen = |s: &PullSample| if s.light.dot(normal(s)) > 0.0 { drawn.next().unwrap_or(0.0) } else { 0.0 };
    let visibility = samples.iter().map(seen).collect();
    let lit = LightRows { visibility, directions, distances: vec![distance; rows.len()] };
    let mut sum = vec![0.0f32; 3 * rows.len()];
    let inputs = residual_inputs(model, &rows, &lit);
    let scaling = input_scaling(model);
    let assembled = match &model.network {
        Some(network) => {
            let (matrix, pullback) = inputs.assemble(&scaling).map_err(error::stage("residual inputs"))?;
            let (out, _) = network.forward(&matrix, rows.len()).map_err(error::stage("residual network"))?;
            sum.iter_mut().zip(&out.residual).for_each(|(s, r)| *s += r);
            Some((network, matrix, pullback))
        }
        None => None,
    };
    let transfer = match transfer_config(model) {
        Some(config) => {
            let of = transfer_radiance(&rows.transfer, &lit.directions, config);
            let (radiance, pullback) = of.map_err(error::stage("transfer vectors"))?;
            sum.iter_mut().zip(&radiance).for_each(|(s, r)| *s += r);
            Some(pullback)
        }
        None => None,
    };
    let scale = 1.0 / sum.len().max(1) as f32;
    let value = scale * sum.iter().map(|r| r * r).sum::<f32>();
    let d: Vec<f32> = sum.iter().map(|r| 2.0 * weight * scale * r).collect();
    if let Some((network, matrix, pullback)) = &assembled {
        let pulled =
            network.pullback(matrix, rows.len()).and_then(|p| p.pull(&d, &[], model.config.residual.codes > 0));
        let mut grad = pulled.map_err(error::stage("residual network.pull"))?;
        if let Some(d_inputs) = grad.inputs.take() {
            let codes = model.config.residual.codes;
            let d = pullback.pull(&d_inputs, InputGradients::Learned).map_err(error::stage("residual inputs.pull"))?;
            total.codes.resize(n * codes, 0.0);
            for (row, &i) in rows.visible.iter().enumerate() {
                let to = &mut total.codes[i as usize * codes..(i as usize + 1) * codes];
                to.iter_mut().zip(&d.codes[row * codes..]).for_each(|(a, b)| *a += b);
            }
        }
        let parts = [&grad.trunk, &grad.residual_head];
        network_grad.resize(network_grad.len().max(2), Vec::new());
        for (to, from) in network_grad.iter_mut().zip(parts) {
            to.resize(from.len(), 0.0);
            to.iter_mut().zip(from).for_each(|(a, b)| *a += b);
        }
    }
    if let Some(pullback) = &transfer {
        let grad = pullback.pull(&d, false).map_err(error::stage("transfer vectors.pull"))?;
        let width = model.config.residual.transfer_width();
        total.transfer.resize(model.parameters.values(Attribute::Transfer).len(), 0.0);
        for (row, &i) in rows.visible.iter().enumerate() {
            let to = &mut total.transfer[i as usize * width..(i as usize + 1) * width];
            to.iter_mut().zip(&grad.transfer[row * width..]).for_each(|(a, b)| *a += b);
        }
    }
    Ok(TermValue { name: "residual_pull", weight, value })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Purpose;
    use crate::{Config, InitialPoints, Scene};
    use diamond_splat::GaussiansGrad;

    /// [eq:residual-pull] Steps against the gradient bring the term down, by about as much as the gradient says; a step of the
    /// transfer vectors alone and of the network alone each does.
    #[test]
    fn the_gradient_points_away_from_nothing() {
        let config = Config::preset("resolved").unwrap();
        let scene = Scene {
            centre: [0.0; 3],
            radius: 1.0,
            extent: 1.0,
            camera_distance: 3.0,
            light_distance: 3.0,
            light_scale: 1.0,
        };
        let mut random = Random::new(3, Purpose::Initial, 0);
        let positions: Vec<Vec3> = (0..40).map(|_| random.direction()).collect();
        let points = InitialPoints { normals: positions.clone(), positions, ..Default::default() };
        let mut model = Model::initial(&config, scene, &points).unwrap();
        let values = model.parameters.values_mut(Attribute::Transfer);
        values.iter_mut().for_each(|v| *v = 0.1 * random.normal());
        let look = |model: &Model| {
            let activated = model.parameters.activate();
            let mut total = ActivatedGrad { gaussians: GaussiansGrad::zeros(40), ..Default::default() };
            let mut network = Vec::new();
            let mut random = Random::new(5, Purpose::ResidualPull, 7);
            let term = pull_to_nothing(model, &activated, 1, &mut random, &mut total, &mut network).unwrap();
            (term, total.transfer, network)
        };
        let (before, transfer, network) = look(&model);
        assert!(before.value > 1e-3 && before.weight == config.subsurface.residual_weight);
        let square = |d: &[f32]| d.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>();
        // One part moves against its gradient by so little that the term falls as the gradient says.
        let check = |moved: &Model, slope: f64, rate: f32| {
            let fallen = f64::from(before.weight * (before.value - look(moved).0.value));
            let expected = f64::from(rate) * slope;
            assert!(slope > 0.0 && (fallen / expected - 1.0).abs() < 0.1, "{fallen} {expected}");
        };
        let fraction = |slope: f64| (0.02 * f64::from(before.weight * before.value) / slope) as f32;
        let rate = fraction(square(&transfer));
        let mut moved = model.clone();
        moved.parameters.values_mut(Attribute::Transfer).iter_mut().zip(&transfer).for_each(|(v, d)| *v -= rate * d);
        check(&moved, square(&transfer), rate);
        let slope = network.iter().map(|d| square(d)).sum::<f64>();
        let rate = fraction(slope);
        let mut moved = model.clone();
        let parts = moved.network.as_mut().map(crate::model::network_parts_mut).unwrap_or_default();
        for ((_, values), d) in parts.into_iter().zip(&network) {
            values.iter_mut().zip(d).for_each(|(v, d)| *v -= rate * d);
        }
        check(&moved, slope, rate);
    }
}
