"""The loss under DistributedDataParallel."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch.nn.parallel import DistributedDataParallel
from torchrl.objectives import SoftUpdate

from torchrl_etdmpc import EfficientTDMPCLoss, WorldModel
from torchrl_etdmpc.testing import random_slices


def train(rank: int, world_size: int, store: Path) -> None:
    """Pretrains, distils, pretrains; the processes see different data and must keep the same weights."""
    dist.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=world_size)
    torch.manual_seed(0)
    loss = EfficientTDMPCLoss(WorldModel(3, 2, latent_dim=16, mlp_dim=16), discount=0.9)
    target_update = SoftUpdate(loss, tau=0.1)
    parallel = DistributedDataParallel(loss)
    optimizer = torch.optim.SGD(parallel.parameters(), lr=0.1)
    policy = loss.world_model.policy.output.weight
    torch.manual_seed(rank)
    for distill in (False, False, True, True, False, False):
        loss.distill = distill
        before = policy.detach().clone()
        out = parallel(random_slices(3, 2))
        sum(value for key, value in out.items() if key.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()
        target_update.step()
        assert torch.equal(policy, before) != distill
    assert loss.world_model.version == 6
    for parameter in loss.parameters():
        everywhere = [torch.zeros_like(parameter) for _ in range(world_size)]
        dist.all_gather(everywhere, parameter.detach())
        assert all(torch.equal(other, parameter) for other in everywhere)
    dist.barrier()  # who leaves early takes the connection along
    os._exit(0)  # gloo's destructor waits for threads that may wait for Python, one time in some hundreds for ever


@pytest.mark.parametrize("processes", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_processes_keep_the_same_weights_as_distillation_is_turned_off_and_on(tmp_path, processes):
    subprocess.run([sys.executable, __file__, str(tmp_path / "store"), str(processes)], check=True, timeout=300)


def test_without_other_processes_the_policy_has_no_gradient_while_distillation_is_off(make_loss, slices, total):
    loss = make_loss("whole", distill=False)
    total(loss(slices)).backward()
    assert all(parameter.grad is None for parameter in loss.world_model.policy.parameters())


if __name__ == "__main__":
    store, processes = Path(sys.argv[1]), int(sys.argv[2])
    if processes == 1:
        train(0, 1, store)
    else:
        mp.spawn(train, (processes, store), nprocs=processes)
