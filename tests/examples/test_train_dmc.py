from __future__ import annotations

import csv
import hashlib
import importlib.util
import json
import re
import subprocess
from pathlib import Path

import pytest
import torch

pytest.importorskip("dm_control")
pytest.importorskip("hydra")

from torchrl_etdmpc.training import PRESETS, TrainConfig, preset, read_agent_file  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "examples" / "train_dmc.py"

# 40 seed decisions and 20 more; two evaluations of a whole episode each.
SMALL_RUN = (
    "task=cartpole-balance preset=cpu seed=3 device=cpu compile=off total_env_steps=120 log_every=20 eval_every=100000 "
    "eval_episodes=1 model.latent_dim=16 model.mlp_dim=16 model.encoder_dim=16 planner.horizon=2 planner.num_samples=8 "
    "planner.num_elites=4 planner.num_proposals=2 planner.iterations=1 reanalyze.num_samples=6 reanalyze.num_elites=3 "
    "reanalyze.iterations=1 optim.batch_size=4 replay.seed_decisions=40 replay.pretrain_updates=4"
).split()

PARTS = ("agent", "best", "collector", "sampler", "reanalyze", "learner", "log", "state", "random")


def file_hashes(directory: Path) -> dict[str, str]:
    files = (path for path in directory.rglob("*") if path.is_file())
    return {str(path.relative_to(directory)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, run_script) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """A small run, started in an empty directory like a user would."""
    directory = tmp_path_factory.mktemp("empty")
    return directory, run_script(SCRIPT, *SMALL_RUN, "run_dir=runs/first", cwd=directory)


def test_a_run_in_an_empty_directory_writes_everything_and_one_closing_line(finished):
    directory, process = finished
    assert process.returncode == 0, process.stderr
    run_dir = Path("runs", "first")
    expected = {
        "config.yaml",
        "train.csv",
        "eval.csv",
        "summary.json",
        "curve.png",
        "checkpoints/last.pt",
        "checkpoints/best.pt",
        *(f"checkpoints/resume/{step:012d}/{name}.pt" for name in PARTS for step in (0, 120)),
        *(f"checkpoints/resume/{step:012d}/manifest.json" for step in (0, 120)),
    }
    files = set(file_hashes(directory))
    replay = {name for name in files if name.startswith("runs/first/checkpoints/replay/")}
    assert files - replay == {str(run_dir / name) for name in expected}
    assert replay
    summary = json.loads((directory / run_dir / "summary.json").read_text())
    *progress, closing = process.stdout.splitlines()
    assert re.fullmatch(
        rf"cartpole-balance: return {summary['final_return']:.1f} after 120 env steps in \d+ s; "
        rf"curve, tables and checkpoint are in {re.escape(str(run_dir))}",
        closing,
    )
    assert all(re.match(r"\d\d:\d\d:\d\d \w", line) for line in progress)
    assert "\x1b" not in process.stdout + process.stderr
    assert "Storage" not in process.stdout  # TorchRL says that it made one
    assert sum(" of 120: return " in line for line in progress) == 2  # one per evaluation
    assert "Traceback" not in process.stderr
    assert "Warning" not in process.stderr


def test_the_files_of_a_run_agree_on_what_was_done(finished):
    run_dir = finished[0] / "runs" / "first"
    summary = json.loads((run_dir / "summary.json").read_text())
    assert (summary["task"], summary["preset"], summary["seed"]) == ("cartpole-balance", "cpu", 3)
    with (run_dir / "eval.csv").open(newline="") as file:
        evaluations = list(csv.DictReader(file))
    assert [row["env_steps"] for row in evaluations] == ["0", "120"]
    assert float(evaluations[-1]["return_mean"]) == summary["final_return"]
    assert 0 < summary["final_return"] <= 1000
    with (run_dir / "train.csv").open(newline="") as file:
        assert [row["env_steps"] for row in csv.DictReader(file)] == ["100", "120"]
    content = read_agent_file(run_dir / "checkpoints" / "last.pt")
    assert content["counters"]["env_steps"] == summary["env_steps"] == 120
    assert content["counters"]["updates"] == 4 + 20
    assert content["config"]["seed"] == 3


def test_the_overrides_arrive_and_the_preset_gives_the_rest(finished):
    yaml = pytest.importorskip("yaml")
    written = yaml.safe_load((finished[0] / "runs" / "first" / "config.yaml").read_text())
    config, base = TrainConfig.from_dict(written), preset("cpu")
    assert (config.model.latent_dim, config.planner.num_samples, config.replay.seed_decisions) == (16, 8, 40)
    assert config.run_dir == "runs/first"
    assert config.loss == base.loss
    assert config.reanalyze.every == base.reanalyze.every
    assert config.threads == base.threads


def test_a_finished_run_is_not_touched(finished, monkeypatch, run_here):
    directory, _ = finished
    monkeypatch.chdir(directory)
    before = file_hashes(directory)
    changed = "optim.batch_size=8 was asked for, but this run was started with optim.batch_size=4; "
    for typed, error, said in (
        ([], "error: run_dir=runs/first already holds a run; go on with resume=auto, choose another run_dir or", ""),
        (["resume=true", "optim.batch_size=8"], f"error: {changed}", ""),
        (["resume=auto"], "None", "runs/first is finished; nothing to do\n"),
    ):
        message, out, err = run_here("train_dmc.py", *SMALL_RUN, "run_dir=runs/first", *typed)
        assert str(message).startswith(error)
        assert (out[-len(said) :] if said else out, err) == (said, "")
        assert file_hashes(directory) == before


# Runs the script where neither of these packages is installed.
WITHOUT = """
import importlib.machinery, runpy, sys
find = importlib.machinery.PathFinder.find_spec
missing = sys.argv[1].split()
importlib.machinery.PathFinder.find_spec = staticmethod(
    lambda name, path=None, target=None: None if name.split(".")[0] in missing else find(name, path, target))
sys.argv = sys.argv[2:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def test_a_process_without_the_extras_names_the_first_that_it_needs_in_one_line(tmp_path, run_process):
    process = run_process("-c", WITHOUT, "hydra dm_control", str(SCRIPT), *SMALL_RUN, cwd=tmp_path)
    assert (process.returncode, process.stdout) == (1, "")
    assert process.stderr == "error: this command needs hydra-core; run: pip install 'hydra-core>=1.3,<1.4'\n"
    assert list(tmp_path.iterdir()) == []


def test_a_missing_simulator_is_named_in_one_line(tmp_path, monkeypatch, run_here):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "dm_control" else find_spec(name, *rest)
    )
    error, *printed = run_here("train_dmc.py", *SMALL_RUN)
    assert error.startswith("error: dm_control tasks need dm-control, which is missing; run: pip install ")
    assert printed == ["", ""]
    assert list(tmp_path.iterdir()) == []


# One of every way on which a mistake is found; what each setting refuses is in tests/training/test_config.py.
REFUSED = [
    ("task=walker-wlak", "unknown task 'walker-wlak'; did you mean walker-walk, "),
    ("task=null", "task must be of type str, got None."),
    ("task=gym/Pendulum-v1", "train_dmc.py knows the 28 DMC tasks, not 'gym/Pendulum-v1'; use examples/train.py."),
    ("task=nowhere:make", "task 'nowhere:make': there is no module 'nowhere' on Python's path or in "),
    ("preset=fast", f"unknown preset 'fast'; choose one of {', '.join(PRESETS)}."),
    ("planner.horizn=3", "unknown setting planner.horizn; did you mean planner.horizon"),
    ("planner.horizon=three", "planner.horizon must be of type int, got 'three'."),
    ("planner.horizon=0", "planner.horizon must be at least 1, got 0."),
    ("workers=2", "unknown setting workers; the command distributed has it."),
    ("resume=true", "run_dir=runs/walker-walk/efficient-tdmpc/seed1 holds no run to go on with; start it with "),
    ("device=cuda", "device=cuda needs a CUDA device and this PyTorch sees none; use device=cpu or device=auto."),
    ("run_dir=taken/run", "run_dir=taken/run cannot be written (Not a directory); choose a directory that you can "),
]


@pytest.mark.parametrize(("argument", "message"), REFUSED, ids=[argument for argument, _ in REFUSED])
def test_a_bad_input_ends_in_one_line_and_leaves_nothing_behind(tmp_path, monkeypatch, run_here, argument, message):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    if argument == "run_dir=taken/run":
        (tmp_path / "taken").write_text("a file, not a folder")
    before = file_hashes(tmp_path)
    error, out, err = run_here("train_dmc.py", argument)
    assert isinstance(error, str)  # Python prints it on stderr and exits with 1
    assert error.startswith(f"error: {message}")
    assert (error.count("\n"), out, err) == (0, "", "")
    assert file_hashes(tmp_path) == before
    assert all(path.is_file() for path in tmp_path.iterdir())


def test_a_traceback_is_shown_on_request(tmp_path, monkeypatch, run_here):
    assert run_here("train_dmc.py", "planner.horizon=0")[0].startswith("error: planner.horizon")
    monkeypatch.setenv("TORCHRL_ETDMPC_TRACEBACK", "1")
    with pytest.raises(ValueError, match=r"^planner\.horizon must be at least 1, got 0\.$"):
        run_here("train_dmc.py", "planner.horizon=0")
    assert list(tmp_path.iterdir()) == []
