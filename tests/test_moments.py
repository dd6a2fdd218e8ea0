"""``benchmarks/moments.py`` on a run that was just made."""

from __future__ import annotations

import csv
import runpy
from pathlib import Path

import pytest

from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.training import TrainConfig, launch, preset

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks" / "moments.py"
SMALL = {
    "task": "cartpole-balance",
    "device": "cpu",
    "threads": 1,
    "compile": "off",
    "total_env_steps": 300,
    "episode_length": 100,
    "eval_every": 100,
    "eval_episodes": 2,
    "model": {"latent_dim": 16, "mlp_dim": 16, "encoder_dim": 16},
    "planner": {"horizon": 2, "num_samples": 8, "num_elites": 4, "num_proposals": 2, "iterations": 1},
    "reanalyze": {"num_samples": 6, "num_elites": 3, "iterations": 1},
    "optim": {"batch_size": 4},
    "replay": {"seed_decisions": 40, "pretrain_updates": 4},
}


def train(run_dir: Path, **changes: object) -> None:
    values = preset("cpu").to_dict()
    for name, value in (SMALL | {"run_dir": str(run_dir)} | changes).items():
        values[name] = values[name] | value if isinstance(value, dict) else value
    launch(TrainConfig.from_dict(values))


def test_a_run_is_evaluated_from_moment_to_moment_and_stays_as_it_is(tmp_path, monkeypatch):
    train(tmp_path / "run")
    files = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    script = runpy.run_path(str(SCRIPT))
    monkeypatch.setattr("sys.argv", [
        "moments.py", str(tmp_path / "run"), "--every", "50", "--times", "4", "--out", str(tmp_path / "moments.csv"),
    ])  # fmt: skip
    script["main"]()
    with open(tmp_path / "moments.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["env_steps"] for row in rows] == ["300", "350", "400", "450", "500"]
    with open(RunDirectory(tmp_path / "run").eval, newline="", encoding="utf-8") as file:
        last = list(csv.DictReader(file))[-1]
    # The weights of the checkpoint, in the episodes that the run played; the averages begin with them.
    assert {rows[0][name] for name in script["COLUMNS"][1:4]} == {f"{float(last['return_mean']):.0f}"}
    assert any(row["in training"] for row in rows)
    assert all(row["policy"] for row in rows)
    assert len({row["average 0.98"] for row in rows}) > 1
    assert {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()} == files


def test_what_cannot_be_gone_on_with_is_one_line(tmp_path, monkeypatch):
    script = runpy.run_path(str(SCRIPT))
    monkeypatch.setattr("sys.argv", ["moments.py", str(tmp_path)])
    with pytest.raises(SystemExit, match="is not the directory of a run"):
        script["main"]()
    monkeypatch.setattr("sys.argv", ["moments.py", str(tmp_path), "--times", "0"])
    with pytest.raises(SystemExit, match="--every and --times must be at least 1"):
        script["main"]()
    train(tmp_path / "averaged", optim=SMALL["optim"] | {"average_decay": 0.9})
    monkeypatch.setattr("sys.argv", ["moments.py", str(tmp_path / "averaged")])
    with pytest.raises(SystemExit, match="plans with averaged weights already"):
        script["main"]()
