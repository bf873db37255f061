"""`gadm paper FIG --submit hq` on a real HyperQueue server with two workers, one of which is killed in the middle of a run."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import unittest
from pathlib import Path

from programs import gadm_path

HERE = Path(__file__).resolve().parent
STEPS = 10_000
LIMIT_S = 240


def wait_for(what, condition, limit_s=LIMIT_S):
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        if found := condition():
            return found
        time.sleep(0.02)
    raise AssertionError(f"{what}: not within {limit_s} s")


@unittest.skipUnless(importlib.util.find_spec("hyperqueue"), "no Python package hyperqueue for this machine")
class Array(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        # The package's client, whether or not this machine has a program `hq`.
        python = Path(sys.executable).parent
        self.env = {**os.environ, "HQ_SERVER_DIR": str(self.folder / "hq"), "PATH": f"{python}:/usr/bin:/bin"}
        self.env.pop("RUST_LOG", None)

    def start(self, *words):
        command = [sys.executable, str(HERE / "hyperqueue_server.py"), *map(str, words)]
        log = open(self.folder / f"{'-'.join(Path(w).name for w in map(str, words))}.log", "w+")
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        self.addCleanup(log.close)
        self.addCleanup(process.wait)
        self.addCleanup(process.kill)

        def ready():
            text = Path(log.name).read_text()
            self.assertIsNone(process.poll(), text)
            return "ready" in text

        wait_for(f"HyperQueue {words}", ready, 30)
        return process

    def gadm(self, out, *words):
        command = [gadm_path(), "paper", *words, "--seeds", "1", "--steps", str(STEPS), "--out", str(self.folder / out)]
        done = subprocess.run(command, env=self.env, capture_output=True, text=True, timeout=LIMIT_S)
        self.assertEqual(done.returncode, 0, f"{command}\n{done.stderr}")
        return done.stdout

    def status(self, out):
        (figure,) = json.loads(self.gadm(out, "status", "demo", "--runs", "--json"))["figures"]
        return figure["runs"]

    def task_of(self, worker):
        """The process that is the worker's task now, and the run it trains."""
        children = Path(f"/proc/{worker.pid}/task").glob("*/children")
        for pid in " ".join(path.read_text() for path in children).split():
            words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
            if "run" in words and "demo" in words:
                return int(pid), int([word for word in words if word][-1])
        return None

    def test_a_killed_worker_loses_no_run(self):
        self.gadm("alone", "demo", "--jobs", "2", "-q")
        alone = self.status("alone")
        self.assertEqual([run["status"]["state"] for run in alone], ["done"] * 3)

        self.start("server", self.folder / "hq")
        workers = [self.start("worker", self.folder / name, self.folder / "hq") for name in ["first", "second"]]
        answer = json.loads(self.gadm("cluster", "demo", "--submit", "hq", "--json"))
        self.assertEqual((answer["submitted"], answer["indices"]), (True, [0, 1, 2]))

        def training():
            """A worker in the middle of a run: its evaluations have begun, and most of them are to come."""
            for worker in workers:
                if (task := self.task_of(worker)) is None:
                    continue
                metrics = Path(alone[task[1]]["folder"].replace("/alone/", "/cluster/")) / "metrics.jsonl"
                steps = [json.loads(line)["env_steps"] for line in metrics.read_text().splitlines()] if metrics.exists() else []
                if steps and 1_000 <= steps[-1] < STEPS - 4_000:
                    return worker, *task
            return None

        worker, pid, index = wait_for("a worker in the middle of a run", training)
        # As when its machine fails: worker and task are gone at once, without a word.
        worker.kill()
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        worker.wait()

        def done():
            runs = self.status("cluster")
            return runs if all(run["status"]["state"] == "done" and not run["status"]["running"] for run in runs) else None

        runs = wait_for("all runs done", done)
        for one, other in zip(alone, runs):
            read = lambda run: (Path(run["folder"]) / "metrics.jsonl").read_bytes()
            self.assertEqual(read(one), read(other), f"{one['run']} is another run on the cluster")
        # A session of training writes one file of TensorBoard events: the killed run has a second one, the others have not.
        events = [len(list(Path(run["folder"]).glob("events.*"))) for run in runs]
        self.assertEqual(events, [2 if i == index else 1 for i in range(3)], "continued once, and nothing done twice")

        # Nothing is left to submit, and the figure is that of the runs made here, commit and clock apart.
        again = [gadm_path(), "paper", "demo", "--seeds", "1", "--steps", str(STEPS), "--out", str(self.folder / "cluster"), "--submit", "hq"]
        refused = subprocess.run(again, env=self.env, capture_output=True, text=True, timeout=LIMIT_S)
        self.assertEqual(refused.returncode, 1)
        self.assertIn("every run is done", refused.stderr)
        self.gadm("cluster", "demo", "--draw")
        figures = [(self.folder / out / "demo.svg").read_bytes() for out in ["alone", "cluster"]]
        self.assertEqual(figures[0], figures[1])


if __name__ == "__main__":
    unittest.main()
