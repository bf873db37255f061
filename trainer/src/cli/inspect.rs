//! `gadm inspect`.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context as _;
use gadm_runtime::encode::AlignedImage;
use gadm_runtime::{ActionHead, Policy, Scratch};
use gadm_trainer::export::parts_of;
use serde_json::json;

use super::{print, print_json};

/// Arguments of `inspect`.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  gadm inspect models/hopper-v5/policy.bin\n\nExit code 1 where the file is refused, with the reason."
)]
pub struct Args {
    /// Policy file
    policy: PathBuf,
    /// Print everything as JSON
    #[arg(long)]
    json: bool,
}

fn head_text(head: ActionHead) -> String {
    match head {
        ActionHead::Continuous { lo, hi } => format!("{lo} to {hi}"),
        ActionHead::Discrete { n } => format!("one of {n}"),
        ActionHead::Binary => "off or on".to_owned(),
    }
}

/// Runs `inspect`.
pub fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let bytes = std::fs::read(&args.policy).with_context(|| format!("cannot read {}", args.policy.display()))?;
    let image = AlignedImage::new(&bytes);
    let policy = Policy::load(&image).map_err(|e| anyhow::anyhow!("{}: {e}", args.policy.display()))?;
    let mut memory = vec![0; policy.spec().scratch_words];
    let self_test = match gadm_runtime::FloatPolicy::load(&image) {
        Ok(float) => float.self_test(&mut Scratch::new(&mut memory)).err(),
        Err(_) => policy.self_test(&mut Scratch::new(&mut memory)).err(),
    };
    let (header, spec, provenance) = (policy.header(), policy.spec(), policy.provenance());
    let sizes = parts_of(&policy.section_sizes());
    let self_test = self_test.map_or_else(|| "passed".to_owned(), |e| format!("FAILED: {e}"));
    let mask = policy.mask_threshold().map(|(n, d)| format!("{n}/{d}"));
    if args.json {
        let layers: Vec<_> = policy
            .layers()
            .map(|l| json!({ "network": l.network.name(), "rows": l.rows, "cols": l.cols, "out_bits": l.out_bits, "bytes": l.bytes }))
            .collect();
        let observations: Vec<_> = policy
            .observation_signals()
            .map(|s| json!({ "name": s.name, "unit": s.unit, "low": s.lo, "high": s.hi }))
            .collect();
        let actions: Vec<_> = policy
            .action_signals()
            .map(|s| json!({ "name": s.name, "unit": s.unit, "head": s.head, "safe": s.safe }))
            .collect();
        print_json(&json!({
            "version": 1,
            "file": args.policy,
            "format": header.format,
            "numerics": header.numerics,
            "bytes": header.total_len,
            "payload_crc32": format!("{:08x}", header.payload_crc32),
            "interface_hash": format!("{:016x}", header.interface_hash),
            "policy_seq": header.policy_seq,
            "weights": format!("{:?}", spec.weights),
            "observations": observations,
            "actions": actions,
            "latents": spec.num_latents,
            "control_period_us": spec.control_period_us,
            "scratch_bytes": 4 * spec.scratch_words,
            "macs": spec.macs,
            "mask_threshold": mask,
            "shared_trunk": policy.shared_trunk(),
            "layers": layers,
            "parts": sizes.iter().map(|(n, b)| json!({ "name": n, "bytes": b })).collect::<Vec<_>>(),
            "self_test": self_test,
            "provenance": {
                "environment": provenance.environment,
                "algorithm": provenance.algorithm,
                "config_hash": provenance.config_hash,
                "commit": provenance.commit,
                "train_seed": provenance.train_seed,
                "eval_seed": provenance.eval_seed,
                "env_steps": provenance.env_steps,
                "float_return": { "mean": provenance.float_return.mean, "sd": provenance.float_return.std, "episodes": provenance.float_return.episodes },
                "device_return": { "mean": provenance.device_return.mean, "sd": provenance.device_return.std, "episodes": provenance.device_return.episodes },
            },
        }))?;
        return Ok(ExitCode::SUCCESS);
    }
    let trunk = if policy.shared_trunk() { " (read off the Q-network's last hidden layer)" } else { "" };
    let mut text = vec![
        format!(
            "{}: format {}, numerics {}, {} bytes, payload CRC-32 {:08x}",
            args.policy.display(),
            header.format,
            header.numerics,
            header.total_len,
            header.payload_crc32
        ),
        format!(
            "interface {:016x}, policy sequence {}, weights {:?}, self-test {self_test}",
            header.interface_hash, header.policy_seq, spec.weights
        ),
        format!(
            "made for {} by {}, {} steps, seed {}, commit {}, configuration {}",
            provenance.environment,
            provenance.algorithm,
            provenance.env_steps,
            provenance.train_seed,
            provenance.commit,
            provenance.config_hash
        ),
        format!(
            "return: float {:.2} ± {:.2}, this file {:.2} ± {:.2} ({} episodes, seed {})",
            provenance.float_return.mean,
            provenance.float_return.std,
            provenance.device_return.mean,
            provenance.device_return.std,
            provenance.device_return.episodes,
            provenance.eval_seed
        ),
        format!(
            "{} latents, mask threshold {}, a decision every {} µs, {} multiply-accumulates, {} bytes of scratch memory",
            spec.num_latents,
            mask.map_or_else(|| "none".to_owned(), |mask| format!("{mask}{trunk}")),
            spec.control_period_us,
            spec.macs,
            4 * spec.scratch_words
        ),
        String::new(),
        format!("{:3} {:28} {:8} {:>12} {:>12}", "in", "observation", "unit", "low", "high"),
    ];
    for (i, s) in policy.observation_signals().enumerate() {
        text.push(format!("{i:3} {:28} {:8} {:>12.4} {:>12.4}", s.name, s.unit, s.lo, s.hi));
    }
    text.push(format!("{:3} {:28} {:8} {:>25} {:>12}", "out", "action", "unit", "range", "safe"));
    for (i, s) in policy.action_signals().enumerate() {
        text.push(format!("{i:3} {:28} {:8} {:>25} {:>12}", s.name, s.unit, head_text(s.head), s.safe));
    }
    text.push(String::new());
    text.push(format!("{:24} {:>12} {:>10} {:>10}", "layer", "shape", "out bits", "bytes"));
    for l in policy.layers() {
        text.push(format!(
            "{:24} {:>12} {:>10} {:>10}",
            l.network.name(),
            format!("{} x {}", l.rows, l.cols),
            l.out_bits,
            l.bytes
        ));
    }
    text.push(String::new());
    text.push(format!("{:24} {:>10}", "part", "bytes"));
    for (name, bytes) in sizes {
        text.push(format!("{name:24} {bytes:>10}"));
    }
    print(&text.join("\n"))?;
    Ok(ExitCode::SUCCESS)
}
