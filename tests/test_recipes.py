"""How to add to the package: each recipe is one new piece and at most one further line."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_etdmpc import EfficientTDMPCLoss, EnsembleMPPIPlanner, LatentEnv, WorldModel
from torchrl_etdmpc.envs import Task, import_task, make_env, register_task
from torchrl_etdmpc.objectives import LatentRollout, Slices, Term
from torchrl_etdmpc.planners import make_score
from torchrl_etdmpc.runs import RunDirectory, RunLog
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import TrainConfig, TrainingRun, Updater, load_agent


class PointOnALine(EnvBase):
    """The action moves a point; the reward is how near it is to zero."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        super().__init__(device=device)
        self.observation_spec = Composite(observation=Unbounded((2,)))
        self.action_spec = Bounded(-1, 1, (1,))
        self.reward_spec = Unbounded((1,))
        self.full_done_spec = Composite(
            {name: Binary(1, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        )
        self.generator = torch.Generator().manual_seed(0)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(0 if seed is None else seed)

    def _flags(self, truncated: bool) -> dict[str, Tensor]:
        flags = {"done": truncated, "terminated": False, "truncated": truncated}
        return {name: torch.tensor([flag]) for name, flag in flags.items()}

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDict:
        self.position, self.steps = 2 * torch.rand(1, generator=self.generator) - 1, 0
        return TensorDict({"observation": torch.cat([self.position, torch.zeros(1)])} | self._flags(False))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.position, self.steps = self.position + 0.2 * tensordict["action"], self.steps + 1
        observation = torch.cat([self.position, torch.tensor([self.steps / 20])])
        values = {"observation": observation, "reward": 1 - self.position.abs()}
        return TensorDict(values | self._flags(self.steps == 20))


def make_point(task: Task, *, device: torch.device | str) -> EnvBase:
    return PointOnALine(device)


POINT = Task("point-on-a-line", "my suite", episode_length=20, terminates=False)


@pytest.fixture(autouse=True)
def _task() -> None:
    register_task(POINT, make_point)


def tiny_run(run_dir: Path, *, resume: bool = False, **changes: Any) -> TrainingRun:
    """A run of 40 decisions with networks and planners that cost next to nothing."""
    planner = {"horizon": 2, "num_samples": 6, "num_elites": 3, "num_proposals": 1, "iterations": 1}
    values: dict[str, Any] = {
        **{"task": POINT.name, "preset": "cpu", "compile": "off", "total_env_steps": 40, "eval_episodes": 1},
        **{"eval_every": 20, "checkpoint_every": 10, "log_every": 10},
        "model": {"latent_dim": 8, "mlp_dim": 8, "encoder_dim": 8, "num_dynamics": 2},
        "planner": planner,
        "reanalyze": {**planner, "every": 2, "num_slices": 2},
        "optim": {"batch_size": 4},
        "replay": {"seed_decisions": 20, "pretrain_updates": 2},
    }
    config = TrainConfig.from_dict(values | changes)
    torch.manual_seed(1 if resume else 0)
    directory = RunDirectory(run_dir)
    log = RunLog(directory, total_env_steps=config.total_env_steps)
    env, eval_env = make_env(config.task_spec, seed=0), make_env(config.task_spec)
    run = TrainingRun(config, env=env, eval_env=eval_env, log=log)
    directory.go_on() if resume else directory.begin(config.to_dict())
    return run


# A new task: a maker, and one line that registers it.


def test_a_new_task(tmp_path):
    register_task(POINT, make_point)
    summary = tiny_run(tmp_path / "run").run()
    assert (summary["task"], summary["env_steps"]) == (POINT.name, 40)
    assert -20 < summary["final_return"] <= 20
    _, config, _ = load_agent(tmp_path / "run" / "checkpoints" / "last.pt")
    assert config.task_spec == POINT


def test_a_new_task_in_a_file_of_one_s_own(tmp_path, monkeypatch):
    # The same from the command line: task=my_tasks:make_point task.terminates=false
    monkeypatch.setitem(sys.modules, "my_tasks", sys.modules[__name__])
    task = import_task("my_tasks:PointOnALine", episode_length=20, terminates=False)
    summary = tiny_run(tmp_path / "run", task=task.name).run()
    assert (summary["task"], summary["env_steps"]) == ("my_tasks:PointOnALine", 40)


# A new content of the checkpoint: an object with a state_dict, and one line that enters it among the parts.


@dataclasses.dataclass
class Diary:
    """Something that a run should go on from."""

    rewards: list[float] = dataclasses.field(default_factory=list)

    def state_dict(self) -> dict[str, Any]:
        return {"rewards": list(self.rewards)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.rewards = list(state_dict["rewards"])


def with_diary(run: TrainingRun) -> Diary:
    run.parts["diary"] = diary = Diary()
    finish_step = run.learner.collector.finish_step

    def noted(acted: TensorDictBase) -> TensorDictBase:
        stepped = finish_step(acted)
        diary.rewards.append(stepped["next", "reward"].item())
        return stepped

    run.learner.collector.finish_step = noted
    return diary


class Killed(BaseException):
    pass


def test_a_new_content_of_the_checkpoint(tmp_path):
    straight = tiny_run(tmp_path / "straight")
    expected = with_diary(straight)
    straight.run()
    assert len(expected.rewards) == 40

    run = tiny_run(tmp_path / "run")
    with_diary(run)
    act, calls = run.learner.collector.act, iter(range(35))

    def killed_at_last() -> TensorDictBase:
        if next(calls, None) is None:
            raise Killed
        return act()

    run.learner.collector.act = killed_at_last
    with pytest.raises(Killed):
        run.run()
    run.log.directory.close()
    resumed = tiny_run(tmp_path / "run", resume=True)
    diary = with_diary(resumed)
    with pytest.warns(UserWarning, match="fresh episodes begin"):  # this simulator has no state of its own
        resumed.checkpoints.restore()
    assert diary.rewards == expected.rewards[:30]  # the last checkpoint; the rest is done again
    resumed.run()
    assert len(diary.rewards) == 40


def test_a_checkpoint_without_the_new_content_says_so(tmp_path):
    run = tiny_run(tmp_path / "run")
    run.learner.step()
    run.checkpoints.save()
    run.log.directory.close()
    resumed = tiny_run(tmp_path / "run", resume=True)
    with_diary(resumed)
    with pytest.raises(RuntimeError, match=r"^cannot resume: .* lacks diary\. Start a new run;"):
        resumed.checkpoints.restore()


# A new score: a function of the return table.


def worst_head(returns: Tensor) -> Tensor:
    """The mean over depths of the most pessimistic pair of heads, ``[..., D, F, V]`` to ``[...]``."""
    return returns.mean(-3).amin((-2, -1))


def test_a_new_score(tmp_path):
    model = WorldModel(3, 1, latent_dim=8, mlp_dim=8)
    torch.nn.init.normal_(model.value_head.output.weight)  # new heads are 0, where every score is the same
    planner = EnsembleMPPIPlanner(LatentEnv(model), horizon=2, score=worst_head)
    trace = planner.plan(torch.zeros(1, 3), trace=True).trace
    assert torch.equal(trace.scores, worst_head(trace.returns))

    run, calls = tiny_run(tmp_path / "run"), []
    run.learner.agent.planner.score = make_score(lambda returns: calls.append(1) or worst_head(returns))
    run.run()
    assert len(calls) == 20  # once for every planned decision


# A new term of the loss without a network of its own: a function, and one entry of extra_terms.


def calm_policy(world_model: WorldModel, slices: Slices, rollout: LatentRollout) -> Tensor:
    """Squared mean action in the predicted latents, ``[T, B]``."""
    mean, _ = world_model.policy(rollout.predicted[:-1].detach())  # [T, F, B, A]
    return mean.square().mean((1, -1))


def test_a_new_loss_term():
    sizes = []
    for coef in (0.0, 100.0):
        torch.manual_seed(0)
        model = WorldModel(3, 2, latent_dim=16, mlp_dim=16, encoder_dim=16)
        terms = [Term("calm", calm_policy, coef)]
        updater = Updater(EfficientTDMPCLoss(model, discount=0.99, extra_terms=terms), lr=1e-2)
        batch = random_slices(3, 2, num_slices=8)
        for _ in range(30):
            metrics = updater.step(batch)
        assert metrics["loss_calm"].isfinite()
        sizes.append(metrics["calm_error"].item())
    assert sizes[1] < sizes[0] / 2
