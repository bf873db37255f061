#!/usr/bin/env python3
"""The whole path once, for real: learn on MuJoCo physics, export to int8, drive the plant over the simulated CAN bus.

Usage: .ci/demo.py [--seed N] [--out DIR]

Exit 0 when all three mean returns reach the limit, 3 when one misses it, else the exit code of the program that failed.
"""

import argparse
import json
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ENV = "inverted-pendulum-v5"
EPISODES = 20
EVAL_SEED = 0
LIMIT = 950.0
HOPPER = Path("models/hopper-v5/policy.bin")
HOPPER_EPISODES = 5


class Failed(Exception):
    """A line for people and an exit code."""

    def __init__(self, text, code):
        super().__init__(text)
        self.code = code


def say(text=""):
    print(text, flush=True)


def shown(words):
    return shlex.join(os.path.relpath(w, ROOT) if str(w).startswith(str(ROOT)) else str(w) for w in words)


def run(words, json_output=False):
    """Runs a program in the project folder with its progress on our terminal; returns what it printed as JSON."""
    words = [str(word) for word in words]
    say(f"\n$ {shown(words)}")
    done = subprocess.run(words, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE if json_output else None)
    if done.returncode != 0:
        code = done.returncode if done.returncode > 0 else 128 - done.returncode
        raise Failed(f"`{shown(words)}` ended with exit code {code}", code)
    return json.loads(done.stdout) if json_output else None


def programs():
    """Builds both programs and returns their paths."""
    run(["cargo", "build", "--locked", "--release", "-p", "gadm-trainer", "-p", "gadm-sim"])
    metadata = subprocess.run(
        ["cargo", "metadata", "--locked", "--offline", "--no-deps", "--format-version", "1"],
        cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, check=True,
    )
    folder = Path(json.loads(metadata.stdout)["target_directory"]) / "release"
    return folder / "gadm", folder / "gadm-sim"


def new_folder(wanted):
    """A run folder that is not there yet, relative to the project folder."""
    if wanted is not None:
        path = Path(os.path.relpath(Path.cwd() / wanted, ROOT))
        if (ROOT / path).exists():
            raise Failed(f"{path} exists; name another folder with --out, or remove it", 1)
        return path
    number = 1
    while (ROOT / f"runs/demo-{number}").exists():
        number += 1
    return Path(f"runs/demo-{number}")


def table(rows):
    """Columns as wide as their widest cell; the first to the left, the others to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0])] + [cell.rjust(width) for cell, width in zip(row[1:], widths[1:])]
        lines.append("  " + "  ".join(cells).rstrip())
    lines.insert(1, "  " + "  ".join("-" * width for width in widths))
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(prog=".ci/demo.py", description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="seed of the training")
    parser.add_argument("--out", help="run folder [default: the first free runs/demo-N]")
    args = parser.parse_args()

    folder = new_folder(args.out)
    hopper = ROOT / HOPPER
    if not hopper.exists():
        raise Failed(f"{HOPPER} is missing; bring it back with `git checkout -- {HOPPER.parent}`", 1)

    say("== build (once; a few minutes)")
    gadm, sim = programs()
    start = time.monotonic()

    say(f"\n== learn {ENV} from nothing, on MuJoCo physics")
    run([gadm, "train", "--env", ENV, "--seed", args.seed, "--out", folder])
    trained_s = time.monotonic() - start

    say("\n== export to an int8 policy file, and measure the same 20 episodes in three forms")
    policy, trace = folder / "policy.bin", folder / "bus.log"
    measure = ["--episodes", EPISODES, "--seed", EVAL_SEED]
    run([gadm, "export", folder, "-o", policy, *measure])
    as_float = run([gadm, "eval", folder, *measure, "--json"], json_output=True)
    as_int8 = run([gadm, "eval", policy, *measure, "--json"], json_output=True)
    bus = run([sim, "run", policy, "--plant", ENV, *measure, "--trace", trace, "--json"], json_output=True)
    sil = folder / "sil.json"
    (ROOT / sil).write_text(json.dumps(bus, indent=2) + "\n", encoding="utf-8")
    content = run([gadm, "inspect", policy, "--json"], json_output=True)

    say(f"\n== {HOPPER}, as shipped, over the bus")
    run([sim, "run", hopper, "--episodes", HOPPER_EPISODES, "--seed", EVAL_SEED])

    say("\n== report")
    run([gadm, "report", folder, "--sil", sil, "--trace", trace, "--min-return", LIMIT])

    forms = [
        ("float networks, host", as_float["mean"], as_float["sd"], as_float["latents_used"]),
        ("int8 policy file, host", as_int8["mean"], as_int8["sd"], as_int8["latents_used"]),
        ("int8, over the bus", bus["returns"]["mean"], bus["returns"]["sd"], bus["latents_used"]),
    ]
    latents = content["latents"]
    say(f"\n== result: {ENV}, {EPISODES} episodes each, same seeds\n")
    rows = [["policy", "mean return", "± sd", "latents used"]]
    rows += [[name, f"{mean:.2f}", f"{sd:.2f}", f"{used} of {latents}"] for name, mean, sd, used in forms]
    say(table(rows))
    say()
    rows = [["part of policy.bin", "bytes"]] + [[part["name"], str(part["bytes"])] for part in content["parts"]]
    say(table(rows + [["total", str(content["bytes"])]]))
    same = as_int8["returns"] == [episode["return"] for episode in bus["episodes"]]
    say(f"\n  host and bus: {'equal returns in every episode, to the last bit' if same else 'RETURNS DIFFER'}")
    total_s = time.monotonic() - start
    say(f"  time: {trained_s:.0f} s of training, {total_s:.0f} s in all after the build")

    say("\n== what lies where\n")
    files = [
        ("report.html", "report with all figures; open it in a browser"),
        ("learning-curve.svg", "return while learning"),
        ("policy.bin", "what a device gets"),
        ("card.md", "its card"),
        ("bus.log", "every frame on the bus, as candump writes it"),
        ("sil.json", "result of the bus run"),
        ("metrics.jsonl", "metrics of the training"),
        ("config.toml", "resolved configuration"),
    ]
    missing = [name for name, _ in files if not (ROOT / folder / name).exists()]
    say("\n".join(f"  {folder}/{name:<20} {what}" for name, what in files if name not in missing))

    if missing:
        raise Failed(f"not written: {', '.join(missing)}", 1)
    if not same:
        raise Failed("the bus changed the policy's actions; see sil.json and bus.log", 3)
    low = [f"{name}: {mean:.2f}" for name, mean, _, _ in forms if not mean >= LIMIT]
    if low:
        raise Failed(f"mean return below {LIMIT:.0f} of 1000 ({'; '.join(low)}); another --seed may learn it", 3)
    say(f"\ndemo: passed, every mean return reaches {LIMIT:.0f} of 1000")


if __name__ == "__main__":
    try:
        main()
    except Failed as failed:
        print(f"\ndemo: {failed}", file=sys.stderr)
        sys.exit(failed.code)
    except KeyboardInterrupt:
        print("\ndemo: interrupted", file=sys.stderr)
        sys.exit(130)
