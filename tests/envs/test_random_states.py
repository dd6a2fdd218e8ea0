"""States of NumPy's generators as tensors."""

from __future__ import annotations

import numpy as np

from torchrl_etdmpc.envs.random_states import pack_mt19937, pack_pcg64, unpack_mt19937, unpack_pcg64


def test_a_random_state_goes_on_also_between_the_two_normal_numbers_of_a_pair():
    ours, theirs = np.random.RandomState(3), np.random.RandomState(4)
    ours.randn(5)
    theirs.set_state(unpack_mt19937(pack_mt19937(ours.get_state())))
    assert theirs.randn(4).tolist() == ours.randn(4).tolist()


def test_a_pcg64_goes_on_also_between_the_two_halves_of_a_number():
    ours, theirs = np.random.default_rng(3), np.random.default_rng(4)
    ours.random(5, dtype=np.float32)
    assert ours.bit_generator.state["has_uint32"] == 1
    theirs.bit_generator.state = unpack_pcg64(pack_pcg64(ours.bit_generator.state))
    assert theirs.random(4, dtype=np.float32).tolist() == ours.random(4, dtype=np.float32).tolist()
