"""What the continuation of a run depends on besides weights and buffer, as tensors and plain containers."""

from __future__ import annotations

import time
import warnings
from typing import TYPE_CHECKING, Any

from torchrl.checkpoint import GlobalRNGState

from torchrl_etdmpc.envs import load_simulator_state

if TYPE_CHECKING:
    from torchrl_etdmpc.training.train import TrainingRun

_COUNTED = ("samples", "refreshed", "stale", "target_age")


def capture(run: TrainingRun) -> dict[str, Any]:
    """Random numbers, the place inside the episode and inside the run, and how long the log's files are."""
    reanalyze = None if run.reanalyze is None else {name: getattr(run.reanalyze, name) for name in _COUNTED}
    return {
        "collector": dict(run.collector.state_dict()),
        "sampler": run.replay.sampler.state_dict(),
        "reanalyze": reanalyze,
        "eval_simulator": run.eval_simulator,
        "log": run.log.state_dict(),
        "place": {
            "stage": run.stage,
            "pretrained": run.pretrained,
            "pending": list(run.pending),
            "eval_returns": list(run.eval_returns),
            "episode_returns": list(run.episode_returns),
            "metrics": dict(run.metrics),
            "wall_s": run.wall_s,
            "learning_s": run.learning_s,
            "best_saved": run.best_saved,
            "faults": [run.faults, run.faults_in_a_row],
        },
        "random": GlobalRNGState().state_dict(),
    }


def restore(run: TrainingRun, state: dict[str, Any]) -> None:
    """Brings a run back to where :func:`capture` was called; weights and buffer are restored already."""
    run.collector.load_state_dict(state["collector"])
    run.replay.sampler.load_state_dict(state["sampler"])
    if run.reanalyze is not None and state["reanalyze"] is not None:
        for name, value in state["reanalyze"].items():
            setattr(run.reanalyze, name, value)
    run.eval_simulator = state["eval_simulator"]
    if run.eval_simulator is not None and not load_simulator_state(run.eval_env, run.eval_simulator):
        warnings.warn("the evaluation environment did not come back to where it was.", stacklevel=2)
    run.log.load_state_dict(state["log"])
    place = state["place"]
    run.stage, run.pretrained, run.pending = place["stage"], place["pretrained"], list(place["pending"])
    run.eval_returns, run.episode_returns = list(place["eval_returns"]), list(place["episode_returns"])
    run.metrics = {name: value.to(run.device) for name, value in place["metrics"].items()}
    run.learning_s, run.best_saved = place["learning_s"], place["best_saved"]
    run.faults, run.faults_in_a_row = place["faults"]
    run.start = time.perf_counter() - place["wall_s"]
    GlobalRNGState().load_state_dict(state["random"])  # last: building the parts has drawn from them
