"""Steps of Hopper by gymnasium and envpool: random actions drawn beforehand, resets included."""

import numpy as np

from measure import serve

ACTIONS = np.random.default_rng(1).uniform(-1, 1, (64, 16, 3)).astype(np.float32)


def gymnasium_one(_threads):
    import gymnasium

    env = gymnasium.make("Hopper-v5")
    env.reset(seed=1)
    count = [0]

    def work():
        count[0] += 1
        _, _, terminated, truncated, _ = env.step(ACTIONS[count[0] % 64, 0])
        if terminated or truncated:
            env.reset()
        return 1

    return (lambda: None), work


def pool(envs):
    def make(threads):
        import envpool

        env = envpool.make("Hopper-v5", env_type="gymnasium", num_envs=envs, num_threads=threads, seed=1)
        env.reset()
        count = [0]

        def work():
            count[0] += 1
            env.step(ACTIONS[count[0] % 64, :envs])
            return envs

        return (lambda: None), work

    return make


serve({"gymnasium": gymnasium_one, "envpool-1": pool(1), "envpool-16": pool(16)})
