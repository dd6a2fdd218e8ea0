"""``inspect_planner``: what the planner of a trained agent sees, on a page in the browser or saved as files."""

from __future__ import annotations

import contextlib
import importlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from torchrl_etdmpc.checkpoints import CheckpointError, CheckpointStore
from torchrl_etdmpc.commands import begin_without_renderer, renderer_is_a_guess
from torchrl_etdmpc.commands.agent_command import PlannerCommandConfig, with_the_agent_s_planner
from torchrl_etdmpc.commands.command_line import hydra_main
from torchrl_etdmpc.envs import Task, env_sizes, make_env
from torchrl_etdmpc.inspector.inspection import Inspection, State
from torchrl_etdmpc.inspector.page import make_page, serve
from torchrl_etdmpc.inspector.saved_page import free_folder, plotly_script, write_page
from torchrl_etdmpc.runs.files import make_folder
from torchrl_etdmpc.training import resolve_device


@dataclass(frozen=True, kw_only=True)
class InspectConfig(PlannerCommandConfig):
    """What to look at."""

    state: str = "random"
    """EPISODE:STEP, an episode by its seed and a decision of it; replay:ROW of the buffer that is saved beside the
    checkpoint; or random, a decision of the episode of this seed."""
    save: str | None = None
    """A folder: writes the page of the state and ends, without a server."""
    play: Literal["planner", "bare"] = "planner"
    """Who plays the episodes; bare is the policy network, for where planning takes long."""
    steps: int | None = None
    """Decisions of an episode, at most. Default: whole episodes."""
    host: str = "127.0.0.1"
    """Address that the page is served at; another machine's view of it needs allow_remote=true."""
    port: int = 8050
    """0 takes a free one."""
    allow_remote: bool = False
    """Whether anybody who reaches the page may use it."""
    seed: int = 0
    """Of the random state and the planner's samples."""
    device: str = "auto"
    """``auto``, ``cpu``, ``cuda`` or ``cuda:N``."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"random|(\d{1,9}|replay):\d{1,9}", self.state):
            raise ValueError(f"state must be EPISODE:STEP, replay:ROW or random, got {self.state!r}.")
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps must be at least 1, got {self.steps}.")
        if not 0 <= self.port < 2**16:
            raise ValueError(f"port must be in [0, 65535], got {self.port}.")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed must be in [0, 2**31 - 1], got {self.seed}.")


@hydra_main("inspect_planner", InspectConfig, complete=with_the_agent_s_planner)
def main(config: InspectConfig) -> None:
    """Shows what the planner of a trained agent sees: candidates, heads and depths of any state, on a local page."""
    plotly_script()  # what is not installed is said before anything takes long
    folder = None if config.save is None else free_folder(config.save)
    inspection = _inspection(config)
    made = folder is not None and not folder.exists()
    try:
        if folder is not None:
            make_folder(folder)
        state = _state(config, inspection)
        if folder is None:
            app = make_page(inspection, state=state, seed=config.seed, allow_remote=config.allow_remote)
            serve(app, host=config.host, port=config.port, allow_remote=config.allow_remote, ready=_say_where)
        else:
            trace = inspection.plan(state, {}, seed=config.seed)
            strip = None if state.replay else inspection.strip(state.episode)
            page = write_page(folder, trace, strip=strip, step=state.step)
            print(f"{inspection.task.name if inspection.task else 'agent'}: {page}, which any browser opens")
    except BaseException:
        if made and folder is not None:
            with contextlib.suppress(OSError):  # it was not made, or holds a page
                folder.rmdir()
        raise
    finally:
        inspection.close()


def _inspection(config: InspectConfig) -> Inspection:
    device = resolve_device(config.device)
    task = config.task_spec
    own = config.stored.task
    elsewhere = config.task not in (None, own)
    if elsewhere and config.state.startswith("replay"):
        raise ValueError(
            f"state={config.state} is a row of {own}, on which the agent was trained, and none of {task.name}; leave "
            "task=... out, or choose a state of an episode."
        )
    _need_no_renderer(task)
    sizes = {} if config.state.startswith("replay") else _sizes(task)  # a row of the buffer needs no simulator
    agent, counters, digest = config.load_known(device=device, **sizes)
    path = Path(config.checkpoint).expanduser()
    about = {"name": str(config.checkpoint), "sha256": digest, "env_steps": counters.get("env_steps", 0)}
    changed = {"changed_task": config.changed_task} if config.changed_task else {}
    store = CheckpointStore(path.parent)
    try:
        rows = 0 if elsewhere else store.buffer_rows()
    except CheckpointError:
        rows = 0  # the agent file is what was asked for
    return Inspection(
        config.planner_of(agent),
        task,
        bare=config.play == "bare",
        steps=config.steps,
        replay=(lambda row: store.read_row(row)["observation"]) if rows else None,
        rows=rows,
        about={"checkpoint": about} | changed,
    )


def _sizes(task: Task) -> dict[str, int]:
    env = make_env(task)
    env.close(raise_if_closed=False)
    return env_sizes(env)


def _need_no_renderer(task: Task) -> None:
    """Goes on without frames where MuJoCo's renderer, which nobody asked for, cannot be imported."""
    if renderer_is_a_guess() and task.suite == "dm_control":
        try:
            importlib.import_module("dm_control.mujoco")
        except Exception:  # every GL backend has its own error types
            begin_without_renderer()


def _state(config: InspectConfig, inspection: Inspection) -> State:
    if config.state == "random":
        length = 1
        if inspection.task is not None:
            most = inspection.task.decision_steps_per_episode
            length = inspection.play(config.seed) if inspection.task.terminates else min(config.steps or most, most)
        step = torch.randint(length, (), generator=torch.Generator().manual_seed(config.seed))
        return State(episode=config.seed, step=int(step))
    where, step = config.state.split(":")
    return State(episode=0 if where == "replay" else int(where), step=int(step), replay=where == "replay")


def _say_where(address: str, stop: Any) -> None:
    print(f"{address} shows the planner; Ctrl-C ends it", flush=True)
