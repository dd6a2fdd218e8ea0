"""Slices that begin in the last steps of an episode, in the loss and in reanalyze."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, TensorDictRoundRobinWriter
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc import (
    EfficientTDMPCLoss,
    EnsembleMPPIPlanner,
    LatentEnv,
    ReanalyzeTransform,
    StepSliceSampler,
    WorldModel,
)
from torchrl_etdmpc.testing import random_slices

SLICE_LEN, EPISODES, LENGTH = 3, 12, 4
MASK = ("collector", "mask")


def make_model() -> WorldModel:
    torch.manual_seed(0)
    return WorldModel(3, 1, latent_dim=16, mlp_dim=16, encoder_dim=16, num_dynamics=2, termination=True)


def make_buffer(**options) -> TensorDictReplayBuffer:
    """Short episodes, each of which terminates."""
    torch.manual_seed(0)
    rows = random_slices(3, 1, num_slices=EPISODES, slice_len=LENGTH)
    for flag in ("terminated", "done"):
        rows["next", flag][:, -1] = True
    rows["collector", "traj_ids"] = torch.arange(EPISODES).unsqueeze(-1).expand(EPISODES, LENGTH).clone()
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(EPISODES * LENGTH),
        sampler=StepSliceSampler(SLICE_LEN, **options),
        writer=TensorDictRoundRobinWriter(track_generations=True),
        batch_size=64 * SLICE_LEN,
    )
    buffer.extend(rows.reshape(-1))
    return buffer


def losses_and_gradients(model: WorldModel, batch: TensorDict) -> dict[str, torch.Tensor]:
    loss = EfficientTDMPCLoss(model, discount=0.9)
    SoftUpdate(loss, tau=0.01)
    torch.manual_seed(1)
    terms = loss(batch)
    sum(value for key, value in terms.items() if key.startswith("loss_")).backward()
    gradients = {name: p.grad for name, p in loss.named_parameters() if p.grad is not None}
    return {**dict(terms.items()), **gradients}


@pytest.mark.parametrize("filling", [1e3, torch.nan])
def test_what_stands_beyond_the_end_influences_neither_losses_nor_gradients(filling):
    batch = make_buffer(partial=True).sample().reshape(-1, SLICE_LEN)
    beyond = ~batch[MASK]
    assert beyond.any(0).tolist() == [False, True, True]
    other = batch.clone()
    for key in ("action", ("next", "reward"), ("next", "observation"), ("plan", "loc"), ("plan", "scale")):
        other[key][beyond] = filling
    expected, got = (losses_and_gradients(make_model(), each) for each in (batch, other))
    assert expected.keys() == got.keys()
    for key, value in expected.items():
        assert value.isfinite().all(), key
        torch.testing.assert_close(got[key], value, rtol=0, atol=0, msg=str(key))


def test_the_termination_head_sees_the_end_at_every_depth_of_the_rollout():
    for partial, seen in ((False, [False, False, True]), (True, [True, True, True])):
        batch = make_buffer(partial=partial).sample().reshape(-1, SLICE_LEN)
        ends = batch["next", "terminated"].squeeze(-1)
        if partial:
            ends = ends & batch[MASK]
        assert ends.any(0).tolist() == seen


def test_samples_have_one_shape_and_one_set_of_keys_whatever_starts_are_drawn():
    buffer = make_buffer(partial=True)
    shapes = {tuple((str(key), value.shape) for key, value in buffer.sample().items(True, True)) for _ in range(5)}
    assert len(shapes) == 1
    running = make_buffer(partial=True)
    running.empty()
    rows = random_slices(3, 1, num_slices=1, slice_len=9)
    rows["collector", "traj_ids"] = torch.zeros(1, 9, dtype=torch.int64)
    running.extend(rows.reshape(-1))
    assert tuple((str(key), value.shape) for key, value in running.sample().items(True, True)) in shapes


def test_reanalyze_gives_the_repeated_step_one_target():
    buffer = make_buffer(partial=True)
    budget = {"horizon": 2, "num_samples": 8, "num_elites": 2, "num_proposals": 2, "iterations": 1}
    planner = EnsembleMPPIPlanner(LatentEnv(make_model()), warm_start=False, **budget)
    reanalyze = ReanalyzeTransform(planner, slice_len=SLICE_LEN, interval=1, num_slices=64).attach(buffer)
    batch = buffer.sample()
    assert reanalyze.stale == 0 and reanalyze.refreshed == batch.numel()
    for key in (("plan", "loc"), ("plan", "value")):
        assert torch.equal(batch[key], buffer.storage[:][key][batch["index"].flatten()])
