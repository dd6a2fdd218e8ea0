from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

from torchrl_etdmpc.modules import WorldModel

O, A, L = 5, 2, 16  # noqa: E741


@pytest.fixture(autouse=True)
def seeded() -> Iterator[None]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def _build(**options) -> WorldModel:
    return WorldModel(O, A, **{"latent_dim": L, "mlp_dim": 32, "encoder_dim": 24, **options})


@pytest.fixture
def build() -> Callable[..., Any]:
    return _build


def _randomised(**options) -> WorldModel:
    """A model without the zeros and the small weights of its start."""
    model = _build(**options)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(0.0, 0.5)
    return model


@pytest.fixture
def randomised() -> Callable[..., Any]:
    return _randomised


def _assert_on_the_simplices(latent: torch.Tensor, group_size: int = 8) -> None:
    groups = latent.shape[-1] // group_size
    assert (latent >= 0).all()
    sums = latent.unflatten(-1, (group_size, groups)).sum(-2)
    torch.testing.assert_close(sums, torch.ones_like(sums), rtol=0, atol=1e-5)


@pytest.fixture
def assert_on_the_simplices() -> Callable[..., Any]:
    return _assert_on_the_simplices
