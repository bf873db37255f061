#!/usr/bin/env python3
"""Compares this program's speed with PyTorch, gymnasium and envpool: both in turn.

Every row of the table is measured in rounds: ours, peer, ours, peer, ... A round gives one ratio; printed are the median of
the ratios and their span. The column "processor" compares processor time instead of wall-clock time, which other programs
on the machine disturb less; it says nothing about two threads. Run by `make bench-peers`, which installs the peers first.

Not part of `make test`. Exit code 0 when everything ran, 3 where a goal was missed, 1 where something did not run.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent

# Row, our arguments, peer server and case, threads ours and peer, goal (ratio), stretch.
TRAIN = [
    ("DQN update 11-256-256-128-64, batch 512", "dqn", {1: (1.35, 1.45), 2: (1.7, 1.95)}),
    ("same, dueling, 20 heads, masks", "dqn-dueling", {1: (1.3, None), 2: (1.6, None)}),
    ("action-model update, batch 512", "action-model", {1: (1.35, 1.5), 2: (1.5, 1.9)}),
    ("confidence update, batch 512", "confidence", {1: (1.3, None), 2: (1.5, None)}),
    ("small DQN update 64-64, batch 100", "dqn-small", {1: (8.0, None)}),
    ("small TD3 update 64-64, batch 100", "td3-small", {1: (8.0, None)}),
    ("TD3 update 256-256, batch 256", "td3", {1: (2.0, None), 2: (2.0, None)}),
    ("Algorithm 1 on Hopper, rounds", "round", {1: (1.8, 2.0), 2: (1.8, 2.0)}),
]
ENVS = [
    # label, our environments and threads, peer case, peer threads, goal
    ("Hopper stepping / gymnasium", (1, 1), "gymnasium", 1, 2.3),
    ("Hopper stepping, 2 threads / gymnasium, 1 process", (16, 2), "gymnasium", 1, 4.5),
    ("Hopper stepping, 2 threads, 16 envs / envpool, same", (16, 2), "envpool-16", 2, 1.4),
]
MEMORY_GOALS = {"hopper-v5": 140e6, "humanoid-v4": 1.7e9}
BUSY = "import time\nend = time.time() + {}\nwhile time.time() < end: sum(range(10000))"


class Server:
    """A peer that stays, so that its start counts for nothing."""

    def __init__(self, *command):
        env = {**os.environ, "PYTHONWARNINGS": "ignore", "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            command, cwd=HERE, env=env, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def measure(self, case, threads, seconds):
        self.process.stdin.write(json.dumps({"case": case, "threads": threads, "seconds": seconds}) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError("the peer ended; its error is above")
        answer = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer

    def close(self):
        self.process.stdin.close()
        self.process.wait()


def gadm(program, *words):
    out = subprocess.run([program, "bench", *map(str, words), "--json"], capture_output=True, text=True)
    if out.returncode:
        raise RuntimeError(out.stderr.strip())
    return json.loads(out.stdout)


def ours(program, case, threads, seconds):
    words = ("train", "--case", case, "--threads", threads, "--seconds", seconds)
    return gadm(program, *words)["timings"][0]


def ours_env(program, envs, threads, seconds):
    return gadm(program, "env", "--envs", envs, "--threads", threads, "--seconds", seconds)["timings"][0]


def build_rltools(args):
    """The program of rltools.cpp, with RLtools from the user's checkout; ends where that cannot be built."""
    checkout, program = Path(args.rltools).resolve(), Path(args.gadm).resolve().parent / "rltools-td3"
    if not (checkout / "include/rl_tools").is_dir():
        sys.exit(f"--rltools {checkout}: expected a checkout of RLtools, found no include/rl_tools in it")
    flags = "-std=c++17 -O3 -ffast-math -march=native -DRL_TOOLS_BACKEND_ENABLE_OPENBLAS -DRL_TOOLS_DISABLE_HDF5".split()
    command = ["g++", *flags, "-I", checkout / "include", HERE / "rltools.cpp", "-o", program, *args.rltools_link.split()]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError as error:
        sys.exit(f"RLtools: {error}; a C++ compiler is needed (Debian: apt-get install g++ libopenblas-dev)")
    if done.returncode:
        wrong = [line for line in done.stderr.splitlines() if "error" in line] or done.stderr.splitlines()[-1:]
        sys.exit(f"RLtools cannot be built: {wrong[0]} (it needs OpenBLAS; Debian: apt-get install libopenblas-dev)")
    return program


class Row:
    def __init__(self, label, threads, goal, stretch, mine, peer):
        self.label, self.threads, self.goal, self.stretch = label, threads, goal, stretch
        self.measure_mine, self.measure_peer = mine, peer
        self.mine, self.peer, self.error = [], [], None

    def round(self):
        if self.error:
            return
        try:
            a, b = self.measure_mine(), self.measure_peer()
        except (RuntimeError, OSError, subprocess.SubprocessError) as error:
            self.error = str(error).splitlines()[-1] if str(error) else type(error).__name__
            return
        self.mine.append(a)
        self.peer.append(b)

    def ratios(self, key="rates"):
        pairs = [(a.get(key), b.get(key)) for a, b in zip(self.mine, self.peer)]
        return [statistics.median(a) / statistics.median(b) for a, b in pairs if a and b]

    def cells(self):
        if self.error or not self.mine:
            return [self.label, self.threads, "-", "-", f"not run: {self.error}", "-", "-", "-", "-"]
        ratios, cpu = self.ratios(), self.ratios("cpu_rates") if self.threads == "1" else []
        rate = lambda runs: statistics.median(statistics.median(r["rates"]) for r in runs)
        flop = self.mine[0].get("flop", 0)
        median = statistics.median(ratios)
        goal = f"{self.goal:g}" + (f" ({self.stretch:g})" if self.stretch else "")
        verdict = "met" if median >= self.goal else "missed"
        if self.stretch and median >= self.stretch:
            verdict = "stretch met"
        return [
            self.label,
            self.threads,
            f"{rate(self.mine):.4g}",
            f"{rate(self.peer):.4g}",
            f"{median:.2f} ({min(ratios):.2f}-{max(ratios):.2f})",
            f"{statistics.median(cpu):.2f}" if cpu else "-",
            f"{rate(self.mine) * flop / 1e9:.0f}" if flop else "-",
            goal,
            verdict,
        ]

    def missed(self):
        return bool(self.mine) and not self.error and statistics.median(self.ratios()) < self.goal


def busy_row(program, server, rounds, seconds):
    """Two-thread mode beside a program that keeps one core busy, over one thread on the quiet machine."""
    quiet, loaded, peer = [], [], []
    for _ in range(rounds):
        quiet.append(ours(program, "dqn", 1, seconds))
        peer_quiet = server.measure("dqn", 1, seconds) if server else None
        hog = subprocess.Popen([sys.executable, "-c", BUSY.format(2.5 * seconds + 10)])
        try:
            loaded.append(ours(program, "dqn", 2, seconds))
            if server:
                peer.append((peer_quiet, server.measure("dqn", 2, seconds)))
        finally:
            hog.terminate()
            hog.wait()
    rate = lambda t: statistics.median(t["rates"])
    mine = [rate(b) / rate(a) for a, b in zip(quiet, loaded)]
    theirs = [rate(b) / rate(a) for a, b in peer]
    return mine, theirs


def load():
    try:
        return os.getloadavg()[0]
    except OSError:
        return float("nan")


def table(head, rows):
    print("| " + " | ".join(head) + " |")
    print("|" + " --- |" * len(head))
    for row in rows:
        print("| " + " | ".join(str(c) for c in row) + " |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gadm", default="target/release/gadm", help="our program (default: %(default)s)")
    parser.add_argument("--python", default=sys.executable, help="Python that has the peers (default: this one)")
    parser.add_argument("--rounds", type=int, default=5, help="rounds per row (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=1.0, help="seconds per measurement (default: %(default)s)")
    parser.add_argument("--only", action="append", help="only rows whose label contains this text; may be repeated")
    parser.add_argument("--json", metavar="FILE", help="write every measured rate to this file")
    parser.add_argument("--rltools", metavar="DIR", help="a checkout of RLtools, to be built and compared too")
    parser.add_argument("--rltools-link", metavar="FLAGS", default="-lopenblas",
                        help="compiler flags that find OpenBLAS for it (default: %(default)s)")
    args = parser.parse_args()
    begin, start_load = time.time(), load()

    updates, envs = Server(args.python, "updates.py"), Server(args.python, "environments.py")
    rltools = Server(build_rltools(args)) if args.rltools else None
    rows = []
    for label, case, goals in TRAIN:
        for threads, (goal, stretch) in goals.items():
            seconds = 2 * args.seconds if case == "round" else args.seconds
            mine = lambda case=case, threads=threads, s=seconds: ours(args.gadm, case, threads, s)
            peer = lambda case=case, threads=threads, s=seconds: updates.measure(case, threads, s)
            rows.append(Row(label, str(threads), goal, stretch, mine, peer))
    for label, (count, threads), case, peer_threads, goal in ENVS:
        mine = lambda count=count, threads=threads: ours_env(args.gadm, count, threads, args.seconds)
        peer = lambda case=case, t=peer_threads: envs.measure(case, t, args.seconds)
        rows.append(Row(label, str(threads), goal, None, mine, peer))
    if rltools:
        mine = lambda: ours(args.gadm, "td3-loop", 1, args.seconds)
        peer = lambda: rltools.measure("td3", 1, args.seconds)
        rows.append(Row("TD3 on Pendulum, whole steps, 64-64 / RLtools with OpenBLAS", "1", 1.0, 1.3, mine, peer))
    wanted = lambda label: not args.only or any(text in label for text in args.only)
    rows = [row for row in rows if wanted(row.label)]
    for _ in range(args.rounds):
        for row in rows:
            row.round()

    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores; load {start_load:.1f} at the start, "
          f"{args.rounds} rounds of {args.seconds:g} s; updates or steps per second, medians\n")
    head = ["work", "threads", "ours", "peer", "ratio (span)", "processor", "GFLOP/s", "goal (stretch)", ""]
    table(head, [row.cells() for row in rows])
    failed, missed = any(row.error for row in rows), any(row.missed() for row in rows)
    report = {row.label + f", {row.threads}": {"ours": row.mine, "peer": row.peer, "error": row.error} for row in rows}

    if wanted("one core busy"):
        mine, theirs = busy_row(args.gadm, updates, max(2, args.rounds // 2), args.seconds)
        median = statistics.median(mine)
        verdict = "met" if median >= 0.5 else "missed"
        missed |= median < 0.5
        print(f"\nOne core busy: two threads keep {median:.2f} of the quiet one-thread speed "
              f"({min(mine):.2f}-{max(mine):.2f}; goal 0.5, stretch 0.7: {verdict}); PyTorch {statistics.median(theirs):.2f}")
        report["one core busy"] = {"ours": mine, "peer": theirs}
    if wanted("memory"):
        replay = [gadm(args.gadm, "replay", "--case", case, "--seconds", 0.2)["replays"][0] for case in MEMORY_GOALS]
        report["memory"] = replay
        for entry in replay:
            goal, used = MEMORY_GOALS[entry["name"]], max(entry["own_bytes"], entry["resident_bytes"] or 0)
            verdict = "met" if used <= goal else "missed"
            missed |= used > goal
            print(f"Replay of {entry['transitions']} transitions, {entry['name']}: {used / 1e6:.0f} MB "
                  f"(goal {goal / 1e6:.0f}: {verdict})")
    if wanted("sgemm"):
        for threads in (1, 2):
            mine = ours(args.gadm, "sgemm", threads, args.seconds)
            gflops = statistics.median(mine["rates"]) * mine["flop"] / 1e9
            line = f"Peak of 512 x 256 x 256 products, {threads} thread(s): ours {gflops:.0f} GFLOP/s"
            theirs = updates.measure("sgemm", threads, args.seconds)
            print(f"{line}, PyTorch {statistics.median(theirs['rates']) * mine['flop'] / 1e9:.0f}")
    if not rltools:
        print("RLtools: not compared: name a checkout of it with --rltools DIR (github.com/rl-tools/rl-tools)")
    print(f"\n{time.time() - begin:.0f} s")
    for server in filter(None, (updates, envs, rltools)):
        server.close()
    if args.json:
        Path(args.json).write_text(json.dumps(report))
    sys.exit(1 if failed else 3 if missed else 0)


if __name__ == "__main__":
    main()
