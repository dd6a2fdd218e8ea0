"""How fast do values that are classified over bins follow a rising one-step target?

    python benchmarks/sticking_values.py

A world where the truth is known: a state s in [-1, 1], next 0.98 s, reward 2 - 0.8 s^2, gamma 0.99. The value is 200
at 0 and 194 at 0.6, as high as where a cartpole stands. Two value heads of the `cpu` preset's size learn it by one-
step targets from their moving average, 192 states per update, as in training, with the states behind a fixed random
encoder; `exact` is the same recursion for the state 0 without any network. Writes
`benchmarks/results/cpu/sticking_values.csv`: the value at three states after every 1,000 updates.
"""

from __future__ import annotations

import copy
import csv
import os
import sys
from collections.abc import Iterator

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from cpu_learning import RESULTS
from torch import Tensor

from torchrl_etdmpc.functional import two_hot_cross_entropy, two_hot_decode
from torchrl_etdmpc.modules import Encoder
from torchrl_etdmpc.modules.heads import ValueEnsemble
from torchrl_etdmpc.training import preset

NUM_BINS = (21, 101, 201)
TAUS = (0.03, 0.1)
SEEDS = (1, 2, 3)
UPDATES, EVERY, STATES = 4000, 1000, (0.0, 0.3, 0.6)
DISCOUNT, SHRINK, TOP, SLOPE = 0.99, 0.98, 2.0, 0.8


def true_value(state: float) -> float:
    """The discounted return from a state, in closed form."""
    return TOP / (1 - DISCOUNT) - SLOPE * state**2 / (1 - DISCOUNT * SHRINK**2)


def exact(tau: float) -> Iterator[tuple[int, list[float]]]:
    """The value at 0 if every update reached its target at once."""
    target = 0.0
    for update in range(1, UPDATES + 1):
        value = TOP + DISCOUNT * target
        target += tau * (value - target)
        if update % EVERY == 0:
            yield update, [value]


def learned(num_bins: int, tau: float, seed: int) -> Iterator[tuple[int, list[float]]]:
    """The values that two heads learn, their mean at `STATES`."""
    torch.manual_seed(seed)
    config = preset("cpu")
    size, activation = config.model.latent_dim, config.model.activation
    encoder = Encoder(2, size, hidden_dim=size, activation=activation)
    with torch.no_grad():
        for weight in encoder.parameters():
            if weight.ndim > 1:
                weight.normal_(0, 0.3)  # so that near states differ, as those of a trained encoder do
    heads = ValueEnsemble(
        size, num_heads=2, num_bins=num_bins, hidden_dim=size, dropout=config.model.dropout, activation=activation
    )
    average = copy.deepcopy(heads)
    pairs = [list(network.parameters()) for network in (average, heads)]
    bins = torch.linspace(config.model.bin_min, config.model.bin_max, num_bins)
    optimizer = torch.optim.Adam(heads.parameters(), lr=config.optim.lr, fused=True)

    def encode(state: Tensor) -> Tensor:
        return encoder(torch.stack([state, state.square()], -1))

    for update in range(1, UPDATES + 1):
        state = torch.rand(config.optim.batch_size * config.loss.slice_len) * 2 - 1
        with torch.no_grad():
            following = two_hot_decode(average(encode(SHRINK * state)), bins).mean(0)
            target = TOP - SLOPE * state.square() + DISCOUNT * following
            latent = encode(state)
        loss = config.loss.value_coef * two_hot_cross_entropy(heads(latent, dropout=True), target, bins).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        torch._foreach_lerp_([weight.data for weight in pairs[0]], [weight.data for weight in pairs[1]], tau)
        if update % EVERY == 0:
            with torch.no_grad():
                yield update, two_hot_decode(heads(encode(torch.tensor(STATES))), bins).mean(0).tolist()


def main() -> None:
    torch.set_num_threads(1)
    with (RESULTS / "sticking_values.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["bins", "tau", "seed", "updates", *(f"value at {state:g}" for state in STATES)])
        writer.writerow(["truth", "", "", "", *(round(true_value(state), 1) for state in STATES)])
        for tau in TAUS:
            runs = {("exact", tau, ""): exact(tau)}
            runs |= {(num, tau, seed): learned(num, tau, seed) for num in NUM_BINS for seed in SEEDS}
            for name, curve in runs.items():
                for update, values in curve:
                    writer.writerow([*name, update, *(round(value, 1) for value in values)])
                file.flush()
                print(*name, update, *(round(value, 1) for value in values), file=sys.stderr)


if __name__ == "__main__":
    main()
