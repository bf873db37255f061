#!/usr/bin/env python3
"""A plant that nobody here wrote: Gymnasium steps it, python-can puts it on the bus, cantools knows the frames.

It drives a node (`gadm-sim node POLICY --connect BUS`) for episodes in lockstep and prints their returns as JSON.

Usage: plant.py --dbc FILE --start FILE [--interface slcan] --channel socket://127.0.0.1:PORT

--dbc is made by `gadm-sim dbc`, --start by `gadm-sim reset ENV`: the states that our own episodes start from. Nothing else
of this program comes from the project; what is on the wire, it takes from the database and from docs/src/can-protocol.md.
"""

import argparse
import json
import sys
import time
import zlib

import can
import cantools
import gymnasium
import mujoco
import numpy
from crccheck.crc import Crc8Autosar

START, BARRIER, REFUSED = 0x10, 0x11, 0xFF
PATIENCE_S = 20.0
HEARTBEAT_US = 100_000


class Bus:
    """A bus with the messages of a database."""

    def __init__(self, bus, database):
        self.bus, self.database = bus, database
        key = int(database.dbc.attributes["GadmInterfaceHash"].value, 16).to_bytes(8, "little")[:4]
        self.key = key
        self.frames = 0

    def send(self, name, values):
        """Sends a message; its check is computed here, over identifier, interface hash and payload."""
        message = self.database.get_message_by_name(name)
        full = {s.name: 0 for s in message.signals} | values
        data = bytearray(message.encode(full, strict=False))
        if any(s.name == "crc" for s in message.signals):
            key = message.frame_id.to_bytes(2, "little") + self.key
            if message.is_fd:
                data[-4:] = zlib.crc32(key + data[:-4]).to_bytes(4, "little")
            else:
                data[-1] = Crc8Autosar.calc(key + data[:-1])
        frame = can.Message(
            arbitration_id=message.frame_id,
            is_extended_id=False,
            is_fd=message.is_fd,
            bitrate_switch=message.is_fd,
            data=data,
        )
        self.bus.send(frame)
        self.frames += 1

    def receive(self, until):
        """The next message until that time: name and signals; `None` where none came. The check of a set is verified."""
        while True:
            frame = self.bus.recv(timeout=max(0.0, until - time.monotonic()))
            if frame is None:
                return None
            self.frames += 1
            try:
                message = self.database.get_message_by_frame_id(frame.arbitration_id)
            except KeyError:
                continue
            data = bytes(frame.data)
            signals = message.decode(data, decode_choices=False)
            if "crc" in signals:
                key = message.frame_id.to_bytes(2, "little") + self.key
                body = data[:-4] if message.is_fd else data[:-1]
                check = zlib.crc32(key + body) if message.is_fd else Crc8Autosar.calc(key + body)
                if check != signals["crc"]:
                    raise ValueError(f"{message.name} with a wrong check: {data.hex()}")
            return message.name, signals


class Node:
    """The node, as plant and host see it in lockstep."""

    def __init__(self, bus):
        self.bus = bus
        self.tag = 0
        self.action = {}
        self.flags = []
        self.state = None

    def request(self, op, repeat_s=PATIENCE_S):
        """Sends a request and handles everything until its reply; asks again after `repeat_s`."""
        self.tag = (self.tag + 1) % 0x10000
        give_up = time.monotonic() + PATIENCE_S
        while time.monotonic() < give_up:
            self.bus.send("REQUEST", {"op": op, "tag": self.tag})
            until = min(give_up, time.monotonic() + repeat_s)
            while (came := self.bus.receive(until)) is not None:
                name, signals = came
                if name == "REPLY" and signals["tag"] == self.tag:
                    if signals["op"] != op:
                        raise RuntimeError(f"the node refuses lockstep: {signals}")
                    return signals
                self.take(name, signals)
        raise TimeoutError(f"no reply for {PATIENCE_S:.0f} s; is the node on this bus, and with this policy?")

    def take(self, name, signals):
        if name == "ACT" or name.startswith("ACT_PART"):
            self.action.update(signals)
        elif name == "DECISION":
            self.flags.append(signals)
        elif name == "HEARTBEAT":
            self.state = signals["state"]

    def barrier(self):
        self.request(BARRIER)


class Plant:
    """One Gymnasium environment whose episodes start where ours do."""

    def __init__(self, start, database):
        known = {"hopper-v5": "Hopper-v5", "inverted-pendulum-v5": "InvertedPendulum-v5"}
        self.env = gymnasium.make(known[start["plant"]])
        self.episodes = start["episodes"]
        self.observations = self.slots(database, "OBS_")
        self.actions = self.slots(database, "ACT")

    @staticmethod
    def slots(database, prefix):
        """(message, signal) of every number of the observation or action, in the policy's order."""
        found = []
        for message in database.messages:
            for signal in message.signals:
                if message.name.startswith(prefix) and "GadmIndex" in signal.dbc.attributes:
                    found.append((signal.dbc.attributes["GadmIndex"].value, message.name, signal.name))
        return [slot[1:] for slot in sorted(found)]

    def reset(self, episode):
        self.env.reset()
        inner, state = self.env.unwrapped, numpy.array(self.episodes[episode]["state"])
        nq, nv = inner.model.nq, inner.model.nv
        mujoco.mj_resetData(inner.model, inner.data)
        inner.set_state(state[:nq], state[nq : nq + nv])
        inner.data.qacc_warmstart[:] = state[nq + nv : nq + 2 * nv]
        observation = inner._get_obs()
        ours = numpy.array(self.episodes[episode]["observation"])
        if not numpy.array_equal(observation.astype(numpy.float32), ours.astype(numpy.float32)):
            raise RuntimeError(f"the first observation is another one: {observation} instead of {ours}")
        return observation


def sets(slots, values):
    """The values of a set by message."""
    out = {}
    for (message, signal), value in zip(slots, values):
        out.setdefault(message, {})[signal] = float(value)
    return out


def drive(bus, plant, run):
    """One episode: TICK, OBS, barrier, action, step."""
    node, database = run["node"], bus.database
    period_us = database.dbc.attributes["GadmControlPeriodUs"].value
    names = {m.name for m in database.messages}
    seq_bits = database.get_message_by_name("OBS_0").get_signal_by_name("seq").length
    last = f"OBS_{sum(name.startswith('OBS_') for name in names) - 1}"
    observation, total, steps, done = plant.reset(run["episode"]), 0.0, 0, False
    safe = 0
    bus.send("MODE", {"command": 1, "node": database.dbc.attributes["GadmNode"].value})
    node.barrier()
    while not done:
        now_us = run["tick"] * period_us
        if run["beat_us"] is None or now_us - run["beat_us"] >= HEARTBEAT_US:
            bus.send("HOST_HEARTBEAT", {"seq": run["beats"] % 256})
            run["beats"] += 1
            run["beat_us"] = now_us
        bus.send("TICK", {"tick": run["tick"] % 2**32, "time_us": now_us % 2**32})
        seq = run["tick"] % 2**seq_bits
        for number, (name, values) in enumerate(sets(plant.observations, observation).items()):
            ends = {"part": number, "first": int(number == 0), "last": int(name == last)}
            bus.send(name, values | {"seq": seq} | (ends if database.get_message_by_name(name).is_fd else {}))
        node.action, node.flags = {}, []
        node.barrier()
        if node.action.get("seq") != seq:
            raise RuntimeError(f"no action set for tick {run['tick']}: {node.action}")
        said = node.flags[-1] if node.flags else node.action
        safe += int(said["safe"] or said["held"])
        action = numpy.array([node.action[signal] for _, signal in plant.actions])
        observation, reward, terminated, truncated, _ = plant.env.step(action)
        total += float(reward)
        steps += 1
        run["tick"] += 1
        done = terminated or truncated
    bus.send("MODE", {"command": 2, "node": database.dbc.attributes["GadmNode"].value})
    node.barrier()
    return {"return": total, "steps": steps, "terminated": bool(terminated), "safe_or_held": safe}


def main(words):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dbc", required=True, help="database made by `gadm-sim dbc`")
    parser.add_argument("--start", required=True, help="states made by `gadm-sim reset`")
    parser.add_argument("--interface", default="slcan", help="python-can's name of the interface [slcan]")
    parser.add_argument("--channel", required=True, help="socket://127.0.0.1:PORT, /dev/pts/N, vcan0")
    args = parser.parse_args(words)
    database = cantools.database.load_file(args.dbc)
    with open(args.start, encoding="utf-8") as file:
        start = json.load(file)
    more = {"sleep_after_open": 0} if args.interface == "slcan" else {"fd": True}
    with can.Bus(interface=args.interface, channel=args.channel, **more) as raw:
        bus = Bus(raw, database)
        node, plant = Node(bus), Plant(start, database)
        node.request(START, repeat_s=0.2)
        node.barrier()
        run = {"node": node, "tick": 0, "beats": 0, "beat_us": None, "episode": 0}
        episodes = []
        for run["episode"] in range(len(start["episodes"])):
            episodes.append(drive(bus, plant, run))
    print(json.dumps({"plant": start["plant"], "seed": start["seed"], "frames": bus.frames, "episodes": episodes}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
