#!/usr/bin/env python3
"""Tests and counts the runtime on emulated Cortex-M4 (mps2-an386) and Cortex-M7 (mps2-an500).

Usage: .ci/bench-target.py [--json | --check]

Builds the programs in firmware-sim/target-bench, runs them in qemu-system-arm with `-icount shift=6`, and prints a table
of instructions, code, weights, scratch memory and stack with the goal of each, people's table on stdout (--json: one
object on stdout). --check runs the tests of bit equality as well and prints one line `ok:` or `FAILED:` a test and a
budget, as `make test` reads it. Budgets are in tests/budgets.toml; a number more than 2 % above its budget fails.

Instructions are not cycles: no wait states, no caches, no dual issue. They are the same on every machine.

Exit 0 when all is well, 1 when a test or a budget failed, 4 when the emulator or the target is missing.
"""

import json
import os
import shutil
import struct
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CRATE = ROOT / "firmware-sim" / "target-bench"
TARGET = "thumbv7em-none-eabihf"
BOARDS = {"mps2-an386": "Cortex-M4", "mps2-an500": "Cortex-M7"}
TOLERANCE = 1.02
LIMIT_S = 300


def build():
    """Builds all programs and returns their folder."""
    folder = Path(os.environ.get("CARGO_TARGET_DIR", CRATE / "target"))
    folder = folder if folder.is_absolute() else ROOT / folder
    command = ["cargo", "build", "--quiet", "--release", "--locked", "--target", TARGET, "--target-dir", folder]
    if subprocess.run(command, cwd=CRATE, stdout=sys.stderr, check=False).returncode != 0:
        print(f"bench-target: the programs do not build; is the target there? rustup target add {TARGET}", file=sys.stderr)
        sys.exit(4)
    return folder / TARGET / "release"


def emulate(board, program):
    """Runs one program; returns its lines and whether it ended well."""
    command = ["qemu-system-arm", "-M", board, "-display", "none", "-monitor", "none", "-serial", "none"]
    command += ["-icount", "shift=6", "-semihosting-config", "enable=on,target=native", "-kernel", program]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired as late:
        text = late.stdout or b""
        return (text if isinstance(text, str) else text.decode(errors="replace")).splitlines(), False
    return done.stdout.splitlines(), done.returncode == 0


class Elf:
    """Sections and symbols of a 32-bit little-endian ELF file."""

    def __init__(self, path):
        data = path.read_bytes()
        assert data[:6] == b"\x7fELF\x01\x01", f"{path}: not a 32-bit little-endian ELF file"
        offset, count, names_at = (struct.unpack_from(f, data, at)[0] for f, at in (("<I", 32), ("<H", 48), ("<H", 50)))
        heads = [struct.unpack_from("<10I", data, offset + 40 * index) for index in range(count)]
        text = lambda table, at: data[heads[table][4] + at : data.index(b"\0", heads[table][4] + at)].decode()
        self.sections = {text(names_at, head[0]): head[5] for head in heads}
        self.symbols = {}
        for head in heads:
            if head[1] == 2:  # SHT_SYMTAB
                for at in range(head[4], head[4] + head[5], 16):
                    name, _, size, info = struct.unpack_from("<IIIB", data, at)
                    if info & 15 == 2:  # STT_FUNC
                        self.symbols[text(head[6], name)] = size


def sizes(folder):
    """Code of the kernels, of a step with the self-test, and of the whole runtime with either loader, in bytes."""
    with_runtime, loader, without = (Elf(folder / name) for name in ("footprint", "loader", "baseline"))
    trusting = Elf(folder / "footprint_trusted")
    flash = lambda elf: sum(elf.sections.get(name, 0) for name in (".text", ".rodata", ".data"))
    kernels = sum(size for name, size in with_runtime.symbols.items() if "kernels7armv7em" in name)
    return {
        "code.kernels": kernels,
        "code.step": flash(with_runtime) - flash(loader),
        "code.runtime": flash(with_runtime) - flash(without),
        "code.runtime_trusted": flash(trusting) - flash(without),
    }


def measure(folder):
    """All numbers: board -> key -> value. Counts of a step are checked to be the same for every observation."""
    boards, faults = {}, []
    for board in BOARDS:
        lines, well = emulate(board, folder / "count")
        values = {}
        for words in (line.split() for line in lines):
            # A reading of the counter is good to one instruction.
            if well and len(words) == 4 and int(words[2]) - int(words[1]) > 1:
                faults.append(f"{board}: {words[0]}: between {words[1]} and {words[2]} instructions, depending on the data")
            if len(words) in (2, 4) and words[1].isdigit():
                values[words[0]] = int(words[2] if len(words) == 4 else words[1])
                if len(words) == 4:
                    values[f"weights.{words[0]}"] = int(words[3])
        if not well:
            faults.append(f"{board}: the counting program failed: {lines[-1] if lines else 'no output'}")
        if {"act.q", "act.q_confidence"} <= values.keys():
            values["mask.confidence"] = values["act.q_confidence"] - values["act.q"]
        boards[board] = values
    for values in boards.values():
        values.update(sizes(folder))
    return boards, faults


def over_budget(boards, budgets):
    """One line for each budget: text and whether it is kept."""
    lines = []
    for key, budget in budgets.items():
        for board, values in boards.items():
            if key not in values:
                lines.append((f"{board}: {key} was not measured", False))
                continue
            value, limit = values[key], int(budget["budget"] * TOLERANCE)
            kept = value <= limit
            lines.append((f"{board}: {key} {value}, budget {budget['budget']}" + ("" if kept else f", more than {limit}"), kept))
            if key.startswith("code."):
                break  # the same program on both boards
    return lines


def table(boards, budgets):
    """The table for people."""
    first = boards[next(iter(boards))]
    rows = [("", "unit", *(f"{core} ({board})" for board, core in BOARDS.items()), "goal", "budget", "best peer")]
    for key, budget in budgets.items():
        number = lambda value: f"{value:,}" if isinstance(value, int) else str(value or "")
        measured = (number(boards[board].get(key)) for board in BOARDS)
        goal, peer = number(budget.get("goal")), number(budget.get("peer"))
        rows.append((budget["name"], budget["unit"], *measured, goal, number(budget["budget"]), peer))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for index, row in enumerate(rows):
        cells = [row[0].ljust(widths[0]), row[1].ljust(widths[1]), *(c.rjust(w) for c, w in zip(row[2:], widths[2:]))]
        print("  ".join(cells).rstrip())
        if index == 0:
            print("  ".join("-" * width for width in widths))
    step, macs = first.get("act.step"), 367_104
    if step:
        print(f"\nwhole step: {step / macs:.3f} instructions a multiply-accumulate ({macs:,} of them)")


def main(words):
    if words not in ([], ["--json"], ["--check"]):
        print(__doc__.strip(), file=sys.stderr)
        return 2
    if not shutil.which("qemu-system-arm"):
        print("bench-target: qemu-system-arm not found; install it (Debian: apt-get install qemu-system-arm)", file=sys.stderr)
        return 4
    budgets = tomllib.loads((ROOT / "tests" / "budgets.toml").read_text())["target"]
    folder = build()
    failed = False
    if words == ["--check"]:
        for board, core in BOARDS.items():
            lines, well = emulate(board, folder / "equality")
            for line in lines:
                print(line.replace(": ", f": {core}: ", 1) if line.startswith("ok: ") else line)
            if not well:
                print(f"FAILED: {core}: bit equality: {lines[-1] if lines else 'no output'}")
                failed = True
    boards, faults = measure(folder)
    lines = over_budget(boards, budgets)
    failed = failed or bool(faults) or not all(kept for _, kept in lines)
    if words == ["--json"]:
        print(json.dumps({"boards": boards, "budgets": budgets, "faults": faults + [text for text, kept in lines if not kept]}, indent=2))
        return failed
    if words == ["--check"]:
        if not faults:
            print("ok: the number of instructions of a step does not depend on the observation")
        for text, kept in lines:
            print(f"{'ok' if kept else 'FAILED'}: {text}")
        for fault in faults:
            print(f"FAILED: {fault}")
        return failed
    table(boards, budgets)
    for fault in faults + [f"over budget: {text}" for text, kept in lines if not kept]:
        print(f"bench-target: {fault}", file=sys.stderr)
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
