//! Each part of a step against the CPU's own function, fed with what the device itself has: an error upstream does not reach it.
use crate::compare::relative_l2;
use crate::steps::{self, FITTED, MEDIUM, MLP, SIZE, Scenario, Stepped};
use diamond_gpu::{Column, Device, STEP_PARTS, Store};
use diamond_image::Image;
use diamond_light::{Falloff, OlatLight};
use diamond_losses::Average;
use diamond_reconstruct::adam::{Moments, Rows, adam_step};
use diamond_reconstruct::{Activated, ActivatedGrad, Attribute, Config, Model, StepPlan, sigmoid};
use diamond_shading::sh_visibility::{visibilities, visibilities_pull};
use diamond_shading::{
    InputScaling, LightDistanceInput, RESIDUAL_INPUTS, ResidualInputs, TransferActivation, TransferConfig,
    pseudo_normals, transfer_radiance,
};
use diamond_splat::GaussiansGrad;
use glam::{Quat, Vec3, Vec4};
use std::sync::Arc;

/// Relative error of one comparison: part, what, error.
type Found = (&'static str, String, f64);

/// A step on the device, read back.
struct Probe {
    stepped: Stepped,
    config: Config,
    activated: Activated,
    light: OlatLight,
    features: Vec<f32>,
    d_features: Vec<f32>,
    /// `d_features` before network and medium add to it.
    summed: Vec<f32>,
    gradient: Vec<f32>,
    visibility: Vec<f32>,
}

/// A place in the array of all raw parameters, which begin at multiples of 64 numbers.
fn part<'v>(model: &Model, values: &'v [f32], attribute: Attribute) -> &'v [f32] {
    let mut first = 0;
    for group in model.parameters.groups() {
        let n = group.values.len();
        if group.attribute == attribute {
            return &values[first..first + n];
        }
        first += n.next_multiple_of(64);
    }
    &[]
}

fn vec3s(values: &[f32]) -> Vec<Vec3> {
    values.chunks_exact(3).map(Vec3::from_slice).collect()
}

fn flat(values: &[Vec3]) -> Vec<f32> {
    values.iter().flat_map(|v| v.to_array()).collect()
}

/// Numbers `from..from + n` of each row of sixteen.
fn channels(rows: &[f32], from: usize, n: usize) -> Vec<f32> {
    rows.chunks_exact(16).flat_map(|row| row[from..from + n].to_vec()).collect()
}

impl Probe {
    fn of(device: &Arc<Device>, scenario: &Scenario) -> Result<Self, String> {
        let stepped = steps::step(device, scenario)?;
        let config = steps::config(scenario)?;
        let activated = stepped.before.parameters.activate();
        let light = stepped.before.scene.scaled_light(&stepped.shots.lights[0]);
        let columns =
            [Column::Features, Column::DFeatures, Column::Gradient, Column::Rows, Column::Offsets, Column::DepthOrder];
        let stepper = stepped.stepper.clone();
        let mut read = stepper.borrow().read_columns(&columns).map_err(|e| e.to_string())?;
        let visibility = stepper.borrow().read(&[Store::Visibility]).map_err(|e| e.to_string())?.swap_remove(0);
        let n = stepped.before.len();
        let (offsets, order) = (&read[4], &read[5]);
        let mut summed = vec![0.0f32; 16 * n];
        for rank in 0..n {
            let i = order[rank].to_bits() as usize;
            let mut sum = [0.0f64; 16];
            for entry in offsets[rank].to_bits()..offsets[rank + 1].to_bits() {
                let row = &read[3][24 * entry as usize + 8..][..16];
                sum.iter_mut().zip(row).for_each(|(a, b)| *a += f64::from(*b));
            }
            summed[16 * i..16 * i + 16].iter_mut().zip(sum).for_each(|(to, v)| *to = v as f32);
        }
        let gradient = read.swap_remove(2);
        let (features, d_features) = (read[0][..16 * n].to_vec(), read[1][..16 * n].to_vec());
        let visibility = visibility[..n].to_vec();
        Ok(Self { stepped, config, activated, light, features, d_features, summed, gradient, visibility })
    }

    fn read(&self, stores: &[Store]) -> Result<Vec<Vec<f32>>, String> {
        self.stepped.stepper.borrow().read(stores).map_err(|e| e.to_string())
    }

    fn model(&self) -> &Model {
        &self.stepped.before
    }

    /// Of the raw gradient.
    fn raw(&self, attribute: Attribute) -> Result<Vec<f32>, String> {
        Ok(part(self.model(), &self.read(&[Store::RawGradient])?[0], attribute).to_vec())
    }

    fn directions(&self) -> (Vec<Vec3>, Vec<f32>) {
        let of = |p: &Vec3| self.light.incidence(*p, Falloff::None);
        let all: Vec<_> = self.activated.gaussians.means.iter().map(of).collect();
        (all.iter().map(|i| i.direction).collect(), all.iter().map(|i| i.distance).collect())
    }

    fn scaling(&self) -> InputScaling {
        let scene = steps::scene();
        let (centre, half) = (scene.centre(), Vec3::splat(scene.radius));
        let mut scaling = InputScaling::of_bounds(centre - half, centre + half);
        scaling.light_distance = LightDistanceInput::Bounded { reference: scene.light_distance };
        scaling
    }

    /// What the network is told about some Gaussians.
    fn inputs(
        &self,
        rows: &[usize],
        views: &[Vec3],
        lights: &[Vec3],
        distances: &[f32],
        seen: &[f32],
    ) -> Result<Vec<f32>, String> {
        let g = &self.activated.gaussians;
        let pick = |v: &[Vec3]| rows.iter().map(|i| v[*i]).collect::<Vec<Vec3>>();
        let codes = self.config.residual.codes;
        let all = self.model().parameters.values(Attribute::Codes);
        let taken: Vec<f32> = rows.iter().flat_map(|i| all[i * codes..(i + 1) * codes].to_vec()).collect();
        let rotations: Vec<Quat> = rows.iter().map(|i| g.rotations[*i].normalize()).collect();
        let inputs = ResidualInputs {
            positions: &pick(&g.means),
            rotations: &rotations,
            scales: &pick(&g.scales),
            view_directions: views,
            light_directions: lights,
            normals: &pick(&self.activated.normals),
            visibility: seen,
            light_distances: distances,
            codes: &taken,
            code_size: codes,
        };
        Ok(inputs.assemble(&self.scaling()).map_err(|e| e.to_string())?.0)
    }

    /// [`Probe::inputs`] of all Gaussians in the view.
    fn all_inputs(&self) -> Result<Vec<f32>, String> {
        let eye = self.stepped.shots.cameras[0].pose.centre();
        let views: Vec<Vec3> = self.activated.gaussians.means.iter().map(|p| (eye - *p).normalize()).collect();
        let (lights, distances) = self.directions();
        let rows: Vec<usize> = (0..self.model().len()).collect();
        self.inputs(&rows, &views, &lights, &distances, &self.visibility)
    }

    fn transfer_config(&self) -> TransferConfig {
        let degree = self.config.residual.transfer_degree as usize;
        TransferConfig { degree, activation: TransferActivation::Linear }
    }

    /// Residual of network and transfer vectors for these inputs.
    fn residual(&self, inputs: &[f32]) -> Result<Vec<f32>, String> {
        let n = self.model().len();
        let mut sum = vec![0.0; 3 * n];
        if let Some(network) = &self.model().network {
            let (out, _) = network.forward(inputs, n).map_err(|e| e.to_string())?;
            sum.iter_mut().zip(&out.residual).for_each(|(s, r)| *s += r);
        }
        let transfer = self.model().parameters.values(Attribute::Transfer);
        let (radiance, _) =
            transfer_radiance(transfer, &self.directions().0, self.transfer_config()).map_err(|e| e.to_string())?;
        sum.iter_mut().zip(&radiance).for_each(|(s, r)| *s += r);
        Ok(sum)
    }

    /// Share of what a medium sends out of a Gaussian that the camera sees.
    fn front(&self, i: usize) -> f32 {
        let away = self.stepped.shots.cameras[0].pose.centre() - self.activated.gaussians.means[i];
        (1.0 + self.activated.normals[i].dot(away.normalize())).clamp(0.0, 1.0)
    }

    /// What a medium sends out of each Gaussian before the tint [eq:medium-residual], from the surfels that the device has.
    fn untinted(&self) -> Result<Vec<Vec3>, String> {
        let Some(term) = &self.model().medium else { return Err("there is no medium".into()) };
        let leaving = self.read(&[Store::Leaving])?.swap_remove(0);
        let whole = sigmoid(4.0);
        let local = steps::medium().local() / whole;
        let falloff = steps::falloff(self.model());
        let lamp = self.light.of_unit_intensity();
        let g = &self.activated;
        Ok((0..self.model().len())
            .map(|i| {
                let at = g.gaussians.means[i];
                let around = term.attachment().rgb(i, &leaving);
                let falls = lamp.incidence(at, falloff).irradiance.x;
                let cosine = g.normals[i].dot(lamp.incidence(at, Falloff::None).direction).max(0.0);
                (around / falls / whole + local * (self.visibility[i] * cosine)) * self.front(i)
            })
            .collect())
    }

    fn activate(&self, found: &mut Vec<Found>) -> Result<(), String> {
        let columns = [Column::Means, Column::FormA, Column::FormB];
        let read = self.stepped.stepper.borrow().read_columns(&columns).map_err(|e| e.to_string())?;
        let (a, n) = (&self.activated, self.model().len());
        let four = |v: &[f32]| v[..4 * n].to_vec();
        let means = a.gaussians.means.iter().zip(&a.gaussians.opacities);
        let means: Vec<f32> = means.flat_map(|(m, o)| m.extend(*o).to_array()).collect();
        let rotations: Vec<f32> = a.gaussians.rotations.iter().flat_map(|q| q.to_array()).collect();
        let scales: Vec<f32> = a.gaussians.scales.iter().flat_map(|s| s.extend(0.0).to_array()).collect();
        let mut add = |what: &str, x: &[f32], y: &[f32]| {
            found.push(("activate", what.to_owned(), relative_l2(x, y)));
        };
        add("means and opacities", &four(&read[0]), &means);
        add("rotations", &four(&read[1]), &rotations);
        add("standard deviations", &four(&read[2]), &scales);
        add("base colour", &channels(&self.features, 0, 3), &flat(&a.base_color));
        add("roughness", &channels(&self.features, 3, 1), &a.roughness);
        add("metalness", &channels(&self.features, 4, 1), &a.metalness);
        add("subsurfaceness", &channels(&self.features, 5, 1), &a.subsurfaceness);
        add("normals", &channels(&self.features, 6, 3), &flat(&a.normals));
        Ok(())
    }

    fn residual_forward(&self, found: &mut Vec<Found>) -> Result<(), String> {
        let expected = self.all_inputs()?;
        let inputs = self.read(&[Store::Inputs])?.swap_remove(0);
        let inputs = &inputs[..expected.len()];
        found.push(("residual_inputs", "rows".into(), relative_l2(inputs, &expected)));
        let residual = self.residual(inputs)?;
        found.push(("residual_outputs", "residual".into(), relative_l2(&channels(&self.features, 9, 3), &residual)));
        let seen = channels(&self.features, 13, 1);
        found.push(("residual_outputs", "visibility".into(), relative_l2(&seen, &self.visibility)));
        Ok(())
    }

    fn medium(&self, found: &mut Vec<Found>) -> Result<(), String> {
        let mut expected = self.residual(&self.all_inputs()?)?;
        let (untinted, a) = (self.untinted()?, &self.activated);
        for (i, to) in expected.chunks_exact_mut(3).enumerate() {
            let sent = untinted[i] * (2.0 * a.base_color[i]);
            to.iter_mut().zip(sent.to_array()).for_each(|(to, v)| *to += v);
        }
        found.push(("medium_rows", "residual".into(), relative_l2(&channels(&self.features, 9, 3), &expected)));
        let local = steps::medium().local() / sigmoid(4.0);
        let (mut colors, mut normals) = (Vec::new(), Vec::new());
        let (directions, _) = self.directions();
        for i in 0..self.model().len() {
            let row = &self.summed[16 * i..16 * i + 16];
            let d = Vec3::from_slice(&row[9..12]);
            colors.push(Vec3::from_slice(&row[..3]) + 2.0 * d * untinted[i]);
            let lit = a.normals[i].dot(directions[i]) > 0.0 && self.visibility[i] > 0.0;
            let d_cosine = self.visibility[i] * self.front(i) * (2.0 * d * a.base_color[i]).dot(local);
            let own = if lit { directions[i] * d_cosine } else { Vec3::ZERO };
            normals.push(Vec3::from_slice(&row[6..9]) + own);
        }
        let error = relative_l2(&channels(&self.d_features, 0, 3), &flat(&colors));
        found.push(("medium_pull", "base colour".into(), error));
        let error = relative_l2(&channels(&self.d_features, 6, 3), &flat(&normals));
        found.push(("medium_pull", "normals".into(), error));
        Ok(())
    }

    /// What `residual_gather` adds to the transfer vectors.
    fn transfer_gradient(&self) -> Result<Vec<f32>, String> {
        let transfer = self.model().parameters.values(Attribute::Transfer);
        let directions = self.directions().0;
        let (_, pullback) =
            transfer_radiance(transfer, &directions, self.transfer_config()).map_err(|e| e.to_string())?;
        Ok(pullback.pull(&channels(&self.d_features, 9, 3), false).map_err(|e| e.to_string())?.transfer)
    }

    fn residual_backward(&self, found: &mut Vec<Found>) -> Result<(), String> {
        let error = relative_l2(&self.raw(Attribute::Transfer)?, &self.transfer_gradient()?);
        found.push(("residual_gather", "transfer vectors".into(), error));
        let (width, codes) = (RESIDUAL_INPUTS + self.config.residual.codes, self.config.residual.codes);
        let read = self.read(&[Store::DInputs])?;
        let rows = read[0].chunks_exact(width).take(self.model().len());
        let expected: Vec<f32> =
            rows.clone().flat_map(|row| row[RESIDUAL_INPUTS..RESIDUAL_INPUTS + codes].to_vec()).collect();
        found.push(("residual_scatter", "codes".into(), relative_l2(&self.raw(Attribute::Codes)?, &expected)));
        let summed = self.summed.chunks_exact(16);
        let normals: Vec<f32> = rows
            .zip(summed)
            .flat_map(|(row, sum)| (0..3).map(|k| row[37 + k] + sum[6 + k]).collect::<Vec<_>>())
            .collect();
        let error = relative_l2(&channels(&self.d_features, 6, 3), &normals);
        found.push(("residual_scatter", "normals".into(), error));
        Ok(())
    }

    fn activate_pull(&self, found: &mut Vec<Found>) -> Result<(), String> {
        let n = self.model().len();
        let rows = || self.gradient.chunks_exact(16).take(n);
        let gaussians = GaussiansGrad {
            means: rows().map(Vec3::from_slice).collect(),
            scales: rows().map(|r| Vec3::from_slice(&r[8..])).collect(),
            rotations: rows().map(|r| Vec4::from_slice(&r[4..])).collect(),
            opacities: rows().map(|r| r[3]).collect(),
            ..GaussiansGrad::zeros(n)
        };
        let d = &self.d_features;
        let grad = ActivatedGrad {
            gaussians,
            normals: vec3s(&channels(d, 6, 3)),
            base_color: vec3s(&channels(d, 0, 3)),
            roughness: channels(d, 3, 1),
            metalness: channels(d, 4, 1),
            subsurfaceness: channels(d, 5, 1),
            ..ActivatedGrad::default()
        };
        let expected = self.model().parameters.pull(&self.activated, &grad);
        for attribute in &Attribute::ALL[..10] {
            let error = relative_l2(&self.raw(*attribute)?, &expected[*attribute as usize]);
            found.push(("activate_pull", attribute.name().into(), error));
        }
        Ok(())
    }

    fn visibility_term(&self, found: &mut Vec<Found>) -> Result<(), String> {
        let samples = self.read(&[Store::VisibilitySamples])?.swap_remove(0);
        let model = self.model();
        let sh = model.parameters.values(Attribute::VisibilitySh);
        let (directions, _) = self.directions();
        let fitted = visibilities(sh, &directions).map_err(|e| e.to_string())?;
        let mut d = vec![0.0f32; model.len()];
        let drawn: u32 = samples.chunks_exact(2).map(|s| s[1].to_bits()).sum();
        for s in samples.chunks_exact(2) {
            let i = s[0].to_bits() as usize;
            let difference = fitted[i] - self.visibility[i];
            let sign = if difference > 0.0 {
                1.0
            } else if difference < 0.0 {
                -1.0
            } else {
                0.0
            };
            d[i] = self.config.loss.visibility * s[1].to_bits() as f32 / drawn as f32 * sign;
        }
        let expected = visibilities_pull(sh, &directions, &d).map_err(|e| e.to_string())?.coefficients;
        let error = relative_l2(&self.raw(Attribute::VisibilitySh)?, &expected);
        found.push(("visibility_term", "coefficients".into(), error));
        Ok(())
    }

    fn fitted(&self, found: &mut Vec<Found>) -> Result<(), String> {
        let sh = self.model().parameters.values(Attribute::VisibilitySh);
        let expected = visibilities(sh, &self.directions().0).map_err(|e| e.to_string())?;
        found.push(("visibility_fit", "visibility".into(), relative_l2(&self.visibility, &expected)));
        // 2·weight·l²·t/N beside what the pictures say.
        let transfer = self.model().parameters.values(Attribute::Transfer);
        let size = self.transfer_config().coefficients();
        let bands: Vec<f32> = (0..size).map(|k| (k as f32).sqrt().floor().powi(2)).collect();
        let weight = 2.0 * self.config.residual.transfer_smoothness / self.model().len() as f32;
        let shrinks = transfer.iter().enumerate().map(|(k, t)| weight * bands[k % size] * t);
        let found_part: Vec<f32> =
            self.raw(Attribute::Transfer)?.iter().zip(&self.transfer_gradient()?).map(|(a, b)| a - b).collect();
        let error = relative_l2(&found_part, &shrinks.collect::<Vec<_>>());
        found.push(("transfer_smoothness", "transfer vectors".into(), error));
        Ok(())
    }

    fn sampled(&self, found: &mut Vec<Found>) -> Result<(), String> {
        let read = self.read(&[Store::PullSamples, Store::Inputs, Store::Layer(1, 0)])?;
        let rows: Vec<&[f32]> = read[0].chunks_exact(8).collect();
        let gaussians: Vec<usize> = rows.iter().map(|s| s[3].to_bits() as usize).collect();
        let (mut views, mut lights, mut seen) = (Vec::new(), Vec::new(), Vec::new());
        for (s, i) in rows.iter().zip(&gaussians) {
            let normal = self.activated.normals[*i];
            let (view, light) = (Vec3::from_slice(s), Vec3::from_slice(&s[4..]));
            views.push(if view.dot(normal) < 0.0 { -view } else { view });
            let lit = seen.iter().filter(|v| **v != 0.0).count();
            seen.push(if light.dot(normal) > 0.0 { rows[lit][7] } else { 0.0 });
            lights.push(light);
        }
        let distances = vec![steps::scene().light_distance; rows.len()];
        let expected = self.inputs(&gaussians, &views, &lights, &distances, &seen)?;
        found.push(("sampled_inputs", "rows".into(), relative_l2(&read[1][..expected.len()], &expected)));
        let size = self.transfer_config().coefficients();
        let all = self.model().parameters.values(Attribute::Transfer);
        let taken: Vec<f32> = gaussians.iter().flat_map(|i| all[i * 3 * size..(i + 1) * 3 * size].to_vec()).collect();
        let (radiance, pullback) =
            transfer_radiance(&taken, &lights, self.transfer_config()).map_err(|e| e.to_string())?;
        let weight = 2.0 * self.config.subsurface.residual_weight / 3.0 / (3 * rows.len()) as f32;
        let d: Vec<f32> = radiance.iter().zip(&read[2]).map(|(t, r)| weight * (t + r)).collect();
        let pulled = pullback.pull(&d, false).map_err(|e| e.to_string())?.transfer;
        let mut expected = self.transfer_gradient()?;
        for (row, i) in gaussians.iter().enumerate() {
            let to = &mut expected[i * 3 * size..(i + 1) * 3 * size];
            to.iter_mut().zip(&pulled[row * 3 * size..]).for_each(|(a, b)| *a += b);
        }
        let error = relative_l2(&self.raw(Attribute::Transfer)?, &expected);
        found.push(("sampled_pull", "transfer vectors".into(), error));
        Ok(())
    }

    fn image_terms(&self, found: &mut Vec<Found>) -> Result<(), String> {
        let stores = [Store::Record, Store::DRecord, Store::DLinear, Store::TermValues, Store::Totals];
        let read = self.read(&stores)?;
        let coverage = self.stepped.stepper.borrow().read_columns(&[Column::Coverage]).map_err(|e| e.to_string())?;
        let [width, height] = SIZE;
        let pixels = width * height;
        let image =
            |data: Vec<f32>| Image::from_vec(width, height, data.len() / pixels, data).map_err(|e| e.to_string());
        let map = |first: usize, n: usize| {
            image(read[0].chunks_exact(24).take(pixels).flat_map(|r| r[first..first + n].to_vec()).collect())
        };
        let opacity = image(coverage[0].chunks_exact(4).take(pixels).map(|c| c[0]).collect())?;
        let (camera, target) = (&self.stepped.shots.cameras[0], &self.stepped.shots.photographs[0]);
        let mask = self.stepped.shots.masks[0].as_ref();
        let (base_color, roughness, metalness, subsurfaceness) = (map(9, 3)?, map(12, 1)?, map(13, 1)?, map(14, 1)?);
        let (normal, depth) = (map(15, 3)?, map(23, 1)?);
        let text = |e: diamond_losses::LossError| e.to_string();
        let (mut pseudo, _) = pseudo_normals(camera, &depth, &opacity).map_err(|e| e.to_string())?;
        for (t, n) in pseudo.data_mut().chunks_exact_mut(3).zip(normal.data().chunks_exact(3)) {
            if t.iter().all(|v| *v == 0.0) {
                t.copy_from_slice(n);
            }
        }
        let loss = &self.config.loss;
        let edges = diamond_losses::EdgeWeights::new(target, mask).map_err(text)?;
        let smooth = |map: &Image, weight: f32| edges.smoothness(map).map(|l| l.grad.map(|g| g * weight)).map_err(text);
        let normals = diamond_losses::normal_consistency(&normal, &pseudo, mask, Average::AllPixels).map_err(text)?;
        let Some(mask) = mask else { return Err("there is no mask".into()) };
        let silhouette = diamond_losses::mask_bce(&opacity, mask).map_err(text)?;
        let of = |first: usize, n: usize| -> Vec<f32> {
            read[1].chunks_exact(20).take(pixels).flat_map(|r| r[first..first + n].to_vec()).collect()
        };
        let mut add = |what: &str, a: &[f32], b: &[f32]| found.push(("image_terms", what.into(), relative_l2(a, b)));
        add("d radiance", &of(0, 3), &read[2][..3 * pixels]);
        add("d base colour", &of(3, 3), smooth(&base_color, loss.smooth_base_color)?.data());
        add("d roughness", &of(6, 1), smooth(&roughness, loss.smooth_roughness)?.data());
        add("d metalness", &of(7, 1), smooth(&metalness, loss.smooth_metalness)?.data());
        add("d subsurfaceness", &of(8, 1), smooth(&subsurfaceness, loss.smooth_subsurfaceness)?.data());
        add("d normal", &of(9, 3), normals.grad.map(|g| g * loss.normal).data());
        add("d opacity", &of(18, 1), silhouette.grad.map(|g| g * loss.mask).data());
        let values: Vec<[f64; 4]> = (0..3)
            .map(|k| {
                let mut sum = [0.0f64; 4];
                for v in read[3][4 * k * pixels..4 * (k + 1) * pixels].chunks_exact(4) {
                    sum.iter_mut().zip(v).for_each(|(s, v)| *s += f64::from(*v));
                }
                sum
            })
            .collect();
        let expected: Vec<f32> = values.iter().flatten().map(|v| *v as f32).collect();
        found.push(("reduce", "terms".into(), relative_l2(&read[4][..12], &expected)));
        Ok(())
    }

    fn clamped(&self, found: &mut Vec<Found>) -> Result<(), String> {
        let model = self.model();
        let gradient = self.raw(Attribute::Scale)?;
        let mut values = model.parameters.values(Attribute::Scale).to_vec();
        let mut moments = Moments::zeros(values.len());
        let plan = StepPlan::new(&self.config, MLP.step);
        let rate = self.config.rates.scale * plan.attribute_factor;
        adam_step(&mut values, &mut moments, &gradient, rate, MLP.step + 1, Rows::All);
        let splat = &self.config.splat;
        let [low, high] = [splat.min_scale, splat.max_scale].map(|s| libm::logf(s * model.scene.extent));
        values.iter_mut().for_each(|v| *v = v.clamp(low, high));
        let read = self.read(&[Store::Values])?;
        let error = relative_l2(part(model, &read[0], Attribute::Scale), &values);
        found.push(("clamp_scales", "logarithms".into(), error));
        if !values.contains(&high) {
            return Err("no standard deviation was at its limit".into());
        }
        Ok(())
    }
}

/// The worst error of each part, or the first part of [`STEP_PARTS`] that is wrong among those that were compared when one was found.
pub fn parts(device: &Arc<Device>) -> Result<Vec<(&'static str, f64)>, (&'static str, String)> {
    type Compare = fn(&Probe, &mut Vec<Found>) -> Result<(), String>;
    let network: &[Compare] = &[
        Probe::activate,
        Probe::residual_forward,
        Probe::image_terms,
        Probe::residual_backward,
        Probe::activate_pull,
        Probe::visibility_term,
        Probe::clamped,
    ];
    let outside = |text: String| ("outside", text);
    let mut found = Vec::new();
    for (scenario, compares) in
        [(&MLP, network), (&MEDIUM, &[Probe::medium, Probe::sampled]), (&FITTED, &[Probe::fitted])]
    {
        let probe = Probe::of(device, scenario).map_err(outside)?;
        compares.iter().try_for_each(|compare| compare(&probe, &mut found)).map_err(outside)?;
        for row in STEP_PARTS {
            let wrong = |(name, _, error): &&Found| *name == row.name && (error.is_nan() || *error > row.tolerance);
            if let Some((_, what, error)) = found.iter().find(wrong) {
                return Err((row.name, format!("{what}: relative error {error:.2e}")));
            }
        }
    }
    let worst = |name: &'static str| {
        let errors = found.iter().filter(|(of, ..)| *of == name).map(|(_, _, error)| *error);
        let worst = errors.reduce(f64::max).ok_or((name, "nothing was compared".to_owned()))?;
        Ok((name, worst))
    };
    STEP_PARTS.iter().map(|row| worst(row.name)).collect()
}
