"""The baseline learners in PyTorch: written from the formulas of docs/src/algorithms, for speed on a processor, and used twice:
as the peers of `gadm bench train` (updates.py) and as the second opinion on one update of each (oracle.py)."""

import torch
import torch.nn.functional as F

from networks import mlp


def optimiser(parameters, lr, eps=1e-8):
    return torch.optim.Adam(parameters, lr=lr, eps=eps, fused=True)


def descend(adam, loss, parameters):
    for p, g in zip(parameters, torch.autograd.grad(loss, parameters)):
        p.grad = g
    adam.step()


class Td3:
    """Fujimoto et al. 2018, algorithm 1, with targets that follow on the policy's updates."""

    def __init__(self, obs, slots, hidden, lr=1e-3, eps=1e-8, tau=0.005, delay=2, sigma=0.2, bound=0.5):
        self.actor, self.actor_target = (mlp(obs, *hidden, slots) for _ in range(2))
        self.critics = [mlp(obs + slots, *hidden, 1) for _ in range(2)]
        self.critic_targets = [mlp(obs + slots, *hidden, 1) for _ in range(2)]
        self.actor_target.load_state_dict(self.actor.state_dict())
        for target, critic in zip(self.critic_targets, self.critics):
            target.load_state_dict(critic.state_dict())
        self.actor_parameters = list(self.actor.parameters())
        self.critic_parameters = [p for critic in self.critics for p in critic.parameters()]
        self.parameters = self.actor_parameters + self.critic_parameters
        self.frozen = [p for net in [self.actor_target, *self.critic_targets] for p in net.parameters()]
        self.actor_adam = optimiser(self.actor_parameters, lr, eps)
        self.critic_adam = optimiser(self.critic_parameters, lr, eps)
        self.tau, self.delay, self.sigma, self.bound, self.updates = tau, delay, sigma, bound, 0

    def update(self, obs, actions, returns, bootstrap, next_obs, noise=None):
        with torch.no_grad():
            noise = torch.randn_like(actions) if noise is None else noise
            smooth = (noise * self.sigma).clamp(-self.bound, self.bound)
            pair = torch.cat([next_obs, (self.actor_target(next_obs).tanh() + smooth).clamp(-1, 1)], 1)
            least = torch.minimum(*(target(pair) for target in self.critic_targets)).squeeze(1)
            y = returns + bootstrap * least
        pair = torch.cat([obs, actions], 1)
        loss = sum(F.mse_loss(critic(pair).squeeze(1), y) for critic in self.critics)
        descend(self.critic_adam, loss, self.critic_parameters)
        self.updates += 1
        policy_loss = None
        if self.updates % self.delay == 0:
            policy_loss = -self.critics[0](torch.cat([obs, self.actor(obs).tanh()], 1)).mean()
            descend(self.actor_adam, policy_loss, self.actor_parameters)
            with torch.no_grad():
                torch._foreach_lerp_(self.frozen, self.parameters, self.tau)
        return {"targets": y, "q_loss": loss, "policy_loss": policy_loss}


class Dqn:
    """Double DQN; `net` gives the values of all outputs, `value(q, index)` makes the value of an action of them."""

    def __init__(self, make, value, greedy, lr, eps, tau):
        self.q, self.target, self.value, self.greedy, self.tau = make(), make(), value, greedy, tau
        self.parameters, self.frozen = list(self.q.parameters()), list(self.target.parameters())
        self.adam = optimiser(self.parameters, lr, eps)

    def update(self, obs, index, returns, bootstrap, next_obs):
        with torch.no_grad():
            best = self.greedy(self.q(next_obs))
            y = returns + bootstrap * self.value(self.target(next_obs), best)
        loss = F.mse_loss(self.value(self.q(obs), index), y)
        descend(self.adam, loss, self.parameters)
        with torch.no_grad():
            torch._foreach_lerp_(self.frozen, self.parameters, self.tau)
        return {"targets": y, "q_loss": loss}


class Dueling(torch.nn.Module):
    """Wang et al. 2016, eq. 9, with a hidden layer in each stream."""

    def __init__(self, obs, hidden, actions):
        super().__init__()
        w = hidden[-1]
        self.trunk = torch.nn.Sequential(mlp(obs, *hidden), torch.nn.ReLU())
        self.advantage_hidden, self.value_hidden = torch.nn.Linear(w, w), torch.nn.Linear(w, w)
        self.advantage, self.value = torch.nn.Linear(w, actions), torch.nn.Linear(w, 1)

    def forward(self, obs):
        x = self.trunk(obs)
        a = self.advantage(F.relu(self.advantage_hidden(x)))
        return a - a.mean(1, keepdim=True) + self.value(F.relu(self.value_hidden(x)))


def dqn_listed(obs, hidden, actions, lr=3e-4, eps=1e-8, tau=0.001):
    one = lambda q, index: q.gather(1, index.unsqueeze(1)).squeeze(1)
    return Dqn(lambda: Dueling(obs, hidden, actions), one, lambda q: q.argmax(1), lr, eps, tau)


def dqn_decoupled(obs, hidden, slots, bins, lr=3e-4, eps=1e-8, tau=0.001):
    groups = lambda q: q.view(-1, slots, bins)
    mean = lambda q, index: groups(q).gather(2, index.unsqueeze(2)).squeeze(2).mean(1)
    return Dqn(lambda: mlp(obs, *hidden, slots * bins), mean, lambda q: groups(q).argmax(2), lr, eps, tau)


class PdqnNet(torch.nn.Module):
    """Values of all types at arguments x: an encoder of the observation, two streams on encoder and arguments."""

    def __init__(self, obs, hidden, types, arguments):
        super().__init__()
        w = hidden[-1] + arguments
        self.encoder = torch.nn.Sequential(mlp(obs, *hidden), torch.nn.ReLU())
        self.advantage_hidden, self.value_hidden = torch.nn.Linear(w, w), torch.nn.Linear(w, w)
        self.advantage, self.value = torch.nn.Linear(w, types), torch.nn.Linear(w, 1)

    def heads(self, e, x):
        pair = torch.cat([e, x], -1)
        a = self.advantage(F.relu(self.advantage_hidden(pair)))
        return a - a.mean(-1, keepdim=True) + self.value(F.relu(self.value_hidden(pair)))


class Pdqn:
    """Bester et al. 2019; `uses` (types x arguments) tells which arguments a pass sees: with ones everywhere it is PDQN."""

    def __init__(self, obs, hidden, uses, absent, lr=3e-4, eps=1e-8, tau=0.001):
        types, arguments = uses.shape
        self.q, self.target = (PdqnNet(obs, hidden, types, arguments) for _ in range(2))
        self.x = mlp(hidden[-1], hidden[-1], arguments)
        self.uses, self.absent, self.tau = uses, absent, tau
        self.parameters, self.frozen = list(self.q.parameters()), list(self.target.parameters())
        self.x_parameters = list(self.x.parameters())
        self.q_adam, self.x_adam = optimiser(self.parameters, lr, eps), optimiser(self.x_parameters, lr, eps)

    def seen(self, x, uses):
        return x * uses + self.absent * (1 - uses)

    def all_passes(self, e, x):
        """One whole pass per type, and of each the output of that type."""
        types = len(self.uses)
        passes = self.seen(x.unsqueeze(1), self.uses)
        values = self.q.heads(e.unsqueeze(1).expand(-1, types, -1), passes)
        return values.diagonal(dim1=1, dim2=2)

    def update_q(self, obs, types, x, returns, bootstrap, next_obs):
        taken = lambda net, obs, x, types: (
            net.heads(net.encoder(obs), self.seen(x, self.uses[types])).gather(1, types.unsqueeze(1)).squeeze(1)
        )
        with torch.no_grad():
            e = self.q.encoder(next_obs)
            proposed = self.x(e).tanh()
            best = self.all_passes(e, proposed).argmax(1)
            y = returns + bootstrap * taken(self.target, next_obs, proposed, best)
        loss = F.mse_loss(taken(self.q, obs, x, types), y)
        descend(self.q_adam, loss, self.parameters)
        with torch.no_grad():
            torch._foreach_lerp_(self.frozen, self.parameters, self.tau)
        return {"targets": y, "q_loss": loss}

    def update_x(self, obs):
        e = self.q.encoder(obs).detach()
        loss = -self.all_passes(e, self.x(e).tanh()).sum(1).mean()
        descend(self.x_adam, loss, self.x_parameters)
        return {"policy_loss": loss}


class Hppo:
    """Schulman et al. 2017 with a type and its arguments, each with its own clipped ratio."""

    def __init__(self, obs, hidden, types, arguments, s):
        w = hidden[-1]
        self.encoder = torch.nn.Sequential(mlp(obs, *hidden), torch.nn.ReLU())
        self.types, self.arguments, self.value = mlp(w, w, types), mlp(w, w, arguments), mlp(w, w, 1)
        nets = [self.encoder, self.types, self.arguments, self.value]
        self.parameters = [p for net in nets for p in net.parameters()]
        self.adam, self.s = optimiser(self.parameters, s["learning_rate"], s["epsilon"]), s

    def outputs(self, obs):
        e = self.encoder(obs)
        types = torch.distributions.Categorical(logits=self.types(e))
        arguments = torch.distributions.Normal(self.arguments(e).tanh(), self.s["sigma"])
        return types, arguments, self.value(e).squeeze(1)

    @torch.no_grad()
    def targets(self, obs, next_obs, rewards, goes_on, ends, envs, deviation):
        """Advantages, returns and values of a round; the latter two in units of `deviation`."""
        values = self.outputs(obs)[2]
        v, after = values * deviation, self.outputs(next_obs)[2] * deviation * goes_on
        delta = rewards + self.s["gamma"] * after - v
        advantages = torch.zeros_like(delta)
        for i in reversed(range(len(delta))):
            later = advantages[i + envs] if i + envs < len(delta) and not ends[i] else 0.0
            advantages[i] = delta[i] + self.s["gamma"] * self.s["gae_lambda"] * later
        return advantages, (v + advantages) / deviation, values

    def update(self, obs, kinds, x, log, advantages, returns, values):
        types, arguments, value = self.outputs(obs)
        a = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        new = torch.stack([types.log_prob(kinds), arguments.log_prob(x).sum(1)], 1)
        ratio = (new - log).exp()
        bound = ratio.clamp(1 - self.s["clip"], 1 + self.s["clip"])
        policy = -torch.minimum(ratio * a.unsqueeze(1), bound * a.unsqueeze(1)).sum(1).mean()
        held = values + (value - values).clamp(-self.s["value_clip"], self.s["value_clip"])
        value_loss = 0.5 * torch.maximum((returns - value) ** 2, (returns - held) ** 2).mean()
        entropy = types.entropy().mean()
        loss = policy + self.s["value_weight"] * value_loss - self.s["entropy_weight"] * entropy
        descend(self.adam, loss, self.parameters)
        return {"policy_loss": policy, "value_loss": value_loss, "policy_entropy": entropy}
