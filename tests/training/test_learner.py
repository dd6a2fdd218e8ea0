from __future__ import annotations

import contextlib
import math

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import StepCounter, Transform

pytest.importorskip("dm_control")

from torchrl_etdmpc.collectors import SimulatorError  # noqa: E402
from torchrl_etdmpc.planners import FunctionScore  # noqa: E402

EPISODE = 20  # decisions, of every run here


class AtSomeSteps(Transform):
    """Calls ``act`` on what comes after some of the environment's steps, counted from 1."""

    def __init__(self, act, *steps: int) -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.act, self.steps, self.calls = act, steps, 0

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.calls += 1
        if self.calls in self.steps:
            self.act(next_tensordict)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset


def crash(after: TensorDictBase) -> None:
    raise RuntimeError("the physics is invalid")


def terminate(after: TensorDictBase) -> None:
    for name in ("terminated", "done"):
        after[name] = torch.ones_like(after[name])


@pytest.mark.parametrize(
    ("num_envs", "interval", "passed"),
    [
        (1, 6, [6, 12, 18]),
        (1, 7, [8, 14]),  # an environment step is half a decision
        (3, 6, [6, 12, 18]),
        (3, 8, [12, 18]),  # 8 is jumped over, and so is 16
        (3, 4, [6, 12, 18]),  # two of them at once are one
        (3, 100, []),
    ],
)
def test_a_step_of_all_environments_passes_every_interval_that_ends_in_it(
    tmp_path, num_envs, interval, passed, tiny_config, make_run
):
    learner = make_run(tiny_config(num_envs=num_envs), tmp_path).learner
    found = []
    while learner.env_steps < 18:
        learner.step()
        if learner.passed(interval):
            found.append(learner.env_steps)
    assert found == passed


def test_failures_count_in_a_row_until_an_episode_is_finished(tmp_path, tiny_config, make_run):
    # Steps between two failures are not enough, or a task that breaks off in every episode would go on for ever.
    learner = make_run(tiny_config(max_faults=3), tmp_path, AtSomeSteps(crash, 5, 12, 33, 40, 47)).learner
    counts = []
    with pytest.warns(UserWarning, match="the physics is invalid"):
        for _ in range(46):
            learner.step()
            counts.append(learner.faults_in_a_row)
        with pytest.raises(SimulatorError):
            learner.step()
    # Two without an end in between, then the end of an episode (20 steps after the second failure), and two again.
    assert counts == [0] * 4 + [1] * 7 + [2] * 20 + [0] + [1] * 7 + [2] * 7
    assert (learner.faults, learner.faults_in_a_row) == (5, 3)


def test_a_row_is_the_mean_over_its_interval(tmp_path, tiny_config, make_run):
    learner = make_run(tiny_config(), tmp_path).learner
    for _ in range(30):
        learner.step()
    list(learner.pretrain())
    recorded, update = [], learner.agent.updater.step

    def watched(batch: TensorDictBase, *, distill: bool) -> TensorDictBase:
        recorded.append({name: value.item() for name, value in update(batch, distill=distill).items()})
        return recorded_tensors(recorded[-1])

    learner.agent.updater.step = watched
    for updates in (6, 2):
        for _ in range(updates // 2):
            learner.step(updates=True)
        row = learner.pop_row()
        assert len(recorded) == updates
        means = {name: sum(values[name] for values in recorded) / updates for name in recorded[0]}
        assert {name: row[name] for name in means} == pytest.approx(means, rel=1e-6)
        assert {"loss_value", "loss_policy", "grad_norm_model", "policy_kl"} <= means.keys()
        if updates > 2:
            assert row["loss_value"] != pytest.approx(recorded[-1]["loss_value"])
        recorded.clear()


def recorded_tensors(values: dict[str, float]) -> dict[str, torch.Tensor]:
    return {name: torch.tensor(value) for name, value in values.items()}


def test_a_row_counts_the_planned_decisions_whose_plan_fell_back(tmp_path, tiny_config, make_run):
    learner = make_run(tiny_config(num_envs=2, reanalyze={"every": 0}), tmp_path).learner
    learner.step()  # of the random phase: not planned
    for _ in range(15):
        learner.step()
    score, broken = learner.agent.planner.score, [0]

    def score_without_number(returns: torch.Tensor) -> torch.Tensor:
        scores = score(returns)
        if broken[0]:
            scores[: broken[0]] = torch.nan
        return scores

    learner.agent.planner.score = FunctionScore(score_without_number)
    shares = []
    for plans in ([0, 1, 2, 0], [2], [0, 0]):  # environments whose plan falls back
        for number in plans:
            broken[0] = number
            learner.step(updates=True)
        said = pytest.warns(UserWarning, match="^no plan since the last row had finite scores, so the pol")
        with said if plans == [2] else contextlib.nullcontext():
            row = learner.pop_row()
        shares.append(row["plan_fallbacks"])
    assert shares == [3 / 8, 1, 0]
    assert not [name for name in row if name.startswith("target")]  # nothing is reanalyzed
    assert ("plan", "fallback") not in learner.replay[:].keys(True, True)


@pytest.mark.parametrize("reward", [50.0, 60.0, -60.0])
def test_rewards_that_the_bins_cannot_say_are_told_once(tmp_path, reward, tiny_config, make_run, user_warnings):
    def pay(after: TensorDictBase) -> None:
        after["reward"] = torch.full_like(after["reward"], reward)

    config = tiny_config(model={"bin_min": -4.0, "bin_max": 4.0})  # to e^4 - 1
    learner = make_run(config, tmp_path, AtSomeSteps(pay, 3, 4)).learner
    said = pytest.warns(UserWarning, match=r"^rewards lie outside \[-53\.6, 53\.6\], all that the bins can say")
    with said if abs(reward) > 53.6 else contextlib.nullcontext() as warned:
        for _ in range(5):
            learner.step()
    assert warned is None or len(user_warnings(warned)) == 1


def test_value_targets_that_the_bins_cannot_say_are_told(tmp_path, tiny_config, make_run):
    def pay(after: TensorDictBase) -> None:
        after["reward"] = torch.full_like(after["reward"], 50.0)  # one is within, two are not

    config = tiny_config(model={"bin_min": -4.0, "bin_max": 4.0}, loss={"value_replayed": 1.0})
    learner = make_run(config, tmp_path, AtSomeSteps(pay, *range(1, 40))).learner
    for _ in range(30):
        learner.step()
    learner.step(updates=True)
    with pytest.warns(UserWarning, match=r"^value targets lie outside"):
        assert learner.pop_row()["value_target"] > 53.6


def test_the_return_in_a_row_is_that_of_the_episodes_that_ended_in_it(tmp_path, tiny_config, make_run):
    learner = make_run(tiny_config(num_envs=2, total_env_steps=400), tmp_path).learner
    returns = []
    for steps in (EPISODE, EPISODE // 2, EPISODE):
        for _ in range(steps):
            learner.step()
        returns.append(learner.pop_row()["episode_return"])
    rewards = learner.replay[:]["next", "reward"].reshape(-1, 2)  # by step and environment
    assert returns[0] == pytest.approx(rewards[:EPISODE].sum(0).mean().item())
    assert math.isnan(returns[1])
    assert returns[2] == pytest.approx(rewards[EPISODE : 2 * EPISODE].sum(0).mean().item())


def test_a_task_that_terminates_although_it_is_said_not_to_is_an_error(tmp_path, tiny_config, make_run):
    learner = make_run(tiny_config(), tmp_path, AtSomeSteps(terminate, 7)).learner
    for _ in range(6):
        learner.step()
    expected = (
        "an episode of cartpole-balance terminated, but the task is said never to; say task.terminates=true "
        "(model.termination=false to bootstrap through its ends)."
    )
    with pytest.raises(ValueError) as caught:
        learner.step()
    assert str(caught.value) == expected


@pytest.mark.parametrize("num_envs", [1, 3])
def test_first_episodes_that_are_cut_before_the_told_limit_are_told_once(
    tmp_path, num_envs, tiny_config, make_run, user_warnings
):
    config = tiny_config(num_envs=num_envs, total_env_steps=160 * num_envs)
    learner = make_run(config, tmp_path, StepCounter(8)).learner
    for _ in range(7):
        learner.step()
    expected = (
        "an episode of cartpole-balance was truncated within its first 16 env steps, but its time limit is said to be "
        "40, by which the discount is chosen; if it is shorter, say so (task.episode_length)."
    )
    with pytest.warns(UserWarning) as told:
        learner.step()
    assert user_warnings(told) == [expected]
    for _ in range(40):  # with warnings as errors
        learner.step()


def test_an_episode_of_full_length_is_not_told(tmp_path, tiny_config, make_run):
    learner = make_run(tiny_config(), tmp_path).learner
    for _ in range(2 * EPISODE):  # with warnings as errors
        learner.step()
    assert learner.replay[:]["next", "truncated"].flatten().nonzero().flatten().tolist() == [19, 39]


def test_no_limit_is_told_where_the_discount_does_not_follow_from_it(tmp_path, tiny_config, make_run):
    learner = make_run(tiny_config(loss={"discount": 0.9}), tmp_path, StepCounter(8)).learner
    for _ in range(8):  # with warnings as errors
        learner.step()


@pytest.mark.parametrize(("termination", "head"), [(None, True), (False, False)])
def test_a_task_that_terminates_is_trained_on_with_a_head_or_without(
    tmp_path, termination, head, tiny_config, make_run, read_table
):
    config = tiny_config(terminates=True, model={"termination": termination}, total_env_steps=100, eval_every=1000)
    ends = 7, 12, 25, 33, 41  # of the environment's steps
    run = make_run(config, tmp_path, AtSomeSteps(terminate, *ends))
    run.run()
    rows = run.learner.replay[:]
    assert (rows["next", "terminated"].flatten().nonzero().flatten() + 1).tolist() == list(ends)
    assert rows["collector", "traj_ids"].max() >= len(ends)
    assert run.learner.agent.updater.updates == 7 + 2 * 20
    assert all(parameter.isfinite().all() for parameter in run.learner.agent.world_model.parameters())
    assert ("loss_termination" in read_table(tmp_path / "train.csv")[0]) is head


def test_the_counts_of_a_learner_are_its_state(tmp_path, tiny_config, make_run):
    learner, other = (make_run(tiny_config(), tmp_path / name).learner for name in ("one", "other"))
    state = {"pretrained": 3, "faults": 5, "faults_in_a_row": 2}
    means = {
        "updates": {"sums": [(["loss"], torch.tensor([6.0]), 3)]},
        "decisions": {"sums": [(["episode_return"], torch.tensor([8.0]), 2)]},
    }
    learner.load_state_dict(state | means)
    other.load_state_dict(learner.state_dict())
    assert {name: other.state_dict()[name] for name in state} == state
    for _ in range(10):
        other.step()
    row = other.pop_row()
    assert (row["loss"], row["episode_return"], row["simulator_faults"]) == (2, 4, 5)
    assert math.isnan(row["target_age"])  # a column of every row, though nothing is reanalyzed yet
    assert len(list(other.pretrain())) == 7 - 3


@pytest.mark.parametrize(("hold", "different"), [(1.0, 4), (1e9, 1)])
def test_the_random_phase_holds_its_actions_as_long_as_it_is_said(tmp_path, hold, different, tiny_config, make_run):
    learner = make_run(tiny_config(replay={"seed_hold": hold}), tmp_path).learner
    for _ in range(4):
        learner.step()
    assert len(learner.replay.storage[:]["action"].unique(dim=0)) == different
