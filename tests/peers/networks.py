"""The networks and updates of this repository's Algorithm 1 in PyTorch, as one would write them for speed on a processor:
fused Adam, foreach clipping and target updates, and only those outputs of the 20 heads computed that are needed.

The formulas are those of trainer/src; see docs/src/algorithms/gadm-dqn.md.
"""

import torch
import torch.nn.functional as F
from torch import nn

ATOMS = 51


def adam(parameters, lr=3e-4):
    return torch.optim.Adam(parameters, lr=lr, fused=True)


def step(optimizer, loss, parameters, clip):
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    nn.utils.clip_grad_norm_(parameters, clip, foreach=True)
    optimizer.step()


def mlp(*widths):
    layers = []
    for i, (a, b) in enumerate(zip(widths, widths[1:])):
        layers += [nn.Linear(a, b)] + ([nn.ReLU()] if i < len(widths) - 2 else [])
    return nn.Sequential(*layers)


class PlainDqn:
    """Double DQN of one output per action; the target is copied every 500 updates."""

    def __init__(self, *widths, clip=10.0):
        self.q, self.target = mlp(*widths), mlp(*widths)
        self.target.load_state_dict(self.q.state_dict())
        self.parameters = list(self.q.parameters())
        self.frozen = list(self.target.parameters())
        self.optimizer, self.clip, self.updates = adam(self.parameters), clip, 0

    def update(self, obs, codes, returns, bootstrap, next_obs):
        with torch.no_grad():
            best = self.q(next_obs).argmax(1, keepdim=True)
            y = returns + bootstrap * self.target(next_obs).gather(1, best).squeeze(1)
        q = self.q(obs).gather(1, codes.unsqueeze(1)).squeeze(1)
        loss = F.mse_loss(q, y)
        step(self.optimizer, loss, self.parameters, self.clip)
        self.updates += 1
        if self.updates % 500 == 0:
            with torch.no_grad():
                torch._foreach_copy_(self.frozen, self.parameters)


class DuelingNet(nn.Module):
    def __init__(self, obs, latents, heads, widths=(256, 256, 128)):
        super().__init__()
        w = widths[-1]
        self.latents, self.heads, self.width = latents, heads, w
        self.trunk = nn.Sequential(mlp(obs, *widths), nn.ReLU())
        self.ha, self.hv = nn.Linear(w, w), nn.Linear(w, w)
        self.advantage, self.value = nn.Linear(w, latents * heads), nn.Linear(w, heads)

    def streams(self, obs):
        x = self.trunk(obs)
        return F.relu(self.ha(x)), F.relu(self.hv(x))

    def weights(self):
        shape = (self.latents, self.heads, self.width)
        return self.advantage.weight.view(shape), self.advantage.bias.view(shape[:2])

    def scores(self, obs):
        """Mean over heads of the advantages: orders latents as the mean Q does."""
        w, b = self.weights()
        return F.linear(F.relu(self.ha(self.trunk(obs))), w.mean(1), b.mean(1))

    def gathered(self, obs, codes, full):
        """Q[b, codes[b], e]; `full` forms all K x E outputs first."""
        ha, hv = self.streams(obs)
        value = self.value(hv)
        if full:
            a = self.advantage(ha).view(-1, self.latents, self.heads)
            index = codes.view(-1, 1, 1).expand(-1, 1, self.heads)
            return a.gather(1, index).squeeze(1) - a.mean(1) + value
        w, b = self.weights()
        rows = F.embedding(codes, w.flatten(1)).view(-1, self.heads, self.width)
        a = torch.bmm(rows, ha.unsqueeze(2)).squeeze(2) + F.embedding(codes, b)
        return a - F.linear(ha, w.mean(0), b.mean(0)) + value


class DuelingDqn:
    """Masked double DQN with an ensemble of dueling heads and a Polyak target."""

    def __init__(self, obs, latents=64, heads=20, clip=0.5, tau=0.001, full=False):
        self.q, self.target = DuelingNet(obs, latents, heads), DuelingNet(obs, latents, heads)
        self.target.load_state_dict(self.q.state_dict())
        self.parameters, self.frozen = list(self.q.parameters()), list(self.target.parameters())
        self.optimizer, self.clip, self.tau, self.full = adam(self.parameters), clip, tau, full

    @torch.no_grad()
    def greedy(self, obs, allowed):
        scores = self.q.scores(obs)
        return (scores if allowed is None else scores.masked_fill(~allowed, -1e9)).argmax(1)

    def update(self, obs, codes, returns, bootstrap, next_obs, allowed):
        best = self.greedy(next_obs, allowed)
        with torch.no_grad():
            least = self.target.gathered(next_obs, best, self.full).amin(1)
            y = (returns + bootstrap * least).unsqueeze(1)
        q = self.q.gathered(obs, codes, self.full)
        loss = (q - y).square().mean(0).sum()
        step(self.optimizer, loss, self.parameters, self.clip)
        with torch.no_grad():
            torch._foreach_lerp_(self.frozen, self.parameters, self.tau)


class ActionModel(nn.Module):
    """Encoder, one-hot code with straight-through gradient, decoder with a categorical head; fusion by product."""

    def __init__(self, obs, slots, latents=64, hidden=256, clip=0.5, commitment=0.25):
        super().__init__()
        h = hidden
        self.action, self.state = nn.Linear(slots, h), nn.Linear(obs, h)
        self.encoder = nn.Sequential(mlp(h, h, h), nn.ReLU())
        self.to_code = nn.Linear(h, latents)
        self.norm = nn.BatchNorm1d(latents, affine=False, momentum=0.05)
        self.code = nn.Linear(latents, h)
        self.decoder = nn.Linear(h, h)
        self.head = nn.Linear(h, slots * ATOMS)
        self.slots, self.latents, self.clip, self.commitment = slots, latents, clip, commitment
        self.atoms = torch.linspace(-1, 1, ATOMS)
        self.eye = torch.eye(latents)
        self.all = list(self.parameters())
        self.optimizer = adam(self.all)

    def position(self, state, actions):
        f = self.encoder(F.relu(self.action(actions)) * state)
        return 0.5 * self.norm(self.to_code(f))

    def outputs(self, state, code):
        g = F.relu(self.decoder(F.relu(self.code(code)) * state))
        p = F.softmax(self.head(g).view(-1, self.slots, ATOMS), -1)
        return p @ self.atoms

    def update(self, obs, actions):
        self.train()
        state = F.relu(self.state(obs))
        z = self.position(state, actions)
        row = self.eye[z.detach().argmax(1)]
        loss = F.mse_loss(self.outputs(state, z + (row - z).detach()), actions)
        loss = loss + self.commitment * F.mse_loss(z, row)
        step(self.optimizer, loss, self.all, self.clip)

    @torch.no_grad()
    def encode(self, obs, actions):
        self.eval()
        return self.position(F.relu(self.state(obs)), actions).argmax(1)

    @torch.no_grad()
    def decode(self, obs, codes):
        self.eval()
        return self.outputs(F.relu(self.state(obs)), self.eye[codes])


class Confidence:
    """Focal loss with the modulating factor held constant."""

    def __init__(self, obs, latents=64, gamma=2.0, clip=0.5, threshold=1.0):
        self.net = mlp(obs, 256, 256, latents)
        self.parameters = list(self.net.parameters())
        self.optimizer, self.gamma, self.clip = adam(self.parameters), gamma, clip
        self.beta = threshold / latents

    def update(self, obs, codes):
        ce = F.cross_entropy(self.net(obs), codes, reduction="none")
        factor = (1 - torch.exp(-ce.detach()).clamp(1e-6, 1)) ** self.gamma
        step(self.optimizer, (factor * ce).mean(), self.parameters, self.clip)

    @torch.no_grad()
    def masks(self, obs):
        p = F.softmax(self.net(obs), -1)
        allowed = p > self.beta
        none = ~allowed.any(1, keepdim=True)
        return allowed | (none & (p == p.amax(1, keepdim=True)))
