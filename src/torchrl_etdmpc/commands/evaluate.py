"""``evaluate``: returns of whole episodes with the planner or with the bare policy; a film and a table if asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, SerialEnv

from torchrl_etdmpc.collectors import Episodes, evaluate
from torchrl_etdmpc.commands.agent_command import PlannerCommandConfig, with_the_agent_s_planner
from torchrl_etdmpc.commands.command_line import hydra_main
from torchrl_etdmpc.envs import Task, env_sizes, make_env, render_frame, success_return
from torchrl_etdmpc.envs.layers import simulator_of
from torchrl_etdmpc.envs.seeding import seed_everything
from torchrl_etdmpc.planners import BarePolicy
from torchrl_etdmpc.runs import progress_bar, write_film
from torchrl_etdmpc.runs.files import make_folder_of, write_whole
from torchrl_etdmpc.runs.video import film_writer
from torchrl_etdmpc.training import resolve_device
from torchrl_etdmpc.training.config import MOST_EPISODES

GIF_SIZE = 200  # pixels, for a page
_COLUMNS = "episode,return,decisions"
FRAMES_PER_SECOND = 50  # of a film: one frame a decision, which is one to four times real time for DMC's tasks


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(PlannerCommandConfig):
    """What to evaluate."""

    episodes: int = 10
    """How many are played, side by side; a film is of the first."""
    policy: Literal["planner", "bare"] = "planner"
    """``bare`` is the policy network without the planner."""
    video: str | None = None
    """A file that ends in .mp4 or .gif, for a film of the first episode."""
    csv: str | None = None
    """A file that ends in .csv, for the return and the decisions of every episode."""
    seed: int = 0
    """Of the initial states and the planner's samples."""
    device: str = "auto"
    """``auto``, ``cpu``, ``cuda`` or ``cuda:N``."""

    def __post_init__(self) -> None:
        if not 1 <= self.episodes <= MOST_EPISODES:
            raise ValueError(f"episodes must be between 1 and {MOST_EPISODES}, got {self.episodes}.")
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed must be in [0, 2**32 - 1], got {self.seed}.")
        if self.video is not None and Path(self.video).suffix not in (".mp4", ".gif"):
            raise ValueError(f"video must end in .mp4 or .gif, got {self.video!r}.")
        if self.csv is not None and Path(self.csv).suffix != ".csv":
            raise ValueError(f"csv must end in .csv, got {self.csv!r}.")


@hydra_main("evaluate", EvaluateConfig, complete=with_the_agent_s_planner)
def main(config: EvaluateConfig) -> None:
    """Plays episodes with a trained agent, and films the first one if asked to."""
    if config.policy == "bare" and config.changed:
        name = next(iter(config.changed))
        raise ValueError(f"planner.{name} changes nothing with policy=bare, which does not plan; leave one out.")
    for file in (config.video, config.csv):
        if file is not None:
            path = Path(file).expanduser()
            make_folder_of(path)
    _refuse_another_table(config.csv)
    device = resolve_device(config.device)
    task = config.task_spec
    env = make_env(task, seed=config.seed, num_envs=config.episodes, parallel=False)  # side by side
    agent, trained, counters = config.load(**env_sizes(env), device=device)
    if config.policy == "planner":
        policy = config.planner_of(agent)
        env = env.append_transform(policy.make_tensordict_primer())
    else:
        policy = BarePolicy(agent.acting_model)

    size = (GIF_SIZE, GIF_SIZE) if str(config.video).endswith(".gif") else ()
    frames: list[torch.Tensor] = []
    ended = False

    def film(step: TensorDictBase) -> None:
        nonlocal ended
        ended = ended or bool(step["next", "done"].reshape(-1)[0])
        if not ended:  # at its end the simulator stands at the start of another episode already
            frames.append(render_frame(_first(env), *size))

    def after(step: TensorDictBase) -> None:
        if config.video:
            film(step)
        bar.advance()

    if config.video:
        seed_everything(config.seed)
        env.reset()
        # The start. Fails here, before the episodes, if this machine cannot render or lacks what writes a film.
        frames.append(render_frame(_first(env), *size))
        film_writer(config.video)
        env.set_seed(config.seed)  # the episodes are those that are played without a film
    seed_everything(config.seed)
    with progress_bar("evaluation", task.decision_steps_per_episode, "decisions", passing=True) as bar:
        played = evaluate(env, policy, episodes=config.episodes, policy_device=device, on_step=after)
    env.close(raise_if_closed=False)
    elsewhere = "" if task.name == trained.task else f"on {trained.task} "
    told = _outcome(config, task, played, f"{elsewhere}for {counters.get('env_steps', 'an unknown number of')}")
    try:
        if config.csv:
            write_whole(Path(config.csv).expanduser(), _table(task, played))
            told += f"; episodes in {config.csv}"
        if config.video:
            write_film(frames, config.video, fps=FRAMES_PER_SECOND)
            told += f"; film in {config.video}"
    finally:  # on a full disk, too
        print(told)


def _refuse_another_table(file: str | None) -> None:
    """A table of evaluated episodes is written anew; what else is there, e.g. a run's learning curve, stays."""
    path = None if file is None else Path(file).expanduser()
    if path is None or not path.exists():
        return
    with path.open(errors="replace") as lines:
        if not next(lines, "").startswith(_COLUMNS):
            raise ValueError(f"csv={file} is there, and is no table of evaluated episodes; choose another file.")


def _first(env: EnvBase) -> EnvBase:
    """The first of environments that run side by side, or the only one."""
    simulator = simulator_of(env)
    return simulator._envs[0] if isinstance(simulator, SerialEnv) else simulator


def _table(task: Task, played: Episodes) -> str:
    """One line per episode, in the order of the initial states."""
    least = success_return(task)
    rows = [_COLUMNS + (",success" if least is not None else "")]
    for episode, (value, length) in enumerate(zip(played.returns.tolist(), played.lengths.tolist(), strict=True)):
        rows.append(f"{episode},{value},{length}" + (f",{int(value >= least)}" if least is not None else ""))
    return "\n".join([*rows, ""])


def _outcome(config: EvaluateConfig, task: Task, played: Episodes, trained: str) -> str:
    returns, least = played.returns, success_return(task)
    what, who = (
        f"{name} with {', '.join(f'{setting}={value}' for setting, value in changed.items())}" if changed else name
        for name, changed in ((task.name, config.changed_task), (config.policy, config.changed))
    )
    said = (
        f"{what} ({who}, trained {trained} env steps): return {returns.mean():.1f} "
        f"+- {returns.std(correction=0):.1f} over {len(returns)} episode{'s' * (len(returns) != 1)}"
    )
    if task.terminates:
        said += f" of {played.lengths.float().mean():.0f} decisions in the mean"
    if least is not None:
        said += f", {int((returns >= least).sum())} of them at {least:g} or more, a success"
    return said
