"""A run as MCAP, read by the `mcap` package of its authors: every signal is what our decoder says of the trace."""

import json
import tempfile
import unittest
from pathlib import Path

from mcap.reader import make_reader

from programs import MODELS, PROFILES, decoded, policy, sim

TOPICS = {"OBS": "/observation", "TICK": "/tick", "HEARTBEAT": "/heartbeat"}


class RunAsMcap(unittest.TestCase):
    def check_model(self, folder, model, profile):
        log, file = Path(folder) / f"{model}-{profile}.log", Path(folder) / f"{model}-{profile}.mcap"
        words = ["--episodes", 1, "--seed", 3, "--profile", profile, "--trace", log, "--mcap", file, "-q"]
        sim("run", policy(model), *words)
        by_topic = {}
        with open(file, "rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            for schema, channel, message in reader.iter_messages():
                self.assertEqual((schema.encoding, channel.message_encoding), ("jsonschema", "json"))
                value = json.loads(message.data)
                known = json.loads(schema.data)["properties"]
                self.assertLessEqual(value.keys(), known.keys(), channel.topic)
                by_topic.setdefault(channel.topic, []).append((message.log_time, value))
        counted = {summary.channels[c].topic: n for c, n in summary.statistics.channel_message_counts.items()}
        self.assertEqual({t: len(m) for t, m in by_topic.items()}, {t: n for t, n in counted.items() if n})
        for name, topic in TOPICS.items():
            ours = [line for line in decoded(log, model) if line["name"] == name]
            found = by_topic[topic]
            self.assertGreater(len(ours), 0)
            self.assertEqual([time for time, _ in found], [1000 * line["time_us"] for line in ours], topic)
            for (_, value), line in zip(found, ours):
                self.assertEqual({k: value.get(k) for k in line["signals"]}, line["signals"], topic)

    def test_every_message_is_there_with_its_time_and_values(self):
        with tempfile.TemporaryDirectory() as folder:
            for model in MODELS:
                for profile in PROFILES:
                    with self.subTest(model=model, profile=profile):
                        self.check_model(folder, model, profile)


if __name__ == "__main__":
    unittest.main()
