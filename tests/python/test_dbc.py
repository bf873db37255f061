"""The database of a policy, read by cantools: every signal of every frame is what our own decoder says."""

import random
import struct
import tempfile
import unittest
import zlib

import can
import cantools
from crccheck.crc import Crc8Autosar

from programs import MODELS, PROFILES, database, decoded, policy, sim, trace

FLAGS = ["safe", "fallback", "clipped", "held", "late"]
NO_LATENT = 2047


def f32(value):
    return struct.unpack("<f", struct.pack("<f", value))[0]


def names(message):
    """Our name of every observation and action in a message of the database."""
    attributes = {s.name: s.dbc.attributes.get("GadmName") for s in message.signals}
    return {name: attribute.value for name, attribute in attributes.items() if attribute is not None}


def expected(line, message):
    """What our decoder said of a frame, by the names of the database, numbers only."""
    signals, out = dict(line["signals"]), dict(line["framing"])
    flags = signals.pop("flags", None)
    if flags is not None:
        out.update({flag: int(flag in flags) for flag in FLAGS})
    if "latent" in signals:
        latent = signals.pop("latent")
        out["latent"] = NO_LATENT if latent is None else latent
    if line["name"] == "TRANSFER":
        signals.pop("bytes")  # the length of the frame
    if line["name"] == "HEARTBEAT":
        value, page = signals.pop("value"), signals["page"]
        if page in {s.name for s in message.signals}:
            out[page] = value  # the page is one number; others are told in parts
    ours = {original: name for name, original in names(message).items()}
    out.update({ours.get(key, key): value for key, value in signals.items()})
    choices = {s.name: {str(name): number for number, name in (s.choices or {}).items()} for s in message.signals}
    # A name stands for its number; a number without a name is printed as such.
    return {k: choices[k].get(v, int(v) if v.isdigit() else v) if isinstance(v, str) else v for k, v in out.items()}


class Comparison(unittest.TestCase):
    def same(self, db, path, model):
        """Compares all frames of a trace; returns how many signals of which messages were compared."""
        with can.CanutilsLogReader(str(path)) as reader:
            frames = list(reader)
        lines = decoded(path, model)
        self.assertEqual(len(frames), len(lines))
        counts = {}
        for frame, line in zip(frames, lines):
            self.assertEqual(frame.arbitration_id, line["id"])
            self.assertIsNone(line["error"], line)
            message = db.get_message_by_frame_id(frame.arbitration_id)
            self.assertEqual((message.is_fd, message.length), (frame.is_fd, len(frame.data)), message.name)
            theirs = message.decode(frame.data, decode_choices=False)
            raw = message.decode(frame.data, decode_choices=False, scaling=False)
            ours = expected(line, message)
            self.assertEqual(set(theirs), set(ours), message.name)
            for name, value in ours.items():
                self.equal(message, message.get_signal_by_name(name), value, theirs[name], raw[name])
            counts[message.name] = counts.get(message.name, 0) + len(ours)
        return counts

    def equal(self, message, signal, ours, theirs, raw):
        where = f"{message.name}.{signal.name}: ours {ours}, cantools {theirs}, raw {raw}"
        if ours is None:
            # Not a number in fd-f32, the reserved number in classic-i16.
            self.assertTrue(raw != raw or raw == -32768, where)
        elif signal.is_float:
            self.assertEqual(f32(ours), theirs, where)
        elif signal.scale != 1 or signal.offset != 0:
            # cantools scales in double precision, we in single: equal up to its rounding, and the same raw number.
            span = signal.maximum - signal.minimum
            self.assertLessEqual(abs(ours - theirs), 1e-6 * max(span, abs(signal.offset)), where)
            self.assertEqual(round((ours - signal.offset) / signal.scale), raw, where)
        else:
            self.assertEqual(ours, theirs, where)


class TraceOfARun(Comparison):
    def test_every_signal_is_what_our_decoder_says(self):
        for model in MODELS:
            for profile in PROFILES:
                with self.subTest(model=model, profile=profile), tempfile.TemporaryDirectory() as folder:
                    db = cantools.database.load_file(str(database(folder, model, profile)))
                    path, result = trace(folder, model, profile)
                    counts = self.same(db, path, model)
                    self.assertEqual(counts["TICK"], 2 * result["steps"])
                    for name in ["OBS_0", "ACT", "HEARTBEAT", "HOST_HEARTBEAT", "MODE"]:
                        self.assertGreater(counts[name], 0, name)


class FramesMadeByCantools(Comparison):
    """The other way: cantools writes frames by the database, our decoder reads what was meant."""

    def frame(self, db, message, rng):
        values = {}
        pages = [s.choices for s in message.signals if s.is_multiplexer]
        page = rng.choice(sorted(pages[0])) if pages else None
        for signal in message.signals:
            if signal.multiplexer_ids and page not in signal.multiplexer_ids:
                continue
            if signal.is_multiplexer:
                values[signal.name] = page
            elif signal.name == "crc":
                values[signal.name] = 0
            elif signal.is_float:
                values[signal.name] = f32(rng.uniform(-1e3, 1e3))
            elif signal.name == "part":
                values[signal.name] = int(message.name.removeprefix("OBS_"))
            elif signal.name in ("first", "last"):
                last = f"OBS_{int(message.name.removeprefix('OBS_')) + 1}" not in self.names
                values[signal.name] = int(message.name == "OBS_0" if signal.name == "first" else last)
            elif signal.choices and signal.name in ("command", "state", "fault", "page", "op", "reason", "slot0_state", "slot1_state"):
                values[signal.name] = rng.choice(sorted(signal.choices))
            else:
                low, high = signal.minimum, signal.maximum
                values[signal.name] = rng.uniform(low, high) if signal.scale != 1 else rng.randint(int(low), int(high))
        data = bytearray(message.encode(values, strict=False))
        if "crc" in values:
            words = db.dbc.attributes["GadmInterfaceHash"].value
            key = message.frame_id.to_bytes(2, "little") + int(words, 16).to_bytes(8, "little")[:4]
            if message.is_fd:
                data[-4:] = zlib.crc32(key + data[:-4]).to_bytes(4, "little")
            else:
                data[-1] = Crc8Autosar.calc(key + data[:-1])
        return can.Message(
            arbitration_id=message.frame_id,
            is_extended_id=False,
            is_fd=message.is_fd,
            bitrate_switch=message.is_fd,
            data=data,
            channel="vcan0",
            timestamp=1.5,
        )

    def test_our_decoder_reads_what_cantools_wrote(self):
        rng = random.Random(1)
        for model in MODELS:
            for profile in PROFILES:
                with self.subTest(model=model, profile=profile), tempfile.TemporaryDirectory() as folder:
                    db = cantools.database.load_file(str(database(folder, model, profile, node=9)))
                    self.names = {m.name for m in db.messages}
                    path = f"{folder}/made.log"
                    with can.CanutilsLogWriter(path) as log:
                        for _ in range(40):
                            for message in db.messages:
                                log.on_message_received(self.frame(db, message, rng))
                    counts = self.same(db, path, model)
                    self.assertEqual(set(counts), self.names, "every message of the database was compared")


class WhatTheDatabaseSays(unittest.TestCase):
    def load(self, folder, model, profile):
        return cantools.database.load_file(str(database(folder, model, profile)))

    def test_attributes_enumerations_and_cycle_times(self):
        with tempfile.TemporaryDirectory() as folder:
            db = self.load(folder, "hopper-v5", "fd-f32")
            attributes = {name: a.value for name, a in db.dbc.attributes.items()}
            self.assertEqual(attributes["BusType"], "CAN FD")
            self.assertEqual(attributes["GadmInterfaceHash"], "c404cb44087845eb")
            self.assertEqual(attributes["GadmControlPeriodUs"], 8000)
            act, observation = db.get_message_by_name("ACT"), db.get_message_by_name("OBS_0")
            self.assertEqual((act.frame_id, act.cycle_time, act.is_fd), (0x101, 8, True))
            self.assertEqual(db.get_message_by_name("HEARTBEAT").cycle_time, 100)
            self.assertEqual(observation.senders, ["PLANT"])
            self.assertEqual(sorted(db.get_message_by_name("ESTOP").senders), ["HOST", "NODE", "PLANT"])
            height = observation.get_signal_by_name("torso_height")
            self.assertEqual((height.unit, height.minimum, height.maximum, height.is_float), ("m", 0, 2, True))
            self.assertEqual(act.get_signal_by_name("thigh").dbc.attributes["GadmSafeValue"].value, 0)
            self.assertEqual(str(act.get_signal_by_name("latent").choices[NO_LATENT]), "none")
            states = {str(v) for v in db.get_message_by_name("HEARTBEAT").get_signal_by_name("state").choices.values()}
            self.assertLessEqual({"BOOT", "SELFTEST", "NO_POLICY", "READY", "RUN", "SAFE", "FAULT"}, states)
            faults = db.get_message_by_name("HEARTBEAT").get_signal_by_name("fault").choices
            self.assertEqual(str(faults[11]), "ESTOP")

    def test_scales_of_the_classic_profile(self):
        with tempfile.TemporaryDirectory() as folder:
            db = self.load(folder, "hopper-v5", "classic-i16")
            self.assertEqual(db.dbc.attributes["BusType"].value, "CAN")
            self.assertFalse(any(m.is_fd for m in db.messages))
            angle = db.get_message_by_name("OBS_0").get_signal_by_name("thigh_angle")
            self.assertAlmostEqual(angle.offset, -1.25, places=6)
            self.assertAlmostEqual(angle.scale * 32767, 1.45, places=6)
            self.assertEqual(str(angle.choices[-32768]), "invalid")

    def test_the_same_policy_gives_the_same_file(self):
        with tempfile.TemporaryDirectory() as folder:
            text = database(folder, "moving", "fd-f32").read_text(encoding="ascii")
            self.assertEqual(text, sim("dbc", policy("moving")))


if __name__ == "__main__":
    unittest.main()
