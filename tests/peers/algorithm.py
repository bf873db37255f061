"""Rounds of Algorithm 1 on Hopper-v5 in PyTorch and gymnasium: 8 environments, 256 steps, then 50 action-model, 10 confidence
and 50 Q updates with remapping and masks, as `gadm bench train --case round` does them."""

from collections import deque

import gymnasium
import numpy as np
import torch

from networks import ActionModel, Confidence, DuelingDqn

ENVS, STEPS, BATCH, N_STEP, GAMMA = 8, 256, 512, 3, 0.99
CAPACITY = 1_000_000


class Replay:
    def __init__(self, *widths):
        self.columns = [np.zeros((CAPACITY, w), np.float32) for w in widths]
        self.next = self.len = 0

    def push(self, *row):
        for column, value in zip(self.columns, row):
            column[self.next] = value
        self.next = (self.next + 1) % CAPACITY
        self.len = min(self.len + 1, CAPACITY)

    def sample(self, rng):
        index = rng.integers(0, self.len, BATCH)
        return [torch.from_numpy(column[index]) for column in self.columns]


class Algorithm:
    def __init__(self, full):
        self.rng = np.random.default_rng(1)
        self.envs = [gymnasium.make("Hopper-v5") for _ in range(ENVS)]
        self.obs = np.stack([env.reset(seed=i)[0] for i, env in enumerate(self.envs)]).astype(np.float32)
        obs, slots = self.obs.shape[1], 3
        self.model, self.confidence = ActionModel(obs, slots), Confidence(obs)
        self.dqn = DuelingDqn(obs, full=full)
        self.d_ar, self.d_rl = Replay(obs, slots), Replay(obs, slots, 1, 1, obs)
        self.pending = [deque() for _ in range(ENVS)]

    def collect(self):
        obs = torch.from_numpy(self.obs)
        codes = self.dqn.greedy(obs, self.confidence.masks(obs))
        explore = torch.from_numpy(self.rng.random(ENVS) < 0.5)
        codes = torch.where(explore, torch.from_numpy(self.rng.integers(0, 64, ENVS)), codes)
        actions = self.model.decode(obs, codes).numpy()
        for i, env in enumerate(self.envs):
            before, action = self.obs[i].copy(), actions[i]
            after, reward, terminated, truncated, _ = env.step(action)
            self.d_ar.push(before, action)
            queue = self.pending[i]
            queue.append([before, action, []])
            for entry in queue:
                entry[2].append(reward)
            ends = terminated or truncated
            while queue and (ends or len(queue[0][2]) == N_STEP):
                start, taken, rewards = queue.popleft()
                ret = sum(r * GAMMA**k for k, r in enumerate(rewards))
                weight = 0.0 if terminated else GAMMA ** len(rewards)
                self.d_rl.push(start, taken, ret, weight, after)
            if ends:
                after, _ = env.reset()
            self.obs[i] = after

    def round(self):
        for _ in range(STEPS // ENVS):
            self.collect()
        if min(self.d_ar.len, self.d_rl.len) < BATCH:
            return STEPS
        for _ in range(50):
            self.model.update(*self.d_ar.sample(self.rng))
        for _ in range(10):
            obs, actions = self.d_ar.sample(self.rng)
            self.confidence.update(obs, self.model.encode(obs, actions))
        for _ in range(50):
            obs, actions, returns, weight, after = self.d_rl.sample(self.rng)
            codes, allowed = self.model.encode(obs, actions), self.confidence.masks(after)
            self.dqn.update(obs, codes, returns.squeeze(1), weight.squeeze(1), after, allowed)
        return STEPS
