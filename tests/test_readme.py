"""The README's code runs as it is printed, and what it names exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from torchrl_etdmpc.training import PRESETS

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.filterwarnings("ignore:.*auto_register_policy_transforms.*:FutureWarning")
def test_the_pipeline_of_the_readme_runs_and_trains_the_planner_s_own_weights():
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    torch.manual_seed(0)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    assert int(names["world_model"].version) == 200
    assert all(value.isfinite().all() for value in names["terms"].values())
    assert names["planner"].world_model is names["world_model"]
    assert len(names["buffer"]) == 200
    assert names["buffer"][:]["plan", "version"].max() > 0


def test_the_table_of_presets_is_the_code_s():
    rows = re.findall(
        r"^\| `([a-z0-9-]+)`[^|]*\| (\d) \| (\d), [a-z ]+\| (\d) \| (\d+) \| every (\w+) \|$", README, re.M
    )
    assert {row[0] for row in rows} == set(PRESETS)
    for name, heads, horizon, updates, every, insertion in rows:
        config = PRESETS[name]
        assert (config.model.num_dynamics, config.planner.horizon) == (int(heads), int(horizon))
        assert (config.optim.updates_per_decision, config.reanalyze.every) == (int(updates), int(every))
        assert config.replay.insertion == insertion


def test_every_file_that_the_readme_links_exists():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if not link.startswith("http")]
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []
