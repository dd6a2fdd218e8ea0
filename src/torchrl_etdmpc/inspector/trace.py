"""A trace: everything that one planning call looked at, as named arrays in one file."""

from __future__ import annotations

import functools
import hashlib
import io
import json
import math
import time
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrl_etdmpc.functional import (
    adaptive_mixture,
    elite_weights,
    ensemble_mean,
    ensemble_variance,
    sample_elite,
    shift_plan,
)
from torchrl_etdmpc.inspector.settings import plain_settings, with_settings
from torchrl_etdmpc.modules.prediction import PredictionModel, device_and_dtype, has_policy
from torchrl_etdmpc.planners import AdaptiveScore, EnsembleMPPIPlanner, Plan, PlanNoise, PlanTrace, Score
from torchrl_etdmpc.planners.imagination import imagined_returns, propose_sequences
from torchrl_etdmpc.runs import DamagedFileError, library_versions
from torchrl_etdmpc.runs.files import read_whole, write_whole

__all__ = ["Cancelled", "Trace", "TraceError", "load_trace", "trace_plan"]

FORMAT = 1
KIND = "torchrl_etdmpc trace"
COMPONENTS = 3
versions = functools.cache(library_versions)  # which looks into files
_BASIS_ROWS = 8192  # latents that the principal components are fitted to, evenly spread over all
_MOST_BYTES = 2**30  # of a trace in memory

# The arrays of a trace and their dimensions, by the alphabet of the package; C principal components, S states along
# the chosen sequence in the simulator, X and Y pixels. An action-value critic searches with two of its value heads and
# judges what was not searched with all: U and W. Those of the first group every trace has.
REQUIRED = {
    "actions": "INHA",
    "scores": "IN",
    "mean": "IHA",
    "std": "IHA",
    "elites": "IK",
    "elite_weights": "IK",
    "proposals": "N",
    "action": "A",
    "chosen": "",
    "chosen_actions": "HA",
    "value": "",
}
OPTIONAL = {
    "observation": "O",
    "latent": "L",
    "warm_start": "HA",
    "scale": "A",
    "returns": "INDFV",
    "mixture": "IND",
    "centre": "L",
    "basis": "CL",
    "explained": "C",
    "start_point": "C",
    "points": "INHFC",
    "latent_spread": "INH",
    "chosen_returns": "DFU",
    "chosen_points": "HFC",
    "chosen_rewards": "HF",
    "policy_action": "A",
    "policy_actions": "FHA",
    "policy_scores": "F",
    "policy_returns": "FDGW",
    "real_rewards": "R",
    "real_points": "SC",
    "frames": "SXYB",
}
_DIMENSIONS = REQUIRED | OPTIONAL


class TraceError(RuntimeError):
    """A file that cannot be used as a trace, and why."""


class Cancelled(RuntimeError):
    """A planning call that was given up between two iterations."""


@dataclass(frozen=True)
class Trace:
    """One state as the planner saw it.

    ``trace["scores"]`` is an array, ``trace.get("mixture")`` an array or ``None`` where the planner has no such thing:

    ====================================  ======================================================================
    ``actions [I, N, H, A]``              candidates of every iteration
    ``scores [I, N]``                     what each one is worth
    ``returns [I, N, D, F, V]``           its return table
    ``mean, std [I, H, A]``               the Gaussian after each iteration
    ``elites, elite_weights [I, K]``      which candidates it was fitted to, best first, and how much each counted
    ``proposals [N]``                     whether a candidate is a sequence of the policy
    ``mixture [I, N, D]``                 weights of the depths, with the adaptive score (thesis Fig. 4.1)
    ``points [I, N, H, F, C]``            where each step leads by each head, in principal components of latent space
    ``basis [C, L], centre [L]``          of the components, ``explained [C]`` their shares of the variance
    ``latent_spread [I, N, H]``           root mean square distance of the heads' latents from their mean
    ``chosen []``                         candidate of the last iteration that acts, -1 if it is none of them
    ``chosen_actions [H, A]``             its sequence, with ``chosen_returns``, ``chosen_points``, ``chosen_rewards``
    ``action, scale [A], value []``       what the planner returned
    ``policy_action [A]``                 the policy's own, with ``policy_actions [F, H, A]`` as each head sees it go
                                          on, ``policy_scores [F]`` and ``policy_returns [F, D, F, V]``
    ``real_rewards [R]``                  the chosen sequence in the simulator, with ``real_points [R + 1, C]`` and
                                          ``frames [R + 1, height, width, 3]``
    ``latent [L], observation [O]``       where it began, and ``warm_start [H, A]`` the Gaussian's first mean
    ====================================  ======================================================================

    Args:
        manifest (mapping): plain values: ``format``, ``planner``, ``settings``, ``task``, ``state``, ``versions``,
            ``checkpoint`` and ``seconds``.
        arrays (mapping of str to ndarray): some of the above.

    Raises:
        TraceError: if an array is missing, has another shape or is unknown.

    >>> from torchrl_etdmpc import LatentEnv
    >>> from torchrl_etdmpc.testing import LineWorld
    >>> planner = EnsembleMPPIPlanner(LatentEnv(LineWorld(num_dynamics=2)), horizon=3, num_samples=32, num_elites=4)
    >>> trace = trace_plan(planner, torch.tensor([0.5]))
    >>> trace["scores"].shape, trace["returns"].shape  # [I, N] and [I, N, D, F, V]
    ((6, 32), (6, 32, 3, 2, 1))
    >>> best = trace["scores"][-1].argmax()
    >>> bool(trace["elites"][-1, 0] == best)
    True
    """

    manifest: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        missing = sorted(REQUIRED.keys() - self.arrays.keys())
        if missing:
            raise TraceError(
                f"a trace needs the array {missing[0]!r}, which is missing; it has {', '.join(self.arrays)}."
            )
        sizes: dict[str, int] = {"C": min(COMPONENTS, self._size("centre", 0, COMPONENTS))}
        for name, array in self.arrays.items():
            if name not in _DIMENSIONS:
                raise TraceError(f"a trace has no array {name!r}; remove it or use the version that wrote it.")
            letters = _DIMENSIONS[name]
            found = dict(zip(letters, array.shape, strict=False))
            wrong = [letter for letter, size in found.items() if sizes.setdefault(letter, size) != size]
            if len(letters) != array.ndim or wrong:
                want = [sizes.get(letter, letter) for letter in letters]
                raise TraceError(f"{name} of a trace must have shape {want}, got {list(array.shape)}.")
            if array.dtype.kind not in "biuf":
                raise TraceError(f"{name} of a trace must hold numbers, got {array.dtype}.")

    def _size(self, name: str, dimension: int, default: int) -> int:
        array = self.arrays.get(name)
        return default if array is None or array.ndim <= dimension else array.shape[dimension]

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]

    def get(self, name: str) -> np.ndarray | None:
        """An array, or ``None`` where the planner has no such thing."""
        return self.arrays.get(name)

    @property
    def settings(self) -> Mapping[str, Any]:
        """The planner's arguments, plain."""
        return self.manifest["settings"]

    @property
    def iterations(self) -> int:
        """I."""
        return self["scores"].shape[0]

    @property
    def horizon(self) -> int:
        """H."""
        return self["actions"].shape[2]

    @property
    def num_dynamics(self) -> int:
        """F, as far as it is known; else 1."""
        for name, dimension in (("points", 3), ("returns", 3)):
            if self.get(name) is not None:
                return self[name].shape[dimension]
        return 1

    def save(self, path: str | Path) -> Path:
        """Writes one .npz file, which NumPy reads alone: ``json.loads(str(np.load(path)["manifest"]))``.

        Args:
            path (str or Path): ends in .npz.

        Raises:
            ValueError: if it ends otherwise.
        """
        path = Path(path).expanduser()
        if path.suffix != ".npz":
            raise ValueError(f"path of a trace must end in .npz, got {str(path)!r}; rename it.")
        memory = io.BytesIO()
        text = np.array(json.dumps(dict(self.manifest)))
        np.savez_compressed(memory, manifest=text, **self.arrays)  # pyright: ignore[reportArgumentType]
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, memory.getvalue())
        return path

    @staticmethod
    def load(path: str | Path) -> Trace:
        """:func:`load_trace`."""
        return load_trace(path)


def load_trace(path: str | Path) -> Trace:
    """Reads a file of :meth:`Trace.save`; no code in it is run.

    Raises:
        TraceError: if it is missing, no trace, of a newer format, or damaged.

    >>> import tempfile
    >>> from torchrl_etdmpc import LatentEnv
    >>> from torchrl_etdmpc.testing import LineWorld
    >>> planner = EnsembleMPPIPlanner(LatentEnv(LineWorld()), horizon=3, num_samples=32, num_elites=4)
    >>> trace = trace_plan(planner, torch.tensor([0.5]), task="line")
    >>> again = load_trace(trace.save(Path(tempfile.mkdtemp()) / "plan.npz"))
    >>> again.manifest["task"], bool((again["actions"] == trace["actions"]).all())
    ('line', True)
    """
    path = Path(path).expanduser()
    try:
        content = io.BytesIO(read_whole(path))
        with zipfile.ZipFile(content) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _MOST_BYTES:
                raise TraceError(f"{path} is not a trace: it would take more than {_MOST_BYTES:,} bytes.")
        with np.load(content, allow_pickle=False) as stored:
            manifest = json.loads(str(stored["manifest"]))
            if not isinstance(manifest, dict) or manifest.get("kind") != KIND:
                raise TraceError(f"{path} is not a trace of torchrl_etdmpc; write one with Trace.save.")
            if manifest["format"] != FORMAT:
                raise TraceError(
                    f"{path} has trace format {manifest['format']} and this version reads {FORMAT}; use the version of "
                    "torchrl_etdmpc that wrote it, or a newer one."
                )
            arrays = {name: stored[name] for name in stored.files if name != "manifest"}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, DamagedFileError, EOFError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise TraceError(f"{path} is not a trace ({reason}); write one with Trace.save.") from error
    missing = {"settings", "planner", "state"} - manifest.keys()
    if missing:
        raise TraceError(f"{path} is not a whole trace: its manifest lacks {', '.join(sorted(missing))}.")
    try:
        return Trace(manifest, arrays)
    except TraceError as error:
        raise TraceError(f"{path} is not a trace: {error}") from error


@torch.no_grad()
def trace_plan(
    planner: EnsembleMPPIPlanner,
    observation: Tensor | None = None,
    *,
    latent: Tensor | None = None,
    plan_mean: Tensor | None = None,
    explore: bool = False,
    seed: int = 0,
    like: Trace | None = None,
    progress: Callable[[int, int], None] | None = None,
    **about: Any,
) -> Trace:
    """Plans one state again and keeps what the planner saw.

    The plan is that of ``planner.plan`` with the noise of ``seed``. The planner stays as it is.

    Args:
        planner (EnsembleMPPIPlanner): of any :class:`~torchrl_etdmpc.modules.PredictionModel`; with other settings, see
            :func:`with_settings`.
        observation (Tensor, optional): ``[O]``, or whatever one observation is to the model.

    Keyword Args:
        latent (Tensor, optional): ``[L]``, instead of the observation.
        plan_mean (Tensor, optional): the warm start, ``[H, A]`` of any H: it is cut, or goes on with zeros. A planner
            without a warm start begins from zeros. Default: zeros.
        explore (bool): whether to choose as in training. Default: ``False``.
        seed (int): of the plan's noise. Default: 0.
        like (Trace, optional): of the same networks, whose principal components are taken, so that both can be drawn in
            one plane. Default: those of this trace's latents.
        progress (callable, optional): called between iterations with how many steps are done, of how many: an
            iteration is a step of planning and one of following its candidates through latent space. What it raises,
            e.g. :class:`Cancelled`, ends the call.
        **about: plain values for the manifest, e.g. ``task``, ``state`` and ``checkpoint``.

    Raises:
        ValueError: if the state or the warm start has another size than the model's.

    >>> from torchrl_etdmpc import LatentEnv
    >>> from torchrl_etdmpc.testing import LineWorld
    >>> planner = EnsembleMPPIPlanner(LatentEnv(LineWorld(num_dynamics=2)), horizon=3, num_samples=32, num_elites=4)
    >>> trace = trace_plan(planner, torch.tensor([0.5]))
    >>> trace["points"].shape  # [I, N, H, F, C]
    (6, 32, 3, 2, 2)
    """
    started = time.perf_counter()
    model = planner.world_model
    device, dtype = planner.env.device_and_dtype()
    latent = _start(model, observation, latent, device, dtype)
    carried = _warm_start(planner, plan_mean, latent)
    noise = planner.draw_noise(1, generator=torch.Generator(device).manual_seed(seed))
    steps = 2 * planner.iterations
    told = planner if progress is None else watched(planner, lambda asked: progress(asked, steps))
    plan = told.plan(latent=latent[None], plan_mean=carried[None], explore=explore, noise=noise, trace=True)
    assert plan.trace is not None
    search = PlanTrace(*(field[0] for field in plan.trace))

    elites, weights = _elites(planner, search.scores)
    chosen, chosen_actions = _chosen(planner, plan, search, noise, elites, weights, explore)
    proposals = torch.arange(planner.num_samples) < planner.num_proposals
    tensors = {
        **search._asdict(),
        "elites": elites,
        "elite_weights": weights,
        "proposals": proposals,
        "latent": latent,
        "warm_start": shift_plan(carried),
        "action": plan.action[0],
        "scale": plan.scale[0],
        "value": plan.value[0],
        "chosen": torch.tensor(chosen),
    }
    if isinstance(observation, Tensor) and observation.ndim == 1:
        tensors["observation"] = observation
    if isinstance(planner.score, AdaptiveScore):
        tensors["mixture"] = _mixture(search.returns, planner.score.beta)
    if has_policy(model):
        tensors |= _of_the_policy(planner, latent)
        if chosen_actions is None:
            chosen_actions = tensors["policy_actions"][0]
    if chosen_actions is None:  # no candidate had a finite score and there is no policy
        chosen_actions = plan.mean[0]
    tensors |= _of_the_chosen(planner, latent, chosen_actions)
    if chosen >= 0:
        tensors["chosen_returns"] = search.returns[-1, chosen]
    components, seen = _latents(model, latent, search.actions, like, progress)
    tensors |= seen | {"chosen_points": components.project(_rolled(model, latent, chosen_actions[None])[:, :, 0])}
    manifest = {
        "kind": KIND,
        "format": FORMAT,
        "planner": type(planner).__name__,
        "settings": plain_settings(planner),
        "seed": seed,
        "explore": explore,
        "fallback": bool(plan.fallback[0]),
        "state": {},
        "versions": dict(versions()),
        "seconds": round(time.perf_counter() - started, 4),
    }
    return Trace(manifest | about, {name: as_array(tensor) for name, tensor in tensors.items()})


def add_simulation(
    trace: Trace, rewards: Tensor, observations: Tensor, frames: Tensor | None, model: PredictionModel
) -> Trace:
    """The trace with what became of its chosen sequence in the simulator.

    Args:
        trace (Trace): of the state in which the simulator began.
        rewards (Tensor): ``[R]``, of the chosen sequence's first R actions.
        observations (Tensor): ``[R + 1, O]``.
        frames (Tensor, optional): uint8 ``[R + 1, height, width, 3]``.
        model (PredictionModel): the planner's, which encodes the observations.

    >>> from torchrl_etdmpc import LatentEnv, WorldModel
    >>> from torchrl_etdmpc.inspector import Simulator
    >>> model = WorldModel(3, 1, latent_dim=16, mlp_dim=16, encoder_dim=16)
    >>> planner = EnsembleMPPIPlanner(LatentEnv(model), horizon=3, num_samples=16, num_elites=4, num_proposals=2)
    >>> simulator = Simulator("gym/Pendulum-v1")
    >>> trace = trace_plan(planner, simulator.observation)
    >>> rolled = simulator.roll(torch.from_numpy(trace["chosen_actions"]))
    >>> both = add_simulation(trace, rolled.reward, rolled.observation, rolled.frames, model)
    >>> both["chosen_rewards"].shape, both["real_rewards"].shape  # [H, F] imagined, [R] real
    ((3, 4), (3,))
    """
    arrays = {**trace.arrays, "real_rewards": as_array(rewards)}
    if trace.get("basis") is not None:
        with torch.no_grad():
            latents = as_array(model.encode(observations.to(_like(model))))
        arrays["real_points"] = ((latents - trace["centre"]) @ trace["basis"].T).astype(np.float32)
    if frames is not None:
        arrays["frames"] = as_array(frames)
    return replace(trace, arrays=arrays)


def checksum(path: str | Path) -> str:
    """sha256 of a file, for a manifest."""
    return hashlib.sha256(read_whole(Path(path).expanduser())).hexdigest()


class Components(NamedTuple):
    """Principal components of latent space."""

    centre: Tensor
    """``[L]``"""
    basis: Tensor
    """``[C, L]``, orthonormal, the first explains most; the largest entry of each is positive."""

    def project(self, latents: Tensor) -> Tensor:
        """``[..., L]`` to ``[..., C]``."""
        return (latents - self.centre) @ self.basis.mT


def principal_components(latents: Tensor) -> Components:
    """The components of rows ``[M, L]``, at most three.

    >>> components = principal_components(torch.tensor([[0.0, 0.0], [2.0, 2.0], [4.0, 4.0]]))
    >>> components.project(torch.tensor([2.0, 2.0])).abs().max().item() < 1e-6
    True
    """
    rows = latents[:: math.ceil(len(latents) / _BASIS_ROWS)].double()
    centre = rows.mean(0)
    _, vectors = torch.linalg.eigh((rows - centre).mT @ (rows - centre))  # in ascending order
    basis = vectors.mT.flip(0)[:COMPONENTS]
    largest = basis.gather(1, basis.abs().argmax(1, keepdim=True))
    basis = basis * torch.where(largest < 0, -1.0, 1.0)
    return Components(centre.to(latents.dtype), basis.to(latents.dtype))


def watched(planner: EnsembleMPPIPlanner, tell: Callable[[int], None]) -> EnsembleMPPIPlanner:
    """The same planner, which says after every iteration how many there have been; what ``tell`` raises ends a plan."""
    return with_settings(planner, score=_Watched(planner.score, tell), beta=0.0)


class _Watched:
    """A score that tells how often it was asked: once an iteration."""

    def __init__(self, score: Score, tell: Callable[[int], None]) -> None:
        self.score, self.tell, self.asked = score, tell, 0

    @property
    def depths(self) -> Any:
        return self.score.depths

    def __call__(self, returns: Tensor) -> Tensor:
        scores = self.score(returns)
        self.asked += 1
        self.tell(self.asked)
        return scores


def _start(
    model: PredictionModel, observation: Any, latent: Tensor | None, device: torch.device, dtype: torch.dtype
) -> Tensor:
    """The latent ``[L]`` of one state."""
    if (observation is None) == (latent is None):
        raise ValueError("trace_plan needs either an observation or a latent of one state, got both or neither.")
    if latent is None:
        if isinstance(observation, Tensor):
            wanted = model.observation_dim
            if wanted is not None and observation.shape != (wanted,):
                raise ValueError(
                    f"observation must be one state of size {wanted}, as the model was trained on, got shape "
                    f"{list(observation.shape)}; take it from the task of the checkpoint."
                )
            observation = observation.to(device, dtype if observation.is_floating_point() else None)
        latent = model.encode(observation[None])[0]
    if latent.shape != (model.latent_dim,):
        raise ValueError(f"latent must be one state of size {model.latent_dim}, got shape {list(latent.shape)}.")
    return latent.to(device, dtype)


def _warm_start(planner: EnsembleMPPIPlanner, plan_mean: Tensor | None, latent: Tensor) -> Tensor:
    carried = latent.new_zeros(planner.horizon, planner.world_model.action_dim)
    if plan_mean is None or not planner.warm_start:
        return carried
    if plan_mean.ndim != 2 or plan_mean.shape[1] != carried.shape[1]:
        raise ValueError(f"plan_mean must have shape [H, {carried.shape[1]}], got {list(plan_mean.shape)}.")
    steps = min(len(plan_mean), planner.horizon)
    carried[:steps] = plan_mean[:steps]
    return carried


def _elites(planner: EnsembleMPPIPlanner, scores: Tensor) -> tuple[Tensor, Tensor]:
    """Indices and weights ``[I, K]`` of the elites, as the planner selects them."""
    ranked, index = torch.where(scores.isfinite(), scores, -torch.inf).topk(planner.num_elites, dim=-1)
    return index, elite_weights(ranked, planner.inverse_temperature)


def _chosen(
    planner: EnsembleMPPIPlanner,
    plan: Plan,
    search: PlanTrace,
    noise: PlanNoise,
    elites: Tensor,
    weights: Tensor,
    explore: bool,
) -> tuple[int, Tensor | None]:
    """The candidate of the last iteration that acts (-1 if none) and its sequence ``[H, A]`` (``None`` on fallback)."""
    choice = planner.first_action if explore else planner.eval_first_action
    if plan.fallback[0]:
        return -1, None
    if choice == "mean":
        return -1, search.mean[-1]
    place = 0 if choice == "best" else int(sample_elite(weights[-1], noise.elite[0]))
    index = int(elites[-1, place])
    return index, search.actions[-1, index]


def _mixture(returns: Tensor, beta: float) -> Tensor:
    """Weights ``[I, N, D]`` that the adaptive score gives the depths."""
    return adaptive_mixture(ensemble_mean(returns), ensemble_variance(returns).sqrt(), beta)[1]


def _of_the_policy(planner: EnsembleMPPIPlanner, latent: Tensor) -> dict[str, Tensor]:
    """The policy's mean actions, followed by every head, and what they are worth to the planner's score."""
    model = planner.world_model
    assert has_policy(model)
    heads = model.num_dynamics
    still = latent.new_zeros(1, heads, planner.horizon, model.action_dim)
    actions = propose_sequences(model, latent[None], still)
    returns = _returns(planner, latent, actions[0])
    return {
        "policy_action": model.policy(latent)[0],
        "policy_actions": actions[0],
        "policy_returns": returns,
        "policy_scores": planner.score(returns),
    }


def _returns(planner: EnsembleMPPIPlanner, latent: Tensor, actions: Tensor) -> Tensor:
    """Return table ``[N, D, F, V]`` of sequences ``[N, H, A]``, by the model's own values."""
    options = {"discount": planner.discount, "all_depths": planner.score.depths == "all"}
    return imagined_returns(planner.world_model, latent[None], actions[None], **options)[0]


def _of_the_chosen(planner: EnsembleMPPIPlanner, latent: Tensor, actions: Tensor) -> dict[str, Tensor]:
    """The sequence with its return table and its rewards by each head."""
    model = planner.world_model
    latents = _rolled(model, latent, actions[None])[:, :, 0]  # [H, F, L]
    before = torch.cat([latent.expand(1, *latents.shape[1:]), latents[:-1]])
    rewards = model.reward(before, actions[:, None].expand(*before.shape[:-1], -1))
    return {
        "chosen_actions": actions,
        "chosen_returns": _returns(planner, latent, actions[None])[0],
        "chosen_rewards": rewards,
    }


def _rolled(model: PredictionModel, latent: Tensor, actions: Tensor) -> Tensor:
    """Latents ``[H, F, N, L]`` along sequences ``[N, H, A]``, every head on its own rollout."""
    before, latents = latent[None, None, None], []
    for step in range(actions.shape[1]):
        before = model.next(before, actions[None, :, step])
        latents.append(before[:, 0])
    return torch.stack(latents)


def latent_views(
    rolled: list[Tensor], start: Tensor, like: Trace | None = None
) -> tuple[Components, dict[str, Tensor]]:
    """Latents of every iteration's candidates, ``[H, F, N, L]`` each, as the arrays of a trace that show them."""
    if like is None or like.get("basis") is None:
        components = principal_components(torch.cat([latents.flatten(0, 2) for latents in rolled]))
    else:
        components = Components(*(torch.from_numpy(like[name]).to(start) for name in ("centre", "basis")))
    points = torch.stack([components.project(latents).permute(2, 0, 1, 3) for latents in rolled])
    spread = torch.stack([latents.std(1, correction=0).square().sum(-1).sqrt().mT for latents in rolled])
    total = sum((latents - components.centre).square().sum() for latents in rolled)
    return components, {
        **components._asdict(),
        "explained": points.square().sum((0, 1, 2, 3)) / torch.as_tensor(total).clamp_min(1e-30),
        "start_point": components.project(start),
        "points": points,
        "latent_spread": spread,
    }


def _latents(
    model: PredictionModel,
    latent: Tensor,
    actions: Tensor,
    like: Trace | None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Components, dict[str, Tensor]]:
    """Where the candidates ``[I, N, H, A]`` lead, in principal components, and how far the heads are apart."""
    rolled = []  # of each iteration [H, F, N, L]
    for number, candidates in enumerate(actions, start=1):
        rolled.append(_rolled(model, latent, candidates))
        if progress is not None:
            progress(len(actions) + number, 2 * len(actions))
    return latent_views(rolled, latent, like)


def _like(model: PredictionModel) -> Tensor:
    """A tensor where the model is."""
    device, dtype = device_and_dtype(model)
    return torch.empty(0, device=device, dtype=dtype)


def as_array(tensor: Tensor) -> np.ndarray:
    tensor = tensor.detach().cpu()
    if tensor.is_floating_point():
        return tensor.float().numpy()
    return tensor.to(torch.int32).numpy() if tensor.dtype == torch.int64 else tensor.numpy()
