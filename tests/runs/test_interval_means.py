from __future__ import annotations

import io

import pytest
import torch

from torchrl_etdmpc.runs import IntervalMeans


def test_the_mean_is_over_the_values_of_the_interval():
    means = IntervalMeans()
    for number in (1.0, 2.0, 6.0):
        means.add({"loss": torch.tensor(number), "norm": torch.tensor([10 * number])})
    assert means.means() == {"loss": 3, "norm": 30}
    means.clear()
    assert means.means() == {}
    means.add({"loss": torch.tensor(7.0), "norm": torch.tensor(1)})
    assert means.means() == {"loss": 7, "norm": 1}


def test_what_is_measured_seldom_has_a_mean_of_its_own():
    means = IntervalMeans()
    for number in range(4):
        means.add({"loss": torch.tensor(float(number))})
    means.add({"age": torch.tensor(5.0)})
    assert means.means() == {"loss": 1.5, "age": 5}


def test_a_metric_that_comes_in_other_company_is_one_metric():
    means = IntervalMeans()
    means.add({"loss": torch.tensor(0.0), "policy_kl": torch.tensor(1.0)})
    for number in (4.0, 8.0):
        means.add({"loss": torch.tensor(number)})
    assert means.means() == {"loss": 4, "policy_kl": 1}


def test_many_small_values_are_added_exactly_enough():
    means = IntervalMeans()
    for _ in range(10_000):
        means.add({"loss": torch.tensor(0.1)})
    assert means.means()["loss"] == pytest.approx(0.1, rel=1e-7)  # float32 sums would be off by 1e-4


def test_no_gradient_and_no_later_change_of_a_value_gets_in():
    means, value = IntervalMeans(), torch.tensor(2.0, requires_grad=True)
    means.add({"loss": value})
    with torch.no_grad():
        value.fill_(9)
    assert means.means() == {"loss": 2}
    assert not any(total.requires_grad for _, total, _ in means.state_dict()["sums"])


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_an_interval_goes_on_from_its_state(device):
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    values = [{"loss": torch.tensor(float(number), device=device)} for number in (1, 2, 6)]
    straight, first, second = IntervalMeans(), IntervalMeans(), IntervalMeans()
    for value in values:
        straight.add(value)
    first.add(values[0])
    first.add(values[1])
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second.load_state_dict(torch.load(file, map_location="cpu", weights_only=True))
    second.add(values[2])  # on the run's device, like those before the file
    assert second.means() == straight.means() == {"loss": 3}
