"""Evaluates a checkpoint: returns of whole episodes with the planner or with the bare policy, and a film if asked for.

python examples/evaluate.py checkpoint=runs/walker-walk/cpu/seed1/checkpoints/last.pt episodes=10 video=walker.mp4
"""

from __future__ import annotations

import dataclasses
import os
import sys
from dataclasses import dataclass
from pathlib import Path

# MuJoCo chooses its renderer when it is imported; without a film none is needed.
filming = any(argument.startswith("video=") and argument != "video=null" for argument in sys.argv)
os.environ.setdefault("MUJOCO_GL", "egl" if filming else "disable")

import torch  # noqa: E402
from tensordict import TensorDictBase  # noqa: E402

from torchrl_etdmpc.collectors import evaluate  # noqa: E402
from torchrl_etdmpc.envs import Task, get_task, make_env, render_frame  # noqa: E402
from torchrl_etdmpc.planners import BarePolicy  # noqa: E402
from torchrl_etdmpc.runs import write_mp4  # noqa: E402
from torchrl_etdmpc.training import (  # noqa: E402
    TrainConfig,
    hydra_main,
    load_agent,
    read_agent_file,
    resolve_device,
)

FRAMES_PER_SECOND = 50  # of a film: one frame a decision, close to real time for most tasks


@dataclass(frozen=True)
class EvaluateConfig:
    """What to evaluate; see config/evaluate.yaml."""

    checkpoint: str
    episodes: int = 10
    policy: str = "planner"
    video: str | None = None
    task: str | None = None
    action_repeat: int | None = None
    episode_length: int | None = None
    terminates: bool | None = None
    seed: int = 0
    device: str = "auto"

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ValueError(f"episodes must be at least 1, got {self.episodes}.")
        if self.policy not in ("planner", "bare"):
            raise ValueError(f"policy must be planner or bare, got {self.policy!r}.")
        if self.video is not None and Path(self.video).suffix != ".mp4":
            raise ValueError(f"video must end in .mp4, got {self.video!r}.")


def task_of(config: EvaluateConfig) -> Task:
    """The task that the command names, or the one that the agent was trained on, with what its run changed about it."""
    changes = {name: getattr(config, name) for name in ("action_repeat", "episode_length", "terminates")}
    told = {name: value for name, value in changes.items() if value is not None}
    stored = read_agent_file(config.checkpoint)["config"]
    if config.task is not None and config.task != stored["task"]:
        return get_task(config.task, **told)
    return dataclasses.replace(TrainConfig.from_dict(stored).task_spec, **told)


@hydra_main(str(Path(__file__).resolve().parent / "config"), "evaluate", EvaluateConfig)
def main(config: EvaluateConfig) -> None:
    """Loads, runs the episodes, prints the returns."""
    device = resolve_device(config.device)
    task = task_of(config)
    # A film needs the one environment that it shows; otherwise the episodes run side by side.
    env = make_env(task, seed=config.seed, num_envs=1 if config.video else config.episodes, parallel=False)
    agent, _, counters = load_agent(
        config.checkpoint,
        observation_dim=env.observation_spec["observation"].shape[-1],
        action_dim=env.action_spec.shape[-1],
        device=device,
        compile_setting="off",
    )
    torch.manual_seed(config.seed)
    if config.policy == "planner":
        policy = agent.eval_planner
        env = env.append_transform(policy.make_tensordict_primer())
    else:
        policy = BarePolicy(agent.world_model)

    frames: list[torch.Tensor] = []
    ended = False

    def film(step: TensorDictBase) -> None:
        nonlocal ended
        if not ended:
            frames.append(render_frame(env))
            ended = bool(step["next", "done"].any())

    if config.video:
        env.reset()
        render_frame(env)  # fails here, before the episodes, if this machine cannot render
    returns = evaluate(
        env, policy, episodes=config.episodes, policy_device=device, on_step=film if config.video else None
    )
    if config.video:
        write_mp4(frames, config.video, fps=FRAMES_PER_SECOND)
    env.close(raise_if_closed=False)
    spread = returns.std(correction=0).item()
    print(
        f"{task.name} ({config.policy}, trained for {counters['env_steps']} env steps): return {returns.mean():.1f} "
        f"+- {spread:.1f} over {len(returns)} episodes" + (f"; film in {config.video}" if config.video else "")
    )


if __name__ == "__main__":
    main()
