from __future__ import annotations

import threading

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium")

from torchrl_etdmpc.envs import get_task  # noqa: E402
from torchrl_etdmpc.inspector import Cancelled, play_episode, trace_plan, with_settings  # noqa: E402
from torchrl_etdmpc.inspector.inspection import KEPT, Inspection, Job, State  # noqa: E402
from torchrl_etdmpc.modules import WorldModel  # noqa: E402
from torchrl_etdmpc.planners import EnsembleMPPIPlanner, LatentEnv  # noqa: E402

TASK = get_task("gym/Pendulum-v1")


def make(**settings) -> EnsembleMPPIPlanner:
    torch.manual_seed(0)
    model = WorldModel(3, 1, latent_dim=16, mlp_dim=16, num_dynamics=2)
    budget = {"horizon": 3, "num_samples": 16, "num_elites": 4, "num_proposals": 2, "iterations": 2}
    return EnsembleMPPIPlanner(LatentEnv(model), **budget | settings)


@pytest.fixture
def inspection():
    made = Inspection(make(), TASK, steps=6, about={"checkpoint": {"name": "agent.pt"}})
    yield made
    made.close()


def test_a_state_of_an_episode_is_planned_as_it_was_played(inspection):
    trace = inspection.plan(State(episode=4, step=3), {"horizon": 2})
    episode = play_episode(make(), TASK, seed=4, steps=6)
    planner = with_settings(make(), horizon=2)
    expected = trace_plan(planner, episode.observation[3], plan_mean=episode.plan_mean[3])
    for name in ("scores", "points", "action"):
        assert np.array_equal(trace[name], expected[name]), name
    assert trace.manifest["state"] == {"from": "episode", "seed": 4, "step": 3}
    assert trace.manifest["checkpoint"] == {"name": "agent.pt"}
    assert inspection.length(4) == 6


def test_the_plan_is_rolled_in_the_simulator_from_the_restored_state(inspection):
    trace = inspection.plan(State(episode=0, step=2), {"eval_first_action": "best"})
    assert trace["real_rewards"].shape == (3,)
    assert trace["frames"].shape == (4, 160, 160, 3)
    assert trace.manifest["notes"] == []
    strip = inspection.strip(0)
    assert strip.steps == [0, 1, 2, 3, 4, 5]
    assert np.array_equal(strip.frames[2], trace["frames"][0])  # the same place
    again = inspection.plan(State(episode=0, step=2))
    assert np.array_equal(again["real_rewards"], trace["real_rewards"])


def test_a_machine_that_cannot_render_says_so_in_one_sentence(monkeypatch, inspection):
    def no_renderer(*args, **kwargs):
        raise RuntimeError("cannot render: there is no display; set MUJOCO_GL=egl before Python starts.")

    monkeypatch.setattr("torchrl_etdmpc.inspector.episodes.render_frame", no_renderer)
    trace = inspection.plan(State(0, 1))
    assert inspection.strip(0).frames == []
    assert trace.get("frames") is None
    assert trace["real_rewards"].shape == (3,)
    (note,) = trace.manifest["notes"]
    assert note.startswith("There are no frames: cannot render: there is no display; set MUJOCO_GL=egl")


def test_a_state_that_cannot_be_restored_leaves_the_plan(monkeypatch, inspection):
    inspection.plan(State(0, 1))

    def lost(self, state):
        raise ValueError("state cannot be restored exactly")

    monkeypatch.setattr("torchrl_etdmpc.inspector.inspection.Simulator.restore", lost)
    trace = inspection.plan(State(0, 2))
    assert trace.get("real_rewards") is None
    assert trace.manifest["notes"] == ["The plan was not rolled in the simulator: state cannot be restored exactly."]


def test_rows_of_a_replay_buffer_have_no_simulator_and_the_page_says_why():
    rows = torch.randn(5, 3)
    inspection = Inspection(make(), TASK, replay=lambda row: rows[row], rows=5)
    trace = inspection.plan(State(0, 4, replay=True))
    assert np.array_equal(trace["observation"], rows[4].numpy())
    assert trace.get("real_rewards") is None and trace.get("frames") is None
    note, cold = trace.manifest["notes"]
    assert cold == "Planned without a warm start: a row of the replay buffer holds no plan of the decision before."
    assert note.startswith("There are no frames, and the plan is not rolled in the simulator: a row of the replay")
    with pytest.raises(ValueError, match=r"the row must be in \[0, 5\), the rows of the replay buffer, got 5"):
        inspection.plan(State(0, 5, replay=True))
    inspection.close()


@pytest.mark.parametrize(
    ("state", "changes", "message"),
    [
        (State(0, 6), {}, r"the step must be in \[0, 6\), the decisions of episode 0, got 6"),
        (State(0, 0, replay=True), {}, "this checkpoint has none beside it"),
        (State(0, 0), {"num_elites": 40}, "num_elites must be at most num_samples=16, got 40"),
    ],
)
def test_a_state_or_a_setting_that_cannot_be_is_one_line(inspection, state, changes, message):
    with pytest.raises(ValueError, match=message):
        inspection.plan(state, changes)


def test_a_plan_can_be_given_up_and_another_one_gives_it_up(inspection):
    inspection.plan(State(0, 0))
    waiting, go_on = threading.Event(), threading.Event()

    def slow(returns):
        waiting.set()
        go_on.wait(10)
        return returns.mean((-3, -2, -1))

    job = inspection.start(State(0, 0), {"score": slow})
    assert waiting.wait(10)
    assert not job.wait(0)
    following = inspection.start(State(0, 1), {})
    go_on.set()
    assert following.wait(10) and job.wait(10)
    with pytest.raises(Cancelled):
        job.future.result()
    assert inspection.traces[following.future.result()].manifest["state"]["step"] == 1


def test_a_trace_that_others_are_drawn_like_is_kept(inspection):
    job = inspection.start(State(0, 0), {})
    assert job.wait(10)
    held = job.future.result()
    *_, last = (inspection.plan(State(0, 0), like=held, seed=seed) for seed in range(20))  # more than are kept
    assert held in inspection.traces
    assert len(inspection.traces) == KEPT
    assert np.array_equal(last["basis"], inspection.traces[held]["basis"])


def test_a_played_episode_is_told_by_its_decisions(inspection, monkeypatch):
    told = []
    monkeypatch.setattr(Job, "tell", lambda job, done, of: told.append((job.what, done, of)))
    inspection.plan(State(3, 0))
    played = [(done, of) for what, done, of in told if what == "playing episode 3"]
    assert played == [(iteration // 2, 6) for iteration in range(1, 13)]  # two for a decision


def test_a_closed_inspection_leaves_no_simulator_open():
    inspection = Inspection(make(), TASK, steps=2)
    inspection.plan(State(0, 0))
    env = inspection.simulator.env
    inspection.close()
    assert env.is_closed


def test_an_episode_can_be_played_by_the_policy():
    inspection = Inspection(make(), TASK, steps=3, bare=True)
    trace = inspection.plan(State(0, 2))
    assert not trace["warm_start"].any()
    cold = "Planned without a warm start: the bare policy, which played, makes no plan of the decision before."
    assert trace.manifest["notes"][-1] == cold
    assert cold not in inspection.plan(State(0, 2), {"warm_start": False}).manifest["notes"]
    inspection.close()


@pytest.mark.parametrize(("step", "left"), [(2, 3), (3, 2), (4, 1)])
def test_a_plan_is_rolled_up_to_the_time_limit(step, left):
    inspection = Inspection(make(), get_task("gym/Pendulum-v1", episode_length=5))
    trace = inspection.plan(State(0, step))
    assert inspection.length(0) == 5
    assert trace["chosen_actions"].shape == (3, 1)
    assert trace["real_rewards"].shape == (left,)
    assert trace["real_points"].shape == (left + 1, 3)
    inspection.close()
