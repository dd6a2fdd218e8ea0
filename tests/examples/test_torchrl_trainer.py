from __future__ import annotations

import runpy
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "torchrl_trainer.py"

pytest.importorskip("gymnasium")


def test_torchrl_s_trainer_trains_with_our_parts():
    example = runpy.run_path(str(EXAMPLE))
    planner = example["train"](total_frames=70, random_frames=40, slices=4)
    assert planner.world_model.version == 31  # one update per frame, from the last random one on
    assert -2000 < example["evaluate"](planner, seed=0, episodes=1) < 0
