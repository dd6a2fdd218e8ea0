from __future__ import annotations

from torchrl_etdmpc.testing import random_slices


def test_no_entry_of_random_slices_changes_with_another():
    slices = random_slices(3, 2)
    before = slices.clone()
    for key in slices.keys(True, True):
        slices[key].zero_()
        before[key].zero_()
        assert (slices == before).all(), key
