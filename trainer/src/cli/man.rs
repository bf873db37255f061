//! `gadm man`.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context as _;
use clap::CommandFactory as _;

use super::say;

const EXAMPLES: &str = "\
Examples:
  gadm man ~/.local/share/man/man1    # then: man gadm
  gadm man . && man ./gadm-train.1";

/// Arguments of `man`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// Folder for the pages, one for each command; made where it is missing
    dir: PathBuf,
}

/// Runs `man`.
pub fn main(args: &Args) -> anyhow::Result<ExitCode> {
    let dir = args.dir.display();
    let next = || format!("cannot write manual pages into {dir}: name a folder that can be written");
    std::fs::create_dir_all(&args.dir).with_context(next)?;
    clap_mangen::generate_to(super::Cli::command(), &args.dir).with_context(next)?;
    say(&format!("wrote gadm.1 and a page for each command into {dir}"));
    Ok(ExitCode::SUCCESS)
}
