"""Updates per second in PyTorch, on the sizes of `gadm bench train`."""

import time

import torch

from algorithm import Algorithm
from learners import Td3
from measure import serve
from networks import ActionModel, Confidence, DuelingDqn, PlainDqn

OBS, SLOTS, LATENTS, BATCH = 11, 3, 64, 512


def batch(n, obs, latents):
    g = torch.Generator().manual_seed(1)
    uniform = lambda *shape: torch.rand(*shape, generator=g) * 2 - 1
    codes = torch.randint(0, latents, (n,), generator=g)
    return uniform(n, obs), codes, uniform(n), torch.full((n,), 0.97), uniform(n, obs)


def fastest(works):
    """The quickest of several ways to do the same; each gets a quarter of a second."""
    best, best_time = None, float("inf")
    for work in works:
        work()
        begin, count = time.perf_counter(), 0
        while count < 3 or time.perf_counter() - begin < 0.25:
            work()
            count += 1
        each = (time.perf_counter() - begin) / count
        if each < best_time:
            best, best_time = work, each
    return best


def counted(call):
    def work():
        call()
        return 1

    return work


def case(make):
    """`make` returns one or more functions that do one unit of work each, all the same in effect."""

    def prepared(threads):
        torch.set_num_threads(threads)
        torch.manual_seed(1)
        return (lambda: torch.set_num_threads(threads)), fastest(make())

    return prepared


def dqn():
    model, data = PlainDqn(OBS, 256, 256, 128, LATENTS), batch(BATCH, OBS, LATENTS)
    return [counted(lambda: model.update(*data))]


def dueling():
    data = batch(BATCH, OBS, LATENTS)
    allowed = torch.rand(BATCH, LATENTS) < 0.5
    allowed[:, 0] = True
    models = [DuelingDqn(OBS, full=full) for full in (False, True)]
    return [counted(lambda model=model: model.update(*data, allowed)) for model in models]


def action_model():
    model = ActionModel(OBS, SLOTS)
    obs, actions = torch.rand(BATCH, OBS) * 2 - 1, torch.rand(BATCH, SLOTS) * 2 - 1
    return [counted(lambda: model.update(obs, actions))]


def confidence():
    model, data = Confidence(OBS), batch(BATCH, OBS, LATENTS)
    return [counted(lambda: model.update(data[0], data[1]))]


def small():
    model, data = PlainDqn(3, 64, 64, 8), batch(100, 3, 8)
    return [counted(lambda: model.update(*data))]


def td3(hidden, n):
    def make():
        model = Td3(3, 1, [hidden, hidden])
        obs, _, returns, bootstrap, next_obs = batch(n, 3, 1)
        actions = torch.rand(n, 1) * 2 - 1
        return [counted(lambda: model.update(obs, actions, returns, bootstrap, next_obs))]

    return make


def rounds():
    works = []
    for full in (False, True):
        algorithm = Algorithm(full)
        algorithm.round(), algorithm.round(), algorithm.round()
        works.append(algorithm.round)
    return works


def sgemm():
    a, b = torch.rand(BATCH, 256), torch.rand(256, 256)
    return [counted(lambda: torch.nn.functional.linear(a, b))]


serve(
    {
        "dqn": case(dqn),
        "dqn-dueling": case(dueling),
        "action-model": case(action_model),
        "confidence": case(confidence),
        "dqn-small": case(small),
        "td3-small": case(td3(64, 100)),
        "td3": case(td3(256, 256)),
        "round": case(rounds),
        "sgemm": case(sgemm),
    }
)
