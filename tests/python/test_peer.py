"""python-can joins the hub: a Gymnasium plant drives our node for an episode, and its return is ours, bit for bit."""

import json
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import can

from programs import database, policy, sim, sim_path

HERE = Path(__file__).resolve().parent


class PlantOverTheHub(unittest.TestCase):
    def setUp(self):
        self.running = []
        self.folder = tempfile.TemporaryDirectory()
        self.addCleanup(self.folder.cleanup)

    def tearDown(self):
        for process in reversed(self.running):
            process.kill()
            process.communicate()

    def start(self, *words):
        process = subprocess.Popen(
            [sim_path(), *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        self.running.append(process)
        return process

    def episode(self, model, profile, seed):
        """Return and steps of one episode of the foreign plant, the trace of the hub, and the same run of ours."""
        folder = Path(self.folder.name)
        log = folder / "hub.log"
        hub = self.start("bus", "hub", "--tcp", "127.0.0.1:0", "--trace", log, "--json", "-q")
        (address,) = json.loads(hub.stdout.readline())["listens"]
        self.start("node", policy(model), "--connect", address, "--profile", profile, "-q")
        start = folder / "start.json"
        start.write_text(sim("reset", model, "--seed", seed), encoding="utf-8")
        words = ["--dbc", database(folder, model, profile), "--start", start]
        channel = "socket://" + address.removeprefix("tcp:")
        done = subprocess.run(
            [sys.executable, HERE / "plant.py", *words, "--channel", channel], capture_output=True, text=True, timeout=240
        )
        self.assertEqual(done.returncode, 0, done.stderr)
        (theirs,) = json.loads(done.stdout)["episodes"]
        result = sim("run", policy(model), "--episodes", 1, "--seed", seed, "--profile", profile, "--json", "-q")
        return theirs, json.loads(result)["episodes"][0], log

    def test_hopper_of_gymnasium_has_our_return(self):
        theirs, ours, _ = self.episode("hopper-v5", "fd-f32", 3)
        self.assertEqual((theirs["return"], theirs["steps"]), (ours["return"], ours["steps"]))
        self.assertEqual((theirs["terminated"], theirs["safe_or_held"]), (ours["terminated"], 0))

    def test_inverted_pendulum_of_gymnasium_has_our_return(self):
        theirs, ours, _ = self.episode("inverted-pendulum-v5", "fd-f32", 3)
        self.assertEqual((theirs["return"], theirs["steps"]), (ours["return"], ours["steps"]))


class LogsOfOthers(unittest.TestCase):
    """Our trace through python-can's reader and writer, and through us again."""

    def test_what_python_can_writes_replays_to_the_same_actions(self):
        with tempfile.TemporaryDirectory() as folder:
            for profile in ("fd-f32", "classic-i16"):
                ours, theirs = Path(folder) / "ours.log", Path(folder) / "theirs.log"
                words = ["--episodes", 1, "--seed", 5, "--profile", profile, "--trace", ours, "-q"]
                sim("run", policy("inverted-pendulum-v5"), *words)
                with can.CanutilsLogReader(str(ours)) as reader, can.CanutilsLogWriter(str(theirs)) as writer:
                    for message in reader:
                        writer.on_message_received(message)
                self.assertNotEqual(ours.read_text(), theirs.read_text(), "python-can adds the direction")
                for log in (ours, theirs):
                    replay = json.loads(sim("replay", log, "--policy", policy("inverted-pendulum-v5"), "--json"))
                    self.assertTrue(replay["same"], replay)
                    self.assertEqual(replay["compared"], replay["ticks"] + 1)


if __name__ == "__main__":
    unittest.main()
