//! Shapes and values of a float model, checked before anything is computed from them.

use super::error::EncodeError;
use super::model::{Dense, FloatDecoder, FloatModel, HeadEncoding, Interface};
use crate::schema::{
    MAX_ACTIONS, MAX_ATOMS, MAX_HEAD_ROWS, MAX_LATENTS, MAX_LAYERS, MAX_LAYERS_ON_TRUNK, MAX_OBS, MAX_TEXT, MAX_TYPES,
    MAX_WIDTH,
};
use crate::space::ActionHead;
use std::collections::BTreeSet;
use std::format;
use std::string::String;

pub(crate) fn equal(what: impl Into<String>, expected: usize, found: usize) -> Result<(), EncodeError> {
    if expected == found { Ok(()) } else { Err(EncodeError::Shape { what: what.into(), expected, found }) }
}

fn within(what: impl Into<String>, min: usize, max: usize, found: usize) -> Result<(), EncodeError> {
    if (min..=max).contains(&found) {
        Ok(())
    } else {
        Err(EncodeError::Value { what: format!("{} must be in {min}..={max}", what.into()), found: found as f64 })
    }
}

fn finite(what: &str, values: &[f32]) -> Result<(), EncodeError> {
    match values.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(index) => Err(EncodeError::Value {
            what: format!("{what}[{index}] must be finite; stop the training run that made it"),
            found: f64::from(values[index]),
        }),
    }
}

/// The whole model.
pub(crate) fn check(model: &FloatModel) -> Result<(), EncodeError> {
    let obs_dim = model.interface.observations.len();
    check_interface(&model.interface)?;
    equal("obs_mean", obs_dim, model.obs_mean.len())?;
    equal("obs_std", obs_dim, model.obs_std.len())?;
    finite("obs_mean", &model.obs_mean)?;
    finite("obs_std", &model.obs_std)?;
    if let Some(std) = model.obs_std.iter().find(|std| **std <= 0.0) {
        return Err(EncodeError::Value { what: "obs_std must be positive".into(), found: f64::from(*std) });
    }
    check_chain("Q-network", &model.q, obs_dim)?;
    let latents = model.num_latents();
    within("latents", 1, MAX_LATENTS, latents)?;
    if let Some(confidence) = &model.confidence {
        let trunk = model.q.iter().nth_back(1).map_or(0, |layer| layer.rows);
        if model.shared_trunk && trunk == 0 {
            let what = "a shared trunk needs a Q-network with a hidden layer; its layers".into();
            return Err(EncodeError::Value { what, found: model.q.len() as f64 });
        }
        if model.shared_trunk {
            within("layers of a confidence network on a shared trunk", 1, MAX_LAYERS_ON_TRUNK, confidence.len())?;
        }
        check_chain("confidence network", confidence, if model.shared_trunk { trunk } else { obs_dim })?;
        equal("rows of the confidence network", latents, confidence.last().map_or(0, |layer| layer.rows))?;
        if !(model.beta > 0.0 && model.beta < 1.0) {
            return Err(EncodeError::Value {
                what: "beta must lie strictly between 0 and 1".into(),
                found: f64::from(model.beta),
            });
        }
    }
    if model.shared_trunk && model.confidence.is_none() {
        let what = "a shared trunk needs a confidence network; such networks".into();
        return Err(EncodeError::Value { what, found: 0.0 });
    }
    check_decoder(model, obs_dim, latents)
}

fn check_interface(interface: &Interface) -> Result<(), EncodeError> {
    within("observations", 1, MAX_OBS, interface.observations.len())?;
    within("action slots", 1, MAX_ACTIONS, interface.actions.len())?;
    within("control_period_us", 1, u32::MAX as usize, interface.control_period_us as usize)?;
    let mut names = BTreeSet::new();
    for slot in &interface.observations {
        check_text(&slot.name, &slot.unit, &mut names)?;
        if slot.lo.is_nan() || slot.hi.is_nan() || slot.lo >= slot.hi {
            let what = format!("observation {}: lo must be below hi; lo", slot.name);
            return Err(EncodeError::Value { what, found: f64::from(slot.lo) });
        }
    }
    names.clear();
    for slot in &interface.actions {
        check_text(&slot.name, &slot.unit, &mut names)?;
        check_action(&slot.name, slot.head, slot.safe)?;
    }
    Ok(())
}

fn check_text<'a>(name: &'a str, unit: &str, names: &mut BTreeSet<&'a str>) -> Result<(), EncodeError> {
    within(format!("bytes of the name {name:?}"), 1, MAX_TEXT, name.len())?;
    within(format!("bytes of the unit {unit:?}"), 0, MAX_TEXT, unit.len())?;
    if !names.insert(name) {
        return Err(EncodeError::Value {
            what: format!("the name {name:?} must be unique; signals with it"),
            found: 2.0,
        });
    }
    if name.chars().chain(unit.chars()).any(char::is_control) {
        let what = format!("name {name:?} and unit {unit:?} must not hold control characters; such a character");
        return Err(EncodeError::Value { what, found: 1.0 });
    }
    Ok(())
}

fn check_action(name: &str, head: ActionHead, safe: f32) -> Result<(), EncodeError> {
    let ok = match head {
        ActionHead::Continuous { lo, hi } => {
            if !(lo.is_finite() && hi.is_finite() && lo < hi && (hi - lo).is_finite()) {
                let what = format!("action {name}: bounds must be finite and lo below hi; lo");
                return Err(EncodeError::Value { what, found: f64::from(lo) });
            }
            (lo..=hi).contains(&safe)
        }
        ActionHead::Discrete { n } => {
            within(format!("types of action {name}"), 1, MAX_TYPES, usize::from(n))?;
            crate::reader::is_index(safe, n.into())
        }
        ActionHead::Binary => crate::reader::is_index(safe, 2),
    };
    if ok {
        Ok(())
    } else {
        Err(EncodeError::Value {
            what: format!("action {name}: the safe value must be one that the slot may hold"),
            found: f64::from(safe),
        })
    }
}

fn check_dense(what: &str, layer: &Dense, cols: usize, max_rows: usize) -> Result<(), EncodeError> {
    within(format!("{what}: rows"), 1, max_rows, layer.rows)?;
    equal(format!("{what}: columns"), cols, layer.cols)?;
    equal(format!("{what}: weights"), layer.rows * layer.cols, layer.weight.len())?;
    equal(format!("{what}: biases"), layer.rows, layer.bias.len())?;
    finite(&format!("{what}: weight"), &layer.weight)?;
    finite(&format!("{what}: bias"), &layer.bias)
}

fn check_chain(what: &str, layers: &[Dense], inputs: usize) -> Result<(), EncodeError> {
    within(format!("{what}: layers"), 1, MAX_LAYERS, layers.len())?;
    let mut width = inputs;
    for (index, layer) in layers.iter().enumerate() {
        check_dense(&format!("{what}, layer {index}"), layer, width, MAX_WIDTH)?;
        width = layer.rows;
    }
    Ok(())
}

fn check_decoder(model: &FloatModel, obs_dim: usize, latents: usize) -> Result<(), EncodeError> {
    let slots = model.interface.actions.len();
    match &model.decoder {
        FloatDecoder::Modulated { state, scale, shift, hidden, head } => {
            within("decoder: layers", 2, MAX_LAYERS, hidden.len() + 2)?;
            check_dense("decoder, layer 0", state, obs_dim, MAX_WIDTH)?;
            for (what, table) in [("scale", scale), ("shift", shift)] {
                equal(format!("decoder: {what} per latent"), latents, table.len())?;
                for row in table {
                    equal(format!("decoder: {what} per row"), state.rows, row.len())?;
                    finite(&format!("decoder: {what}"), row)?;
                }
            }
            let mut width = state.rows;
            for (index, layer) in hidden.iter().enumerate() {
                check_dense(&format!("decoder, layer {}", index + 1), layer, width, MAX_WIDTH)?;
                width = layer.rows;
            }
            check_dense("decoder, head layer", head, width, MAX_HEAD_ROWS)?;
            equal("heads", slots, model.heads.len())?;
            equal(
                "rows of the head layer",
                model.heads.iter().zip(&model.interface.actions).map(|(h, a)| h.rows(a.head)).sum(),
                head.rows,
            )?;
            for (encoding, action) in model.heads.iter().zip(&model.interface.actions) {
                check_head(*encoding, action.head, &action.name)?;
            }
        }
        FloatDecoder::Table { actions } => {
            equal("table decoder: actions per latent", latents, actions.len())?;
            for row in actions {
                equal("table decoder: values per latent", slots, row.len())?;
                for (value, action) in row.iter().zip(&model.interface.actions) {
                    let ok = match action.head {
                        ActionHead::Continuous { .. } => (-1.0..=1.0).contains(value),
                        ActionHead::Discrete { n } => crate::reader::is_index(*value, n.into()),
                        ActionHead::Binary => crate::reader::is_index(*value, 2),
                    };
                    if !ok {
                        let what = format!("table decoder: value of {} before denormalisation", action.name);
                        return Err(EncodeError::Value { what, found: f64::from(*value) });
                    }
                }
            }
        }
    }
    Ok(())
}

fn check_head(encoding: HeadEncoding, head: ActionHead, name: &str) -> Result<(), EncodeError> {
    match (encoding, head) {
        (HeadEncoding::Tanh, ActionHead::Continuous { .. })
        | (HeadEncoding::Types, ActionHead::Discrete { .. })
        | (HeadEncoding::Switch, ActionHead::Binary) => Ok(()),
        (HeadEncoding::Categorical { atoms, .. }, ActionHead::Continuous { .. }) => {
            within(format!("atoms of action {name}"), 2, MAX_ATOMS, atoms)
        }
        _ => Err(EncodeError::Value {
            what: format!("action {name}: {encoding:?} does not fit {head:?}; rows of the encoding"),
            found: encoding.rows(head) as f64,
        }),
    }
}
