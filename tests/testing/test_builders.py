from __future__ import annotations

import pytest
import torch

from torchrl_etdmpc.testing import random_slices


@pytest.mark.parametrize(("terminated", "ends"), [(False, 0), (True, 2)])
def test_steps_follow_each_other_and_half_of_the_slices_terminate_at_their_end_if_asked(terminated, ends):
    slices = random_slices(3, 2, num_slices=4, slice_len=3, terminated=terminated)
    assert torch.equal(slices["next", "observation"][:, :-1], slices["observation"][:, 1:])
    for flag in ("terminated", "done"):
        assert slices["next", flag].sum((0, 2)).tolist() == [0, 0, ends]


def test_no_entry_of_random_slices_changes_with_another():
    slices = random_slices(3, 2)
    before = slices.clone()
    for key in slices.keys(True, True):
        slices[key].zero_()
        before[key].zero_()
        assert (slices == before).all(), key
