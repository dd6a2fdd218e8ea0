"""From a configuration to the data's way: buffer, reanalyze and collector around an agent."""

from __future__ import annotations

import torch
from tensordict import NestedKey, unravel_key
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, TensorDictRoundRobinWriter
from torchrl.envs import EnvBase

from torchrl_etdmpc.collectors import SeedPolicy, StepCollector
from torchrl_etdmpc.keys import DONE, FALLBACK, IS_INIT, NEXT, PLAN, PLAN_MEAN, TERMINATED, TRAJECTORY, WORKER
from torchrl_etdmpc.replay import ReanalyzeTransform, StepSliceSampler
from torchrl_etdmpc.training.agent import Agent
from torchrl_etdmpc.training.config import TrainConfig, check_device, named_settings
from torchrl_etdmpc.training.distributed import DistributedConfig, WorkerCollector

# What an environment or a policy writes and nothing reads from a stored row: less to write at every step.
UNREAD = (
    PLAN_MEAN,
    (NEXT, PLAN_MEAN),
    IS_INIT,
    (NEXT, IS_INIT),
    "episode_reward",
    DONE,
    TERMINATED,
    "truncated",
    (PLAN, FALLBACK),
)


def resolve_device(name: str) -> torch.device:
    """The device behind ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.

    A CUDA device becomes PyTorch's current one, and products on it may use TF32, as in training.

    Raises:
        ValueError: if it is none of these, or CUDA is asked for and not there, or not that device.

    >>> resolve_device("cpu")
    device(type='cpu')
    """
    check_device(name)
    there = torch.cuda.is_available()
    device = torch.device(("cuda" if there else "cpu") if name == "auto" else name)
    if device.type == "cuda":
        if not there:
            raise ValueError(
                f"device={name} needs a CUDA device and this PyTorch sees none; use device=cpu or device=auto."
            )
        count = torch.cuda.device_count()
        if device.index is not None and device.index >= count:
            raise ValueError(
                f"device={name} is not there: this PyTorch sees {count} CUDA device{'s' * (count > 1)}, counted from 0."
            )
        if device.index is not None:  # a copy to the CPU waits for the current device alone, inside of TensorDict
            torch.cuda.set_device(device)
        torch.set_float32_matmul_precision("high")
    return device


def row_bytes(observation_dim: int, action_dim: int) -> int:
    """Bytes of one stored transition: observation before and after, action, reward, planner's target and labels.

    Args:
        observation_dim (int): O.
        action_dim (int): A.

    >>> row_bytes(24, 6)  # walker's
    311
    """
    floats = 2 * observation_dim + 3 * action_dim + 3  # action, loc and scale; reward, its sum and the plan's value
    integers = 4  # trajectory, model version, number and generation of the row
    flags = 3  # done, terminated and truncated after
    return 4 * floats + 8 * integers + flags


def replay_device(config: TrainConfig, device: torch.device | str, needed: int) -> torch.device:
    """Where ``replay.device`` puts the storage.

    Args:
        config (TrainConfig): the run.
        device (torch.device or str): the run's device.
        needed (int): bytes of the full buffer.
    """
    device = torch.device(device)
    if config.replay.device == "cpu" or device.type != "cuda":
        return torch.device("cpu")
    if config.replay.device == "run":
        return device
    free, _ = torch.cuda.mem_get_info(device)
    return device if needed <= free / 2 else torch.device("cpu")


def build_replay(
    config: TrainConfig, device: torch.device | str = "cpu", *, sizes: tuple[int, int] = (0, 0)
) -> TensorDictReplayBuffer:
    """The buffer: as many rows as the budget can fill, sampled by slices of ``loss.slice_len``.

    Args:
        config (TrainConfig): the run.
        device (torch.device or str): the run's device, where batches go. Default: ``"cpu"``.

    Keyword Args:
        sizes (tuple of int): O and A, for the rule of ``replay.device=auto``. Default: rows of no size, which fit.

    >>> from torchrl_etdmpc.training import preset
    >>> build_replay(preset("cpu")).batch_size  # 64 slices of 3
    192
    """
    with named_settings("loss", config.loss):
        sampler = StepSliceSampler(
            config.loss.slice_len,
            traj_key=[WORKER, TRAJECTORY] if isinstance(config, DistributedConfig) else TRAJECTORY,
            uniform_over=config.replay.uniform_over,
            partial=config.partial_slices,
            as_slices=True,
        )
    rows = config.replay_rows
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(rows, device=replay_device(config, device, rows * row_bytes(*sizes))),
        sampler=sampler,
        writer=TensorDictRoundRobinWriter(track_generations=True),
        batch_size=config.optim.batch_size * config.loss.slice_len,
    )


def build_reanalyze(config: TrainConfig, agent: Agent, replay: TensorDictReplayBuffer) -> ReanalyzeTransform | None:
    """Reanalyze attached to the buffer, or ``None`` if ``reanalyze.every`` is 0.

    >>> from torchrl_etdmpc.training import build_agent, preset
    >>> config = preset("cpu")
    >>> agent = build_agent(config, observation_dim=3, action_dim=1)
    >>> build_reanalyze(config, agent, build_replay(config)).interval
    10
    """
    if config.reanalyze.every == 0:
        return None
    # Departure from the thesis, which can be read as an interval of gradient updates: of decision steps, so that "UTD1
    # every 10" and "UTD4 every 2" are proportional scaling.
    with named_settings("reanalyze", config.reanalyze):
        reanalyze = ReanalyzeTransform(
            agent.reanalyze_planner,
            slice_len=config.loss.slice_len,
            interval=config.reanalyze.every * config.optim.updates_per_decision,
            num_slices=config.reanalyze.num_slices,
        )
    return reanalyze.attach(replay)


def unread_keys(env: EnvBase, agent: Agent) -> tuple[NestedKey, ...]:
    """What is not stored: of :data:`UNREAD` and what else a user's environment observes all that no term reads.

    Pixels to look at, counts, what the simulator knows: it would fill the memory, which is counted without it.

    Args:
        env (EnvBase): the environment.
        agent (Agent): whose loss reads rows.
    """
    read = {*map(unravel_key, agent.loss.in_keys), (NEXT, "episode_reward")}
    observed = list(env.full_observation_spec.keys(True, True))
    written = [*observed, *(unravel_key((NEXT, key)) for key in observed)]
    return tuple(key for key in dict.fromkeys((*UNREAD, *written)) if key not in read)


def build_collector(
    config: TrainConfig, agent: Agent, env: EnvBase, replay: TensorDictReplayBuffer
) -> StepCollector | WorkerCollector:
    """The collector with its random phase: on an environment with ``config.num_envs`` rows, or workers.

    >>> from torchrl_etdmpc.envs import make_env
    >>> from torchrl_etdmpc.training import TrainConfig, build_agent, preset
    >>> config = TrainConfig.from_dict(preset("cpu").to_dict() | {"task": "gym/Pendulum-v1"})
    >>> agent = build_agent(config, observation_dim=3, action_dim=1)
    >>> collector = build_collector(config, agent, make_env("gym/Pendulum-v1", seed=0), build_replay(config))
    >>> next(iter(collector))["action"].shape  # of the random phase
    torch.Size([1, 1])
    >>> collector.shutdown()
    """
    if isinstance(config, DistributedConfig):
        return WorkerCollector(config, agent, env, replay, exclude_keys=unread_keys(env, agent))
    return StepCollector(
        env,
        agent.planner,
        replay_buffer=replay,
        total_frames=config.total_decisions,
        init_random_frames=config.seed_decisions,
        seed_policy=SeedPolicy(env.action_spec, hold=config.replay.seed_hold),
        insertion=config.replay.insertion,
        exclude_keys=unread_keys(env, agent),
        policy_device=agent.device,
    )
