#!/usr/bin/env python3
"""Records Gymnasium's LunarLander-v3 (discrete) in the format of envs/README.md.

Usage: record-lunar-lander.py OUT.json.gz      needs gymnasium==1.4.0, box2d==2.3.10,
                                                numpy==2.4.6, pygame-ce==2.5.8

The continuous one shares the physics, so this recording checks the four actions and the play-back of the draws.
"""

import gzip
import json
import platform
import sys
from importlib.metadata import version

import gymnasium
import numpy
from gymnasium.envs.box2d.lunar_lander import heuristic

COLUMNS = ["x", "y", "angle", "vx", "vy", "omega", "center_x", "center_y", "awake"]
SEED = 12200


class Draws:
    """The environment's generator, which writes its uniform draws down."""

    def __init__(self, generator):
        self.generator, self.all = generator, []

    def uniform(self, low, high, size=None):
        values = self.generator.uniform(low, high, size)
        self.all.extend(numpy.atleast_1d(values).tolist())
        return values

    def take(self):
        taken, self.all = self.all, []
        return taken


def body(b):
    numbers = [b.position.x, b.position.y, b.angle, b.linearVelocity.x, b.linearVelocity.y, b.angularVelocity]
    return [float(n) for n in [*numbers, b.worldCenter.x, b.worldCenter.y, b.awake]]


def state(env):
    return {
        "lander": body(env.lander),
        "leg0": body(env.legs[0]),
        "leg1": body(env.legs[1]),
        "contact0": bool(env.legs[0].ground_contact),
        "contact1": bool(env.legs[1].ground_contact),
        "prev_shaping": float(env.prev_shaping),
        "game_over": bool(env.game_over),
    }


def record(name, offset, policy, limit):
    env = gymnasium.make("LunarLander-v3").unwrapped
    env.reset(seed=SEED + offset)
    env.np_random = draws = Draws(env.np_random)
    obs, _ = env.reset()
    at_reset = draws.take()
    actions = numpy.random.default_rng(SEED + offset)
    out = {
        "name": name, "seed": SEED + offset, "time_limit": limit, "terrain_heights": at_reset[:12],
        "initial_force": at_reset[12:14], "reset_dispersion": at_reset[14:],
        "init": {"state": state(env), "obs": obs.tolist()},
        "actions": [], "obs": [], "rewards": [], "terminated": [], "truncated": [], "states": {}, "info": {"dispersion": []},
    }
    while True:
        action = int(policy(env, obs, actions, len(out["actions"])))
        obs, reward, terminated, _, _ = env.step(action)
        out["actions"].append([action, []])
        out["obs"].append(obs.tolist())
        out["rewards"].append(float(reward))
        out["terminated"].append(bool(terminated))
        out["truncated"].append(len(out["actions"]) >= limit)
        out["info"]["dispersion"].append(draws.take())
        for key, value in state(env).items():
            out["states"].setdefault(key, []).append(value)
        if terminated or out["truncated"][-1]:
            print(name, len(out["rewards"]), sum(out["rewards"]), file=sys.stderr)
            return out


def main(path):
    trajectories = [
        record("heuristic", 0, lambda env, obs, _, k: heuristic(env, obs), 1000),
        record("heuristic_2", 1, lambda env, obs, _, k: heuristic(env, obs), 1000),
        record("uniform", 2, lambda env, obs, rng, k: rng.integers(4), 1000),
        record("each_in_turn", 3, lambda env, obs, _, k: k // 5 % 4, 60),
    ]
    versions = {name: version(name) for name in ["numpy", "gymnasium", "box2d"]}
    versions |= {"python": platform.python_version(), "machine": platform.machine()}
    document = {
        "format": 1, "env": "LunarLander-v3", "versions": versions,
        "meta": {"body_columns": COLUMNS}, "trajectories": trajectories,
    }
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    with open(path, "wb") as file:
        file.write(gzip.compress(text, 9, mtime=0))


if __name__ == "__main__":
    main(*sys.argv[1:])
