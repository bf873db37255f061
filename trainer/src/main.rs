use gadm_trainer::config::{Layer, TrainConfig, resolve::resolve};
use gadm_trainer::runner::{TrainOptions, progress::Style, train};
use std::sync::atomic::AtomicBool;
static STOP: AtomicBool = AtomicBool::new(false);
fn main() -> anyhow::Result<()> {
    tracing_subscriber::fmt().with_writer(std::io::stderr).init();
    ctrlc::set_handler(|| STOP.store(true, std::sync::atomic::Ordering::Relaxed))?;
    let mut args = std::env::args().skip(1);
    let dir = args.next().unwrap().into();
    let resume = dir == std::path::PathBuf::from("x");
    let layers: Vec<Layer> = args.map(Layer::Set).collect();
    let config: TrainConfig = resolve(&layers)?;
    let out = train(&TrainOptions { config: Some(config), dir, resume, style: Style::detect(false), stop: &STOP })?;
    println!("{out:?}");
    Ok(())
}
