//! `gadm report`.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context as _;
use gadm_runtime::encode::AlignedImage;
use gadm_runtime::space::ActionHead;
use gadm_runtime::{Policy, Scratch};
use gadm_trainer::atomic;
use gadm_trainer::card::{Card, ReturnStats, verify};
use gadm_trainer::plot::PlotOptions;
use gadm_trainer::plot::curve::learning_curve;
use gadm_trainer::plot::episode::{Panel, Series, episode};
use gadm_trainer::plot::usage::latent_usage;
use gadm_trainer::report::{Column, FileLink, Report};

use super::{CRITERIA_MISSED, say};

/// Arguments of `report`.
#[derive(clap::Args)]
#[command(
    after_help = "Example:\n  gadm report runs/demo --sil runs/demo/sil.json --min-return 950\n\nReads policy.bin and card.toml in the run folder (see `gadm export`), writes\nreport.html and learning-curve.svg there."
)]
pub struct Args {
    /// Run folder with policy.bin and card.toml
    run: PathBuf,
    /// Result of `gadm-sim run --json`
    #[arg(long, value_name = "FILE")]
    sil: Option<PathBuf>,
    /// Bus trace in the run folder, to link
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
    /// What each mean return has to reach; exit code 3 otherwise
    #[arg(long, value_name = "X", allow_negative_numbers = true)]
    min_return: Option<f64>,
}

/// Returns and seed of a `gadm-sim run --json` result.
pub fn sil_returns(text: &str) -> Option<(Vec<f64>, u64)> {
    let value: serde_json::Value = serde_json::from_str(text).ok()?;
    let episodes = value.get("episodes")?.as_array()?;
    let returns = episodes.iter().map(|e| e.get("return")?.as_f64()).collect::<Option<Vec<_>>>()?;
    Some((returns, value.get("seed")?.as_u64()?))
}

/// Periods of the episode figure; more would be a solid block.
const SHOWN: usize = 200;

/// Observations, actions and latents of the start of the first episode of a policy, and how often each latent was chosen.
fn fly(bytes: &[u8], seed: u64) -> anyhow::Result<(Vec<Panel>, Vec<u64>, f64)> {
    let image = AlignedImage::new(bytes);
    let policy = Policy::load(&image).map_err(|e| anyhow::anyhow!("{e}"))?;
    let mut env = gadm_envs::make(policy.provenance().environment)?;
    let spec = env.spec().clone();
    let mut memory = vec![0; policy.spec().scratch_words];
    let mut scratch = Scratch::new(&mut memory);
    let (mut obs, mut action) = (vec![0.0; spec.obs_dim()], vec![0.0; spec.action_dim()]);
    env.reset(gadm_envs::episode_seed(seed, 0), &mut obs);
    let mut observed = vec![Vec::new(); spec.obs_dim()];
    let mut acted = vec![Vec::new(); spec.action_dim()];
    let mut latents = Vec::new();
    let mut shown = 0;
    let mut counts = vec![0; usize::from(policy.spec().num_latents)];
    loop {
        let decision = policy.act(&obs, &mut scratch, &mut action).map_err(|e| anyhow::anyhow!("{e}"))?;
        if shown < SHOWN {
            shown += 1;
            observed.iter_mut().zip(&obs).for_each(|(s, &o)| s.push(f64::from(o)));
            acted.iter_mut().zip(&action).for_each(|(s, &a)| s.push(f64::from(a)));
            latents.push(f64::from(decision.latent));
        }
        counts[usize::from(decision.latent)] += 1;
        let step = env.step(&action, &mut obs);
        if step.terminated || step.truncated {
            break;
        }
    }
    // Six curves a panel stay readable.
    let observed =
        spec.observations.iter().zip(observed).take(6).map(|(s, values)| Series { name: s.name.clone(), values });
    let unit =
        spec.actions.iter().find(|a| matches!(a.head, ActionHead::Continuous { .. })).map_or("1", |a| a.unit.as_str());
    let acted = spec.actions.iter().zip(acted).take(6).map(|(s, values)| Series { name: s.name.clone(), values });
    let panels = vec![
        Panel { y_name: "observations".to_owned(), series: observed.collect() },
        Panel { y_name: format!("actions ({unit})"), series: acted.collect() },
        Panel { y_name: "latent".to_owned(), series: vec![Series { name: "latent".to_owned(), values: latents }] },
    ];
    Ok((panels, counts, f64::from(spec.control_period_us) * 1e-6))
}

fn stats_text(stats: &ReturnStats) -> [String; 4] {
    [format!("{:.2}", stats.mean), format!("{:.2}", stats.sd), stats.n.to_string(), stats.seed.to_string()]
}

/// Runs `report`.
pub fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let read = |name: &str| {
        let path = args.run.join(name);
        std::fs::read(&path).with_context(|| {
            format!(
                "cannot read {}: run `gadm export {} -o {}` first",
                path.display(),
                args.run.display(),
                args.run.join("policy.bin").display()
            )
        })
    };
    let bytes = read("policy.bin")?;
    let card = Card::from_toml(&String::from_utf8_lossy(&read("card.toml")?))?;
    verify(&card, &bytes)?;
    let sil = match &args.sil {
        Some(path) => {
            let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
            let (returns, seed) = sil_returns(&text)
                .with_context(|| format!("{} is no result of `gadm-sim run --json`", path.display()))?;
            ReturnStats::of(&returns, seed)
        }
        None => card.returns.sil,
    };
    let forms =
        [("float networks", card.returns.float), ("int8 policy file", card.returns.int8), ("over the bus", sil)];
    let mut report = Report::new(format!("{}: GADM+DQN", card.environment));
    let mut ok = true;
    for (name, stats) in &forms {
        if let (Some(stats), Some(least)) = (stats, args.min_return) {
            ok &= stats.mean >= least;
            report.verdict(stats.mean >= least, format!("{name}: mean return {:.1}, required {least}", stats.mean));
        }
    }
    let columns = vec![
        Column::text("policy"),
        Column::number("mean return"),
        Column::number("sd"),
        Column::number("episodes"),
        Column::number("seed"),
    ];
    let rows = forms
        .iter()
        .filter_map(|(name, s)| Some(std::iter::once((*name).to_owned()).chain(stats_text(s.as_ref()?)).collect()))
        .collect();
    report.table("Returns", columns, rows)?;
    let svg = learning_curve(
        &[super::plot::curve(&args.run, false)?],
        &PlotOptions::new(format!("{} while learning", card.environment)),
    )?;
    atomic::write(&args.run.join("learning-curve.svg"), svg.as_bytes())?;
    report.figure(
        "Learning curve",
        svg,
        "Greedy evaluation during training; the band is one standard deviation over the episodes.",
    )?;
    let (panels, counts, period_s) = fly(&bytes, card.returns.int8.map_or(0, |r| r.seed))?;
    report.figure(
        "One episode of the policy file",
        episode(&panels, period_s, &PlotOptions::new("Start of the first episode").with_size(820, 230))?,
        "Observations (the first six), actions and latents in the first 200 periods of the first evaluation episode.",
    )?;
    report.figure(
        "Latents in use",
        latent_usage(&counts, &PlotOptions::new("Latents of the whole episode"))?,
        "How often each latent was chosen.",
    )?;
    let p = card.parity;
    report.facts(
        "Float against int8",
        [
            ("observations compared", p.samples.to_string()),
            ("same latent", format!("{:.2} %", 100.0 * p.argmax_agreement)),
            ("action error where they agree, mean", format!("{:.5} of the range", p.action_error_mean)),
            ("action error where they agree, largest", format!("{:.5} of the range", p.action_error_max)),
        ],
    );
    let parts = card.policy.parts.iter().map(|part| vec![part.name.clone(), part.bytes.to_string()]);
    let total = std::iter::once(vec!["total".to_owned(), card.policy.bytes.to_string()]);
    report.table("Bytes by part", vec![Column::text("part"), Column::number("bytes")], parts.chain(total).collect())?;
    let t = &card.training;
    report.facts(
        "Where it comes from",
        [
            ("command", t.command.clone()),
            ("commit", t.commit.clone()),
            ("environment steps", t.env_steps.to_string()),
            ("updates", t.updates.to_string()),
            ("wall time", format!("{:.0} s", t.wall_time_s)),
            ("machine", t.machine.clone()),
            ("configuration hash", t.config_hash.clone()),
            ("policy SHA-256", card.policy.sha256.clone()),
        ],
    );
    report.code("Configuration", t.config.trim_end());
    report.files("Files", files(args))?;
    atomic::write(&args.run.join("report.html"), report.to_html().as_bytes())?;
    say(&format!("wrote {}", args.run.join("report.html").display()));
    Ok(if ok { ExitCode::SUCCESS } else { ExitCode::from(CRITERIA_MISSED) })
}

/// Links to what lies in the run folder.
fn files(args: &Args) -> Vec<FileLink> {
    let own = [
        ("policy.bin", "policy file"),
        ("card.md", "card"),
        ("metrics.jsonl", "metrics"),
        ("config.toml", "configuration"),
        ("learning-curve.svg", "learning curve"),
    ];
    let named = [(&args.sil, "result of the bus run"), (&args.trace, "bus trace (candump)")];
    let given = named.into_iter().filter_map(|(path, what)| {
        let path: &Path = path.as_deref()?;
        let inside = path.parent().is_some_and(|p| p == args.run);
        inside.then(|| (path.file_name().map(|n| n.to_string_lossy().into_owned()), what))
    });
    own.iter()
        .filter(|(name, _)| args.run.join(name).exists())
        .map(|(name, what)| FileLink { path: (*name).to_owned(), description: (*what).to_owned() })
        .chain(given.filter_map(|(name, what)| Some(FileLink { path: name?, description: what.to_owned() })))
        .collect()
}
