"""TorchRL's prioritised sampler in the place of ours."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, PrioritizedSliceSampler, TensorDictReplayBuffer, TensorDictRoundRobinWriter
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc import EfficientTDMPCLoss, WorldModel
from torchrl_etdmpc.testing import random_slices

TRAJ_KEY = ("collector", "traj_ids")
SLICE_LEN, EPISODES, LENGTH = 3, 6, 10


@pytest.fixture
def buffer(segment_trees) -> TensorDictReplayBuffer:
    torch.manual_seed(0)
    sampler = PrioritizedSliceSampler(
        max_capacity=EPISODES * LENGTH,
        alpha=1.0,
        beta=1.0,
        slice_len=SLICE_LEN,
        traj_key=TRAJ_KEY,
        truncated_key=None,  # or it would mark the end of every slice as an end of the episode
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(EPISODES * LENGTH),
        sampler=sampler,
        writer=TensorDictRoundRobinWriter(track_generations=True),
        batch_size=32 * SLICE_LEN,
    )
    rows = random_slices(3, 1, num_slices=EPISODES, slice_len=LENGTH)
    rows[TRAJ_KEY] = torch.arange(EPISODES).unsqueeze(-1).expand(EPISODES, LENGTH).clone()
    rows["t"] = torch.arange(LENGTH).expand(EPISODES, LENGTH).clone()
    buffer.extend(rows.reshape(-1))
    return buffer


def sampled(buffer: TensorDictReplayBuffer) -> TensorDict:
    batch = buffer.sample().reshape(-1, SLICE_LEN)
    assert (batch["t"].diff(dim=-1) == 1).all() and (batch[TRAJ_KEY].diff(dim=-1) == 0).all()
    return batch


def test_a_priority_per_slice_belongs_to_the_row_it_begins_with(buffer):
    every = torch.arange(EPISODES * LENGTH)
    buffer.update_priority(every, torch.full((len(every),), 1e-6))
    first = torch.tensor([4, 37])
    buffer.update_priority(first, torch.tensor([1.0, 3.0]))
    begins = torch.cat([sampled(buffer)["index"][:, 0].flatten() for _ in range(30)])
    share = [(begins == row).float().mean().item() for row in first]
    assert share[0] == pytest.approx(0.25, abs=0.06) and share[1] == pytest.approx(0.75, abs=0.06)


def test_the_weights_undo_the_priorities_and_are_one_per_slice(buffer):
    every = torch.arange(EPISODES * LENGTH)
    priorities = 1 + torch.rand(len(every))
    buffer.update_priority(every, priorities)
    batch = sampled(buffer)
    weight = batch["priority_weight"]
    assert (weight == weight[:, :1]).all()
    product = weight[:, 0] * priorities[batch["index"][:, 0].flatten()]
    torch.testing.assert_close(product, product[:1].expand_as(product), rtol=1e-4, atol=0)


def test_learning_writes_the_priorities_of_its_slices_back(buffer):
    loss = EfficientTDMPCLoss(WorldModel(3, 1, latent_dim=16, mlp_dim=16, encoder_dim=16), discount=0.9)
    target_update = SoftUpdate(loss, tau=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    for _ in range(3):
        batch = sampled(buffer)
        terms = loss(batch)
        sum(value for key, value in terms.items() if key.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()
        target_update.step()
        priority = batch["next", "reward"].abs().sum((1, 2))  # one number per slice, whichever it is
        buffer.update_priority(batch["index"][:, 0].flatten(), priority)
    tree = buffer.sampler._sum_tree
    stored = torch.as_tensor(tree[batch["index"][:, 0].flatten().contiguous().numpy()])  # not of the strides
    torch.testing.assert_close(stored, priority, rtol=1e-4, atol=1e-6)
