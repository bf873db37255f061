#!/usr/bin/env python3
"""One update of every baseline learner, ours and PyTorch's, from the same numbers: targets, losses and the new weights.

Reads what `cargo run --example learner_updates` writes on standard input: settings, weights, a batch, and what came out. Exit
code 0 where everything agrees, 1 where something does not. Run by `make test-peers`.
"""

import json
import sys

import torch

import learners

# Largest difference, as a share of the largest entry. Sums are taken in other orders, and one step of Adam divides by the root
# of a square; the settings have an epsilon that keeps that division well behaved.
TOLERANCE = 2e-5


def tensors(array):
    return torch.tensor(array["values"], dtype=torch.float32).view(array["shape"])


def load(net, arrays, prefix):
    """Sets the layers of a network from arrays named `<prefix>0.weight`, `<prefix>0.bias`, `<prefix>1.weight`, ..."""
    layers = [layer for layer in net.modules() if isinstance(layer, torch.nn.Linear)]
    for i, layer in enumerate(layers):
        layer.weight.data = tensors(arrays[f"{prefix}{i}.weight"])
        layer.bias.data = tensors(arrays[f"{prefix}{i}.bias"])


def layers_of(net, prefix):
    layers = [layer for layer in net.modules() if isinstance(layer, torch.nn.Linear)]
    for i, layer in enumerate(layers):
        yield f"{prefix}{i}.weight", layer.weight
        yield f"{prefix}{i}.bias", layer.bias


class Check:
    def __init__(self, name):
        self.name, self.worst, self.wrong, self.count = name, 0.0, [], 0

    def close(self, what, ours, theirs):
        ours, theirs = ours.detach().flatten(), theirs.detach().flatten()
        if ours.shape != theirs.shape:
            self.wrong.append(f"{what}: {tuple(ours.shape)} numbers, PyTorch {tuple(theirs.shape)}")
            return
        scale = max(theirs.abs().max().item(), 1e-3)
        off = ((ours - theirs).abs().max() / scale).item()
        self.count += ours.numel()
        self.worst = max(self.worst, off)
        if not off <= TOLERANCE:
            self.wrong.append(f"{what}: off by {off:.1e} of its largest entry, at most {TOLERANCE:g} expected")

    def networks(self, case, stage, nets):
        for network, net, prefix in nets:
            for name, value in layers_of(net, prefix):
                self.close(f"{stage}: {network}/{name}", tensors(case[stage][network][name]), value)

    def report(self):
        verdict = "FAILED" if self.wrong else "ok"
        print(f"{verdict}: {self.name}: {self.count} numbers, largest difference {self.worst:.1e}")
        for line in self.wrong:
            print(f"    {line}")
        return not self.wrong


def td3(case, check):
    s, b = case["settings"], {name: tensors(array) for name, array in case["batch"].items()}
    peer = learners.Td3(b["obs"].shape[1], b["actions"].shape[1], s["hidden"], s["learning_rate"], s["epsilon"], s["tau"],
                        s["policy_delay"], s["target_noise"], s["noise_clip"])
    nets = [("actor", peer.actor, "actor"), ("actor-target", peer.actor_target, "actor")]
    for i in range(2):
        nets += [("critics", peer.critics[i], f"q{i + 1}-"), ("critics-target", peer.critic_targets[i], f"q{i + 1}-")]
    for network, net, prefix in nets:
        load(net, case["before"][network], prefix)
    out = peer.update(b["obs"], b["actions"], b["returns"], b["bootstrap"], b["next_obs"], b["noise"])
    check.close("targets", torch.tensor(case["targets"]), out["targets"])
    for loss in ("q_loss", "policy_loss"):
        check.close(loss, torch.tensor([case["report"][loss]]), out[loss])
    check.networks(case, "after", nets)


def dqn_manual(case, check):
    s, b = case["settings"], {name: tensors(array) for name, array in case["batch"].items()}
    slots = b["actions"].shape[1]
    actions = s["bins"] ** slots
    peer = learners.dqn_listed(b["obs"].shape[1], s["hidden"], actions, s["learning_rate"], s["epsilon"], s["tau"])
    # The list itself: the last slot changes fastest.
    grid = torch.linspace(-1, 1, s["bins"])
    listed = torch.cartesian_prod(*[grid] * slots)
    check.close("list of actions", tensors(case["before"]["actions"]["actions"]), listed)
    codes = b["codes"].long()
    check.close("listed actions", b["actions"], listed[codes])

    nets = [("q", peer.q), ("q-target", peer.target)]
    load_dueling(case, nets, lambda net: layers_of(net.trunk, "trunk"))
    out = peer.update(b["obs"], codes, b["returns"], b["bootstrap"], b["next_obs"])
    check.close("q_loss", torch.tensor([case["report"]["q_loss"]]), out["q_loss"])
    compare_dueling(case, check, nets, lambda net: layers_of(net.trunk, "trunk"))


def streams(net):
    for name, layer in (("advantage.hidden", net.advantage_hidden), ("value.hidden", net.value_hidden),
                        ("advantage", net.advantage), ("value", net.value)):
        yield f"{name}.weight", layer.weight
        yield f"{name}.bias", layer.bias


def load_dueling(case, nets, below):
    for network, net in nets:
        for name, value in (*below(net), *streams(net)):
            value.data = tensors(case["before"][network][name]).view(value.shape)


def compare_dueling(case, check, nets, below):
    for network, net in nets:
        for name, value in (*below(net), *streams(net)):
            check.close(f"after: {network}/{name}", tensors(case["after"][network][name]), value)


def pdqn(case, check):
    s, b = case["settings"], {name: tensors(array) for name, array in case["batch"].items()}
    uses = b["uses"]
    peer = learners.Pdqn(b["obs"].shape[1], s["hidden"], uses, s["absent"], s["learning_rate"], s["epsilon"], s["tau"])
    nets, below = [("q", peer.q), ("q-target", peer.target)], lambda net: layers_of(net.encoder, "encoder")
    load_dueling(case, nets, below)
    load(peer.x, case["before"]["x"], "x")
    x = b["actions"][:, -uses.shape[1]:]
    out = peer.update_q(b["obs"], b["codes"].long(), x, b["returns"], b["bootstrap"], b["next_obs"])
    check.close("targets", torch.tensor(case["targets"]), out["targets"])
    out.update(peer.update_x(b["obs"]))
    for loss in ("q_loss", "policy_loss"):
        check.close(loss, torch.tensor([case["report"][loss]]), out[loss])
    compare_dueling(case, check, nets, below)
    check.networks(case, "after", [("x", peer.x, "x")])


def dqn_decoupled(case, check):
    s, b = case["settings"], {name: tensors(array) for name, array in case["batch"].items()}
    slots, bins = b["actions"].shape[1], s["bins"]
    peer = learners.dqn_decoupled(b["obs"].shape[1], s["hidden"], slots, bins, s["learning_rate"], s["epsilon"], s["tau"])
    nets = [("q", peer.q, "q"), ("q-target", peer.target, "q")]
    for network, net, prefix in nets:
        load(net, case["before"][network], prefix)
    index = ((b["actions"] + 1) / 2 * (bins - 1)).round().long()
    out = peer.update(b["obs"], index, b["returns"], b["bootstrap"], b["next_obs"])
    check.close("q_loss", torch.tensor([case["report"]["q_loss"]]), out["q_loss"])
    check.networks(case, "after", nets)


def hppo(case, check):
    s, b = case["settings"], {name: tensors(array) for name, array in case["batch"].items()}
    before = case["before"]["policy"]
    types, arguments = len(before["types1.bias"]["values"]), b["x"].shape[1]
    peer = learners.Hppo(b["obs"].shape[1], s["hidden"], types, arguments, s)
    nets = [("policy", peer.encoder, "encoder"), ("policy", peer.types, "types"),
            ("policy", peer.arguments, "arguments"), ("policy", peer.value, "value")]
    for network, net, prefix in nets:
        load(net, case["before"][network], prefix)
    round_ = (b["obs"], b["next_obs"], b["rewards"], b["goes_on"], b["ends"].bool(), s["envs"], s["deviation"])
    targets = peer.targets(*round_)
    for name, value in zip(("advantages", "returns", "values"), targets):
        check.close(name, b[name], value)
    kinds, log = b["kinds"].long(), b["log"]
    out = peer.update(b["obs"], kinds, b["x"], log, *targets)
    for name, value in out.items():
        check.close(name, torch.tensor([case["report"][name]]), value)
    check.networks(case, "after", nets)


CASES = {"td3": td3, "dqn-manual": dqn_manual, "dqn-decoupled": dqn_decoupled, "pdqn": pdqn, "hppo": hppo}


def main():
    cases, good = json.load(sys.stdin)["cases"], True
    for name in sorted(set(CASES) - {case["algorithm"] for case in cases}):
        print(f"FAILED: {name}: not among the updates that were read")
        good = False
    for case in cases:
        check = Check(case["name"])
        CASES[case["algorithm"]](case, check)
        good &= check.report()
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
