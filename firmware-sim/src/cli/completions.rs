//! `gadm-sim completions`.

use std::process::ExitCode;

use clap::CommandFactory as _;
use clap_complete::Shell;

const EXAMPLES: &str = "\
Examples:
  gadm-sim completions bash > ~/.local/share/bash-completion/completions/gadm-sim
  gadm-sim completions fish > ~/.config/fish/completions/gadm-sim.fish
  eval \"$(gadm-sim completions zsh)\"";

/// Arguments of `completions`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The shell
    shell: Shell,
}

/// Runs the command.
pub(crate) fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut super::Cli::command(), "gadm-sim", &mut script);
    std::io::Write::write_all(&mut std::io::stdout().lock(), &script)?;
    Ok(ExitCode::SUCCESS)
}
