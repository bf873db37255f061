#!/usr/bin/env python3
"""All checks and tests, cheapest first, with a summary of stages and, last, the sum of the tests.

Usage: .ci/test.py [--list | STAGE ...]

A stage that fails does not stop the following ones. In the sum every test counts one, and so does every stage that has
no tests of its own (format, lints, builds). Exit 0 when nothing failed, else 1; 2 for an unknown stage.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DEVICE = "thumbv7em-none-eabihf"
DEVICES = [DEVICE, "thumbv7m-none-eabi", "thumbv8m.main-none-eabihf", "riscv32imac-unknown-none-elf"]
EMBASSY = "firmware-sim/embassy-example/Cargo.toml"
FUZZ_SECONDS = "30"

CARGO_RESULT = re.compile(r"^test result: \w+\. (\d+) passed; (\d+) failed; (\d+) ignored;")
SCRIPT_RESULT = re.compile(r"^(ok|FAILED): ")
NOT_RUN = 4  # exit status of a script that says in a line `not run: …` what is lacking


def cargo(*words):
    """A cargo command that refuses to change the lock file. What comes after `--` stays behind `--locked`."""
    words = list(words)
    end = words.index("--") if "--" in words else len(words)
    return ["cargo", *words[:end], "--locked", *words[end:]]


def clippy(*words):
    return cargo("clippy", "--quiet", *words, "--", "-D", "warnings")


class Stage:
    """Commands that run one after the other; the first that fails ends the stage."""

    def __init__(self, name, what, commands, limit_s=600, env=None, needs=None):
        self.name, self.what, self.commands = name, what, commands
        self.limit_s, self.env = limit_s, env or {}
        self.needs = needs  # (programs, what to do without it, whether the stage may then be left out)
        self.passed = self.failed = self.ignored = 0
        self.state, self.wall_s, self.note, self.lacking = "", 0.0, "", ""


def stages():
    core = ["-p", "gadm-runtime", "-p", "gadm-node", "--no-default-features"]
    return [
        Stage("fmt", "formatting", [["cargo", "fmt", "--all", "--check"]]),
        Stage("setup", "error messages of the set-up scripts", [[".ci/setup-test.sh"], [".ci/wheel-test.sh"]]),
        Stage(
            "deny",
            "licences, bans and sources of the dependencies (cargo-deny)",
            [["cargo-deny", "check", "--config", ".deny.toml", "bans", "licenses", "sources"]],
            needs=("cargo-deny", "not run: cargo-deny is not installed (cargo install cargo-deny)", True),
        ),
        Stage(
            "devices",
            "runtime and node built for four microcontrollers",
            [cargo("build", "--quiet", *core, "--target", target) for target in DEVICES]
            + [cargo("build", "--quiet", "-p", "gadm-runtime", "--features", "float", "--target", DEVICE)],
        ),
        Stage("no-panic", "no panic reachable on a device", [["runtime/tests/no-panic/run.sh"]]),
        Stage(
            "target",
            "kernels bit-equal and within their budgets on emulated Cortex-M4 and M7",
            [
                ["cargo", "fmt", "--manifest-path", "firmware-sim/target-bench/Cargo.toml", "--check"],
                [".ci/bench-target.py", "--check"],
            ],
            needs=("qemu-system-arm", "not run: no qemu-system-arm (Debian: apt-get install qemu-system-arm)", True),
        ),
        Stage(
            "c-api",
            "C library: format, lints, header, no panic, bits of the Rust runtime on this machine",
            [
                ["cargo", "fmt", "--manifest-path", "runtime/c-api/Cargo.toml", "--check"],
                ["cargo", "fmt", "--manifest-path", "runtime/c-api/tests/Cargo.toml", "--check"],
                clippy("--manifest-path", "runtime/c-api/Cargo.toml", "--release"),
                clippy("--manifest-path", "runtime/c-api/Cargo.toml", "--release", "--features", "trust-exporter"),
                clippy("--manifest-path", "runtime/c-api/tests/Cargo.toml", "--all-targets", "--all-features"),
                ["runtime/c-api/tests/no-panic.sh"],
                cargo("test", "--manifest-path", "runtime/c-api/tests/Cargo.toml", "--no-fail-fast"),
            ],
            needs=("cc c++", "no C and C++ compiler; install them (Debian: apt-get install build-essential)", False),
        ),
        Stage(
            "c-api-target",
            "C library on an emulated Cortex-M4F: the bits of the host",
            [cargo("test", "--manifest-path", "runtime/c-api/tests/Cargo.toml", "--features", "target", "--test", "qemu")],
            needs=(
                "arm-none-eabi-gcc qemu-system-arm",
                "not run: no arm-none-eabi-gcc or qemu-system-arm (Debian: apt-get install gcc-arm-none-eabi qemu-system-arm)",
                True,
            ),
        ),
        Stage(
            "firmware",
            "firmware for three boards; no panic can be reached in it",
            [
                ["cargo", "fmt", "--manifest-path", "firmware-sim/firmware/Cargo.toml", "--check"],
                ["firmware-sim/firmware/build.sh", "--check"],
            ],
        ),
        Stage(
            "embassy",
            "example for the NUCLEO-H743ZI2, CAN FD with embassy-stm32: it compiles and links (not run: no such board here)",
            [
                ["cargo", "fmt", "--manifest-path", EMBASSY, "--check"],
                [
                    *cargo("build", "--quiet", "--release", "--manifest-path", EMBASSY, "--target", DEVICE),
                    *("--target-dir", os.environ.get("CARGO_TARGET_DIR", "target/embassy-example")),
                ],
            ],
        ),
        Stage(
            "boards",
            "firmware on emulated boards: frames of the run in process, decisions of the host, python-can as plant",
            [
                clippy("-p", "gadm-sim", "--test", "qemu"),
                cargo("test", "-p", "gadm-sim", "--test", "qemu", "--", "--test-threads", "2"),
                [".ci/python.sh"],
                ["target/python/bin/python", "tests/python/board.py"],
            ],
            limit_s=900,
            needs=("qemu-system-arm", "not run: no qemu-system-arm (Debian: apt-get install qemu-system-arm)", True),
        ),
        Stage(
            "runtime",
            "runtime as a device has it: without features",
            [cargo("test", "--quiet", "-p", "gadm-runtime", "--no-default-features")],
        ),
        Stage(
            "clippy",
            "lints: workspace, without MuJoCo and Box2D, single features, device",
            [
                clippy("--workspace", "--all-targets"),
                clippy("--workspace", "--all-targets", "--no-default-features"),
                clippy("-p", "gadm-runtime", "--all-targets"),
                clippy("-p", "gadm-runtime", "--all-targets", "--features", "encode"),
                clippy("-p", "gadm-runtime", "--all-targets", "--features", "float"),
                clippy(*core, "--target", DEVICE),
                clippy("-p", "gadm-node", "--features", "trust-exporter", "--target", DEVICE),
            ],
            limit_s=900,
        ),
        Stage(
            "docs",
            "rustdoc without warnings",
            [cargo("doc", "--quiet", "--workspace", "--no-deps")],
            env={"RUSTDOCFLAGS": "-D warnings"},
        ),
        Stage(
            "tests",
            "all tests and examples of the workspace",
            [cargo("test", "--workspace", "--no-fail-fast")],
            limit_s=1500,
        ),
        Stage(
            "socketcan",
            "node and plant on SocketCAN: vcan of this kernel, or of Debian's in QEMU",
            [[".ci/guest.py"]],
            limit_s=900,
        ),
        Stage(
            "peers",
            "cantools, python-can and a Gymnasium plant against gadm-sim; HyperQueue runs the job array of `gadm paper`",
            [
                [".ci/python.sh"],
                cargo("build", "--quiet", "--workspace", "--bins"),
                ["target/python/bin/python", "tests/python/run.py"],
            ],
            needs=("python3", "not run: no python3 (Debian: apt-get install python3 python3-pip)", True),
        ),
        Stage(
            "fuzz",
            f"fuzz targets, {FUZZ_SECONDS} s each",
            [["tests/fuzz/run.sh", FUZZ_SECONDS]],
            needs=("c++", "no C++ compiler, which builds libFuzzer; install it (Debian: apt-get install g++)", False),
        ),
    ]


def run_command(stage, command, deadline):
    """Runs one command with its output on ours, counts test results in it, and returns its exit status."""
    print(f"$ {' '.join(command)}", flush=True)
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        env={**os.environ, **stage.env},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,  # so that a hung test dies with its stage
    )

    def stop(*_):
        try:
            os.killpg(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass

    def too_late(*_):
        stage.note = f"stopped after {stage.limit_s} s"
        stop()

    signal.signal(signal.SIGALRM, too_late)
    signal.alarm(max(1, int(deadline - time.monotonic())))
    try:
        for line in process.stdout:
            sys.stdout.write(line)
            sys.stdout.flush()
            if found := CARGO_RESULT.match(line):
                stage.passed += int(found[1])
                stage.failed += int(found[2])
                stage.ignored += int(found[3])
            elif found := SCRIPT_RESULT.match(line):
                stage.passed += found[1] == "ok"
                stage.failed += found[1] == "FAILED"
            elif line.startswith("not run: "):
                stage.lacking = line.strip()
        return process.wait()
    except BaseException:
        stop()
        raise
    finally:
        signal.alarm(0)


def run_stage(stage):
    print(f"\n== {stage.name}: {stage.what}", flush=True)
    if stage.needs and not all(shutil.which(program) for program in stage.needs[0].split()):
        _, stage.note, may_be_left_out = stage.needs
        stage.state = "not run" if may_be_left_out else "FAILED"
        stage.failed += not may_be_left_out
        print(stage.note, flush=True)
        return
    start = time.monotonic()
    code = 0
    for command in stage.commands:
        code = run_command(stage, command, start + stage.limit_s)
        if code != 0:
            stage.note = stage.note or f"exit {code}: {' '.join(command)}"
            break
    stage.wall_s = time.monotonic() - start
    if code == NOT_RUN and stage.lacking:
        stage.state, stage.note = "not run", stage.lacking
        return
    stage.state = "ok" if code == 0 else "FAILED"
    if code != 0 and stage.failed == 0:
        stage.failed = 1
    elif code == 0 and stage.passed == 0:
        stage.passed = 1


def main(words):
    known = stages()
    if words == ["--list"]:
        for stage in known:
            print(f"{stage.name:<10} {stage.what}")
        return 0
    unknown = [word for word in words if word not in [stage.name for stage in known]]
    if unknown:
        print(f"test: no stage `{unknown[0]}`; .ci/test.py --list names them", file=sys.stderr)
        return 2
    # What incremental builds keep for the next edit is more than half of the target folder, and nobody edits here.
    os.environ.setdefault("CARGO_INCREMENTAL", "0")
    chosen = [stage for stage in known if not words or stage.name in words]
    for stage in chosen:
        run_stage(stage)

    print("\n== summary")
    for s in chosen:
        counts = f"{s.passed} passed, {s.failed} failed" + (f", {s.ignored} ignored" if s.ignored else "")
        print(f"{s.name:<10} {s.state:<8} {s.wall_s:7.1f} s   {counts if s.state != 'not run' else ''}  {s.note}".rstrip())
    total_s = sum(s.wall_s for s in chosen)
    failed = sum(s.failed for s in chosen)
    print(f"{'total':<10} {'FAILED' if failed else 'ok':<8} {total_s:7.1f} s")
    left_out = [s.name for s in chosen if s.state == "not run"]
    rest = f"; not run: {', '.join(left_out)}" if left_out else ""
    print(f"{sum(s.passed for s in chosen)} passed, {failed} failed{rest}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
