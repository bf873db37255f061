//! The same layers as plain candle operations, differentiated by candle's autograd: how a graph runs on a GPU, and on the
//! processor the oracle of every fused value and gradient.

use std::ops::Range;

use candle_core::{D, DType, Device, Result, Tensor, Var};

use super::super::parallel::PARTS;
use super::workspace::Given;
use super::{Graph, Op, STANDARDISE_EPS, Slot, Workspace};

/// Every value of a pass, with what an argmin and a batch leave beside it.
#[derive(Debug)]
pub struct Evaluated {
    /// By slot.
    pub values: Vec<Tensor>,
    /// Codes of the last quantisation.
    codes: Option<Tensor>,
    /// Per standardisation of a training pass: its place among the layers, mean and biased variance.
    statistics: Vec<(usize, Tensor, Tensor)>,
}

/// What the backward pass needs of the forward pass.
#[derive(Clone, Debug)]
pub(super) struct Traced {
    values: Vec<Tensor>,
    /// Inputs with a gradient.
    inputs: Vec<(usize, Var)>,
}

/// For a device that gives up in the middle of a run: out of memory, or lost.
pub(super) fn done<T>(result: Result<T>) -> T {
    result.unwrap_or_else(|e| panic!("the device that evaluates the networks failed: {e}"))
}

fn host(tensor: &Tensor) -> Result<Vec<f32>> {
    tensor.flatten_all()?.to_vec1()
}

impl Graph {
    /// Evaluates the graph with candle, on the device of `flat`, which holds the parameters. `inputs` are the input slots with
    /// their tensors (`batch x width`). `train` chooses batch statistics. `codes` are the choices of a quantisation where they
    /// are known; without, the nearest code is searched for.
    ///
    /// # Errors
    /// Whatever candle reports.
    ///
    /// # Panics
    /// Where an input is missing.
    pub fn evaluate(
        &self,
        flat: &Tensor,
        inputs: &[(Slot, Tensor)],
        train: bool,
        codes: Option<&[u32]>,
    ) -> Result<Evaluated> {
        let mut values: Vec<Option<Tensor>> = vec![None; self.widths.len()];
        for (slot, tensor) in inputs {
            values[slot.0] = Some(tensor.clone());
        }
        let (mut chosen, mut statistics) = (None, Vec::new());
        let part = |range: &Range<usize>, shape: &[usize]| flat.narrow(0, range.start, range.len())?.reshape(shape);
        for (i, op) in self.ops.iter().enumerate() {
            let get = |slot: &usize| values[*slot].as_ref().expect("a value is computed before it is read");
            let (y, value) = match op {
                Op::Dense { x, y, w, b, relu, .. } => {
                    let (n, k) = (self.widths[*y], self.widths[*x]);
                    let value = get(x).matmul(&part(w, &[n, k])?.t()?)?.broadcast_add(&part(b, &[n])?)?;
                    (*y, if *relu { value.relu()? } else { value })
                }
                Op::Mul { a, b, y } => (*y, (get(a) * get(b))?),
                Op::Concat { a, b, y } => (*y, Tensor::cat(&[get(a), get(b)], 1)?),
                Op::Film { x, scale, shift, y, relu } => {
                    let value = (((get(scale) + 1.0)? * get(x))? + get(shift))?;
                    (*y, if *relu { value.relu()? } else { value })
                }
                Op::Standardise { x, y, mean, var, gain, .. } => {
                    let (x, width) = (get(x), self.widths[*y]);
                    let (mean, var) = if train {
                        let mean = x.mean_keepdim(0)?;
                        let var = x.broadcast_sub(&mean)?.sqr()?.mean_keepdim(0)?;
                        statistics.push((i, mean.clone(), var.clone()));
                        (mean, var)
                    } else {
                        (part(mean, &[1, width])?, part(var, &[1, width])?)
                    };
                    let deviation = (var + f64::from(STANDARDISE_EPS))?.sqrt()?;
                    (*y, (x.broadcast_sub(&mean)?.broadcast_div(&deviation)? * f64::from(*gain))?)
                }
                Op::Quantise { x, y, table, one_hot } => {
                    let (x, width) = (get(x), self.widths[*x]);
                    let table = part(table, &[table.len() / width, width])?.detach();
                    let codes = match codes {
                        Some(codes) => Tensor::new(codes, x.device())?,
                        None if *one_hot => x.narrow(1, 0, table.dim(0)?)?.argmax(D::Minus1)?,
                        None => {
                            let apart = x.detach().unsqueeze(1)?.broadcast_sub(&table.unsqueeze(0)?)?;
                            apart.sqr()?.sum(D::Minus1)?.argmin(D::Minus1)?
                        }
                    };
                    let rows = table.index_select(&codes, 0)?;
                    chosen = Some(codes);
                    // Straight through: the value is the code's, the gradient the position's.
                    (*y, (x + (rows - x)?.detach())?)
                }
            };
            values[y] = Some(value);
        }
        let values = values.into_iter().map(|v| v.expect("every value is computed")).collect();
        Ok(Evaluated { values, codes: chosen, statistics })
    }

    /// The forward pass on the device of `flat`, over all parts at once; leaves in the workspaces what is read outside the graph.
    ///
    /// # Panics
    /// Where the device fails, or a workspace is smaller than its part.
    pub(super) fn forward_on_device(
        &self,
        flat: &Var,
        parts: &mut [Workspace],
        rows: &[Range<usize>; PARTS],
        train: bool,
    ) {
        for (ws, rows) in parts.iter_mut().zip(rows) {
            ws.begin(rows.len());
        }
        done(self.try_forward(flat, parts, train));
    }

    fn try_forward(&self, flat: &Var, parts: &mut [Workspace], train: bool) -> Result<()> {
        let (mut inputs, mut traced) = (Vec::new(), Vec::new());
        for slot in (0..self.widths.len()).filter(|slot| self.is_input(*slot)) {
            let mut tensor = self.joined(parts, slot, |ws| &ws.act, flat.device())?;
            if train && self.needs_grad[slot] {
                let var = Var::from_tensor(&tensor)?;
                tensor = var.as_tensor().clone();
                traced.push((slot, var));
            }
            inputs.push((Slot(slot), tensor));
        }
        let weights = if train { flat.as_tensor().clone() } else { flat.as_detached_tensor() };
        let Evaluated { values, codes, statistics } = self.evaluate(&weights, &inputs, train, None)?;
        for slot in (0..self.widths.len()).filter(|slot| self.is_read(*slot)) {
            self.spread(&host(&values[slot])?, parts, slot, |ws| &mut ws.act);
        }
        if let Some(codes) = codes {
            let mut codes = codes.to_vec1::<u32>()?.into_iter();
            for ws in &mut *parts {
                ws.codes[..ws.batch].iter_mut().zip(&mut codes).for_each(|(to, code)| *to = code);
            }
        }
        for (op, mean, var) in &statistics {
            let both = [host(mean)?, host(var)?].concat();
            for ws in &mut *parts {
                ws.stats[*op][..both.len()].copy_from_slice(&both);
            }
        }
        parts[0].traced = train.then_some(Traced { values, inputs: traced });
        Ok(())
    }

    /// The backward pass after [`forward_on_device`](Self::forward_on_device). The gradient of the parameters is that of all
    /// parts and lies in the first one; `frozen` leaves it out.
    ///
    /// # Panics
    /// Where the device fails.
    pub(super) fn backward_on_device(&self, flat: &Var, parts: &mut [Workspace], frozen: bool) {
        done(self.try_backward(flat, parts, frozen));
    }

    fn try_backward(&self, flat: &Var, parts: &mut [Workspace], frozen: bool) -> Result<()> {
        let Traced { values, inputs } = parts[0].traced.take().expect("a training pass comes before its gradient");
        let mut loss = Tensor::zeros((), DType::F32, flat.device())?;
        for (slot, value) in values.iter().enumerate().filter(|(slot, _)| parts[0].given[*slot] != Given::Nothing) {
            let grad = self.joined(parts, slot, |ws| &ws.grad, flat.device())?;
            loss = (loss + (value * grad)?.sum_all()?)?;
        }
        let store = loss.backward()?;
        for (slot, var) in &inputs {
            if let Some(grad) = store.get(var) {
                self.spread(&host(grad)?, parts, *slot, |ws| &mut ws.grad);
            }
        }
        if frozen {
            return Ok(());
        }
        let gradient = store.get(flat).map(host).transpose()?;
        for op in &self.ops {
            let Op::Dense { w, b, .. } = op else { continue };
            for range in [w, b] {
                for ws in &mut *parts {
                    ws.gradient[range.clone()].fill(0.0);
                }
                if let Some(gradient) = &gradient {
                    parts[0].gradient[range.clone()].copy_from_slice(&gradient[range.clone()]);
                }
            }
        }
        Ok(())
    }

    fn is_input(&self, slot: usize) -> bool {
        !self.ops.iter().any(|op| op.output() == slot)
    }

    /// Whether losses and other networks read a value: what no layer reads, and the positions of a quantisation.
    fn is_read(&self, slot: usize) -> bool {
        let by_layer = |op: &Op| op.reads(slot) && !matches!(op, Op::Quantise { .. });
        !self.is_input(slot) && !self.ops.iter().any(by_layer)
    }

    /// The rows of all parts as one tensor on `device`.
    fn joined(
        &self,
        parts: &[Workspace],
        slot: usize,
        of: impl Fn(&Workspace) -> &Vec<Vec<f32>>,
        device: &Device,
    ) -> Result<Tensor> {
        let width = self.widths[slot];
        let rows: Vec<&[f32]> = parts.iter().map(|ws| &of(ws)[slot][..ws.batch * width]).collect();
        let numbers = rows.concat();
        Tensor::from_vec(numbers, (parts.iter().map(|ws| ws.batch).sum::<usize>(), width), device)
    }

    /// Gives every part its rows of a value.
    fn spread(
        &self,
        numbers: &[f32],
        parts: &mut [Workspace],
        slot: usize,
        of: impl Fn(&mut Workspace) -> &mut Vec<Vec<f32>>,
    ) {
        let mut rest = numbers;
        for ws in parts {
            let (own, others) = rest.split_at(ws.batch * self.widths[slot]);
            of(ws)[slot][..own.len()].copy_from_slice(own);
            rest = others;
        }
    }
}
