//! The program `gadm-sim` as a process.

use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

use super::random_policy;

pub const SIM: &str = env!("CARGO_BIN_EXE_gadm-sim");

/// Runs it to its end.
pub fn sim(args: &[&str]) -> Output {
    Command::new(SIM).args(args).output().unwrap()
}

pub fn stderr(out: &Output) -> String {
    String::from_utf8_lossy(&out.stderr).into_owned()
}

pub fn stdout(out: &Output) -> String {
    String::from_utf8_lossy(&out.stdout).into_owned()
}

/// A process that ends with the test.
pub struct Running(pub Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts it in the background.
pub fn start(args: &[&str]) -> Running {
    Running(Command::new(SIM).args(args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap())
}

/// A file with a random policy for an environment.
pub fn policy_file(dir: &Path, id: &str, seed: u64) -> String {
    let env = gadm_envs::make(id).unwrap();
    let path = dir.join(format!("{id}-{seed}.bin"));
    std::fs::write(&path, random_policy(env.spec(), seed).as_bytes()).unwrap();
    path.to_str().unwrap().to_owned()
}
