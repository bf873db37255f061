"""The programs and models of the repository, and how tests call them."""

import json
import os
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MODELS = ["hopper-v5", "inverted-pendulum-v5", "moving"]
PROFILES = ["fd-f32", "classic-i16"]


def program(name, package):
    target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    path = Path(os.environ.get("GADM_BIN", target / "debug")) / name
    if not path.exists():
        raise RuntimeError(f"{path} is not there; build it with `cargo build -p {package}`")
    return str(path)


def sim_path():
    """The program `gadm-sim`."""
    return program("gadm-sim", "gadm-sim")


def gadm_path():
    """The program `gadm`."""
    return program("gadm", "gadm-trainer")


def sim(*words, code=0):
    """Runs `gadm-sim` and returns what it printed for programs; any other exit status than `code` is an error."""
    done = subprocess.run([sim_path(), *map(str, words)], capture_output=True, text=True, timeout=300)
    if done.returncode != code:
        raise AssertionError(f"gadm-sim {words}: exit {done.returncode} instead of {code}\n{done.stderr}")
    return done.stdout


def policy(model):
    return ROOT / "models" / model / "policy.bin"


def trace(folder, model, profile, episodes=1, seed=3):
    """A trace of a run, and the result of the run."""
    path = Path(folder) / f"{model}-{profile}.log"
    words = ["--episodes", episodes, "--seed", seed, "--profile", profile, "--trace", path, "--json", "-q"]
    return path, json.loads(sim("run", policy(model), *words))


def database(folder, model, profile, node=1):
    path = Path(folder) / f"{model}-{profile}.dbc"
    sim("dbc", policy(model), "--profile", profile, "--node", node, "-o", path)
    return path


def decoded(path, model):
    """The frames of a trace as our decoder reads them."""
    return [json.loads(line) for line in sim("trace", path, "--policy", policy(model), "--json").splitlines()]
