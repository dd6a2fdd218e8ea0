from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from torchrl_etdmpc.functional import mish

X = torch.cat([torch.linspace(-50, 50, 2001), torch.tensor([-1e30, -200.0, 1e3, 1e30])])


@pytest.fixture
def compiling(monkeypatch) -> None:
    """Makes mish take the form that it has while compiling, which does without PyTorch's."""
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_mish_with_one_exponential_is_mish(compiling, dtype):
    x = X.to(dtype).requires_grad_()
    plain = F.mish(x)
    fast = mish(x)
    tolerance = {torch.float32: 1e-6, torch.float64: 1e-8}[dtype]  # beyond 20 the two differ by less than e^-40
    torch.testing.assert_close(fast, plain, rtol=tolerance, atol=0)
    slopes = [torch.autograd.grad(y.sum(), x, retain_graph=True)[0] for y in (fast, plain)]
    torch.testing.assert_close(*slopes, rtol=10 * tolerance, atol=10 * tolerance)


def test_mish_passes_on_what_is_not_finite(compiling):
    x = torch.tensor([float("inf"), float("nan")])
    assert mish(x).isinf().tolist() == [True, False]
    assert mish(x).isnan().tolist() == [False, True]


def test_mish_is_pytorch_s_unless_it_is_compiled(monkeypatch):
    x = torch.randn(100)
    plain = F.mish(x)
    assert torch.equal(mish(x), plain)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    monkeypatch.setattr(F, "mish", None)
    torch.testing.assert_close(mish(x), plain)


def test_mish_in_half_precision_does_not_overflow_where_it_is_compiled(compiling):
    x = torch.tensor([1.0, 5.6, 12.0, 300.0], dtype=torch.float16)
    torch.testing.assert_close(mish(x), F.mish(x.float()).half())
