//! The parameters of one model as one flat candle `Var` with named parts.
//!
//! Flat, because the optimiser, the target copy and the gradient norm are then single passes over one slice; a candle `Var`,
//! because candle's autograd on the same storage is the oracle of every hand-written gradient (see `oracle.rs`).

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

use candle_core::{CpuStorage, Device, InplaceOp1, Layout, Storage, Tensor, Var};
use rand::RngExt as _;

use super::parallel::{halves, join};
use super::vector::vectorised;
use crate::seed::Rng;

/// How a part starts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Init {
    /// Uniform in `±bound`.
    Uniform(f32),
    /// All zero.
    Zero,
    /// All equal.
    Constant(f32),
    /// Row `k` is the `k`-th unit vector.
    OneHot,
}

impl Init {
    /// PyTorch's default for a dense layer, weights and bias alike: `U(±1/√fan_in)`.
    pub fn torch(fan_in: usize) -> Self {
        Self::Uniform(1.0 / (fan_in as f32).sqrt())
    }
}

/// One named part of a flat parameter vector.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// Name, unique within the model.
    pub name: String,
    /// Shape, row-major.
    pub shape: Vec<usize>,
    /// Where it lies.
    pub range: Range<usize>,
    init: Init,
}

/// Names, shapes and places of a model's parameters. Trainable parts come first.
#[derive(Clone, Debug, Default)]
pub struct ParamLayout {
    parts: Vec<Part>,
    len: usize,
    trainable: Option<usize>,
}

impl ParamLayout {
    /// An empty layout.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a trainable part; returns its place.
    ///
    /// # Panics
    /// After the first [`buffer`](Self::buffer).
    pub fn param(&mut self, name: &str, shape: &[usize], init: Init) -> Range<usize> {
        assert!(self.trainable.is_none(), "trainable part `{name}` declared after the first buffer");
        self.push(name, shape, init)
    }

    /// Adds a part that is stored and copied with the model but not optimised (code table, running statistics).
    pub fn buffer(&mut self, name: &str, shape: &[usize], init: Init) -> Range<usize> {
        self.trainable.get_or_insert(self.len);
        self.push(name, shape, init)
    }

    fn push(&mut self, name: &str, shape: &[usize], init: Init) -> Range<usize> {
        assert!(self.parts.iter().all(|part| part.name != name), "part `{name}` declared twice");
        let range = self.len..self.len + shape.iter().product::<usize>();
        self.len = range.end;
        self.parts.push(Part { name: name.to_owned(), shape: shape.to_vec(), range: range.clone(), init });
        range
    }

    /// Numbers in all.
    pub fn len(&self) -> usize {
        self.len
    }

    /// True for a model without parameters.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Numbers that are optimised: the first ones.
    pub fn trainable_len(&self) -> usize {
        self.trainable.unwrap_or(self.len)
    }

    /// All parts in order.
    pub fn parts(&self) -> &[Part] {
        &self.parts
    }
}

/// A model's parameters.
#[derive(Debug)]
pub struct Params {
    layout: ParamLayout,
    var: Var,
    version: u64,
}

/// What is done with the borrowed numbers, and what came of it.
struct Borrow<F, R> {
    run: RefCell<Option<F>>,
    out: RefCell<Option<R>>,
}

impl<R, F: FnOnce(&mut [f32]) -> R> InplaceOp1 for Borrow<F, R> {
    fn name(&self) -> &'static str {
        "borrow-parameters"
    }

    fn cpu_fwd(&self, storage: &mut CpuStorage, _layout: &Layout) -> candle_core::Result<()> {
        let CpuStorage::F32(numbers) = storage else { candle_core::bail!("parameters are not f32") };
        if let Some(run) = self.run.borrow_mut().take() {
            *self.out.borrow_mut() = Some(run(numbers));
        }
        Ok(())
    }
}

/// A number never given before in this process.
fn next_version() -> u64 {
    static LAST: AtomicU64 = AtomicU64::new(0);
    LAST.fetch_add(1, Ordering::Relaxed)
}

impl Params {
    /// Draws a model's start values, part by part in order.
    ///
    /// # Errors
    /// Where candle cannot make the tensor.
    pub fn init(layout: ParamLayout, rng: &mut Rng) -> candle_core::Result<Self> {
        let mut flat = vec![0.0_f32; layout.len()];
        for part in layout.parts() {
            let values = &mut flat[part.range.clone()];
            match part.init {
                Init::Uniform(bound) => values.iter_mut().for_each(|v| *v = rng.random_range(-bound..=bound)),
                Init::Zero => {}
                Init::Constant(c) => values.fill(c),
                Init::OneHot => {
                    let width = part.shape[1];
                    for row in 0..part.shape[0] {
                        values[row * width + row] = 1.0;
                    }
                }
            }
        }
        let len = flat.len();
        Ok(Self {
            layout,
            var: Var::from_tensor(&Tensor::from_vec(flat, len, &Device::Cpu)?)?,
            version: next_version(),
        })
    }

    /// A second copy with its own storage (target network).
    ///
    /// # Errors
    /// Where candle cannot copy the tensor.
    pub fn duplicate(&self) -> candle_core::Result<Self> {
        let var = Var::from_tensor(&self.var.as_tensor().copy()?)?;
        Ok(Self { layout: self.layout.clone(), var, version: next_version() })
    }

    /// Names and places.
    pub fn layout(&self) -> &ParamLayout {
        &self.layout
    }

    /// A number that changes whenever the parameters do, and that no other parameters have: for what is derived from them.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// The flat variable (for the autograd oracle).
    pub fn var(&self) -> &Var {
        &self.var
    }

    /// A part as a tensor that shares storage and gradient with the flat variable.
    ///
    /// # Errors
    /// Where there is no such part.
    pub fn tensor(&self, range: &Range<usize>, shape: &[usize]) -> candle_core::Result<Tensor> {
        self.var.as_tensor().narrow(0, range.start, range.len())?.reshape(shape)
    }

    /// Reads the flat vector.
    ///
    /// # Panics
    /// Never on the CPU device, where the storage is one contiguous `f32` vector.
    pub fn with<R>(&self, read: impl FnOnce(&[f32]) -> R) -> R {
        let (storage, _) = self.var.as_tensor().storage_and_layout();
        match &*storage {
            Storage::Cpu(CpuStorage::F32(numbers)) => read(numbers),
            _ => unreachable!("parameters live on the CPU as f32"),
        }
    }

    /// Changes the flat vector in place.
    ///
    /// # Panics
    /// Never on the CPU device.
    pub fn with_mut<R>(&mut self, write: impl FnOnce(&mut [f32]) -> R) -> R {
        self.version = next_version();
        let op = Borrow { run: RefCell::new(Some(write)), out: RefCell::new(None) };
        self.var.as_tensor().inplace_op1(&op).expect("parameters live on the CPU as f32");
        op.out.into_inner().expect("the operation ran")
    }

    /// A part's numbers, copied.
    ///
    /// # Panics
    /// Where there is no part of that name.
    pub fn part(&self, name: &str) -> Vec<f32> {
        let part = self.layout.parts.iter().find(|p| p.name == name).unwrap_or_else(|| panic!("no part `{name}`"));
        self.with(|flat| flat[part.range.clone()].to_vec())
    }

    /// Copies everything from `other` (hard target update).
    pub fn copy_from(&mut self, other: &Self) {
        other.with(|from| self.with_mut(|to| to.copy_from_slice(from)));
    }

    /// Moves towards `other`: `self += tau (other - self)` (Polyak target update).
    pub fn approach(&mut self, other: &Self, tau: f32) {
        other.with(|from| {
            self.with_mut(|to| {
                let middle = halves(to.len());
                let ((to_a, to_b), (from_a, from_b)) = (to.split_at_mut(middle), from.split_at(middle));
                let half = |to: &mut [f32], from: &[f32]| {
                    vectorised!(to.iter_mut().zip(from).for_each(|(t, &f)| *t += tau * (f - *t)));
                };
                join(|| half(to_a, from_a), || half(to_b, from_b));
            });
        });
    }

    /// All parts by name, for a checkpoint.
    pub fn export(&self) -> BTreeMap<String, (Vec<usize>, Vec<f32>)> {
        self.with(|flat| {
            let parts = self.layout.parts.iter();
            parts.map(|p| (p.name.clone(), (p.shape.clone(), flat[p.range.clone()].to_vec()))).collect()
        })
    }

    /// Takes all parts back from a checkpoint.
    ///
    /// # Errors
    /// Names the first part that is missing or has another shape.
    pub fn import(&mut self, parts: &BTreeMap<String, (Vec<usize>, Vec<f32>)>) -> Result<(), ImportError> {
        for part in &self.layout.parts {
            let (shape, values) =
                parts.get(&part.name).ok_or_else(|| ImportError::Missing { name: part.name.clone() })?;
            if *shape != part.shape || values.len() != part.range.len() {
                return Err(ImportError::Shape {
                    name: part.name.clone(),
                    expected: part.shape.clone(),
                    found: shape.clone(),
                });
            }
        }
        let layout = self.layout.clone();
        self.with_mut(|flat| {
            for part in layout.parts() {
                flat[part.range.clone()].copy_from_slice(&parts[&part.name].1);
            }
        });
        Ok(())
    }
}

/// Why stored parameters were refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ImportError {
    /// A part is not there.
    #[error("parameter `{name}` is missing: the file was written with another network configuration")]
    Missing {
        /// Its name.
        name: String,
    },
    /// A part has another shape.
    #[error("parameter `{name}` has shape {found:?}, this configuration needs {expected:?}")]
    Shape {
        /// Its name.
        name: String,
        /// Shape of this configuration.
        expected: Vec<usize>,
        /// Shape in the file.
        found: Vec<usize>,
    },
}
