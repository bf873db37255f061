#!/usr/bin/env python3
"""A python-can program that joins an emulated board, reads its status and is the plant of one episode of Moving.

Usage: target/python/bin/python tests/python/board.py [FIRMWARE.elf [POLICY.bin]]

Starts `qemu-system-arm -M mps2-an386` with its UART as a TCP socket and the policy flashed, and talks SLCAN to it as to any
adapter. Everything it knows of the node is in docs/src/can-protocol.md. Prints one line `ok:` or `FAILED:` for each thing
that must hold.
"""

import math
import random
import socket
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import can

ROOT = Path(__file__).resolve().parent.parent.parent
SLOT = 0x00200000
READY, RUN = 3, 4
EPISODES = 3
WAIT_S = 30.0


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def emulate(firmware, policy, port):
    command = ["qemu-system-arm", "-M", "mps2-an386", "-display", "none", "-monitor", "none", "-kernel", firmware]
    command += ["-device", f"loader,file={policy},addr={SLOT:#x},force-raw=on"]
    command += ["-serial", f"tcp:127.0.0.1:{port},server=on,wait=on,nodelay=on"]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def join(port):
    """The bus; the emulator may take a moment to listen."""
    end = time.monotonic() + WAIT_S
    while True:
        try:
            return can.Bus(
                interface="slcan", channel=f"socket://127.0.0.1:{port}", bitrate=500_000, sleep_after_open=0
            )
        except (can.CanError, OSError):
            if time.monotonic() > end:
                raise
            time.sleep(0.1)


class Node:
    """Node 1 as a peer sees it."""

    def __init__(self, bus):
        self.bus = bus
        self.tag = 0
        self.interface = b""

    def send(self, identifier, data, fd=False):
        self.bus.send(
            can.Message(arbitration_id=identifier, data=data, is_extended_id=False, is_fd=fd, bitrate_switch=fd)
        )

    def wait(self, identifier, fits):
        end = time.monotonic() + WAIT_S
        while time.monotonic() < end:
            message = self.bus.recv(timeout=1.0)
            if message is not None and message.arbitration_id == identifier and fits(message.data):
                return bytes(message.data)
        raise TimeoutError(f"no frame {identifier:#05x} that fits within {WAIT_S} s")

    def page(self, page):
        """Reads one number by REQUEST and REPLY."""
        self.tag += 1
        self.send(0x601, struct.pack("<BBH", 1, page, self.tag))
        reply = self.wait(0x581, lambda data: struct.unpack_from("<H", data, 2)[0] == self.tag)
        return struct.unpack_from("<I", reply, 4)[0]

    def seal(self, identifier, body):
        """Zero padding to a length of CAN FD, and the CRC over identifier, interface hash and payload."""
        length = next(n for n in (8, 12, 16, 20, 24, 32, 48, 64) if n >= len(body) + 4)
        body = body.ljust(length - 4, b"\0")
        return body + struct.pack("<I", zlib.crc32(struct.pack("<H", identifier) + self.interface + body))

    def step(self, tick, observation):
        """One control period: TICK, the observation, and the action that answers it."""
        self.send(0x080, struct.pack("<II", tick, tick * 5000))
        body = struct.pack("<HBB", tick & 0xFFFF, 0, 0b11) + struct.pack("<10f", *observation)
        self.send(0x180, self.seal(0x180, body), fd=True)
        act = self.wait(0x101, lambda data: struct.unpack_from("<H", data)[0] == tick & 0xFFFF)
        if self.seal(0x101, act[:-4]) != act:
            raise ValueError("the CRC of an action frame is wrong")
        flags = act[3] >> 3
        return flags, struct.unpack_from("<3f", act, 4)


class Moving:
    """The plant: accelerate, turn or brake, and stop in the target."""

    def __init__(self, seed):
        rng = random.Random(seed)
        self.target = rng.uniform(-0.9, 0.9), rng.uniform(-0.9, 0.9)
        self.x, self.y, self.theta = rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(0, math.tau)
        self.speed, self.taken = 0.0, 0

    def distance(self):
        return math.hypot(self.x - self.target[0], self.y - self.target[1])

    def observe(self):
        inside = float(self.distance() <= 0.1)
        heading = math.cos(self.theta), math.sin(self.theta)
        return [self.x, self.y, self.speed, *heading, *self.target, self.distance(), inside, self.taken / 200]

    def step(self, action):
        """True at the goal, False out of the field or out of time, None while it goes on."""
        kind, acceleration, turn = action
        self.taken += 1
        if kind == 0:
            self.speed += 0.5 * acceleration
        elif kind == 1:
            self.theta = (self.theta + math.pi / 2 * turn) % math.tau
        else:
            self.speed = max(0.0, self.speed - 0.1)
        self.x += 0.005 * self.speed * math.cos(self.theta)
        self.y += 0.005 * self.speed * math.sin(self.theta)
        if self.distance() < 0.1 and self.speed == 0.0:
            return True
        return False if max(abs(self.x), abs(self.y)) > 1 or self.taken > 200 else None


def check(ok, what):
    print(f"{'ok' if ok else 'FAILED'}: python-can on the emulated board: {what}", flush=True)
    return ok


def main(words):
    firmware = words[0] if words else ROOT / "target/firmware/mps2-an386.elf"
    policy = words[1] if len(words) > 1 else ROOT / "models/moving/policy.bin"
    port = free_port()
    board = emulate(firmware, policy, port)
    try:
        bus = join(port)
        node = Node(bus)
        good = check(bus.get_version(10.0)[0] is not None, "the adapter tells its version")
        state, _, fault = node.wait(0x701, lambda data: data[0] == READY)[:3]
        good &= check((state, fault) == (READY, 0), "the status frame says READY without a fault")
        node.interface = struct.pack("<I", node.page(0))
        stored = struct.unpack_from("<I", Path(policy).read_bytes(), 24)[0]
        good &= check(node.page(0) == stored, "the interface hash is that of the policy file")
        node.send(0x000, [1, 1])
        good &= check(node.wait(0x701, lambda data: data[0] == RUN)[2] == 0, "RUN starts control")
        tick, steps, goals, flagged = 0, 0, 0, 0
        for seed in range(EPISODES):
            plant, end = Moving(seed), None
            while end is None:
                tick += 1
                flags, action = node.step(tick, plant.observe())
                flagged += flags & 0b1001 != 0  # safe or held
                end = plant.step(action)
            goals, steps = goals + end, steps + plant.taken
        good &= check(goals == EPISODES, f"{goals} of {EPISODES} episodes of Moving end in the goal, {steps} steps")
        good &= check(flagged == 0, "no action was held or safe")
        node.send(0x000, [2, 1])
        good &= check(node.wait(0x701, lambda data: data[0] == READY)[2] == 0, "STOP ends control")
        bus.shutdown()
        return 0 if good else 1
    except (TimeoutError, ValueError, OSError, can.CanError) as error:
        check(False, str(error))
        return 1
    finally:
        board.kill()
        board.wait()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
