"""A trace: everything that one planning call looked at, as named arrays in one file."""

from __future__ import annotations

import functools
import hashlib
import io
import json
import time
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_etdmpc.runs import DamagedFileError, library_versions
from torchrl_etdmpc.runs.files import read_whole, write_whole

FORMAT = 1
KIND = "torchrl_etdmpc trace"
COMPONENTS = 3
versions = functools.cache(library_versions)  # which looks into files
_MOST_BYTES = 2**30  # of a trace in memory
# What is not there, is cut off, or was made to take all memory or to nest without end.
_UNREADABLE = (
    *(OSError, ValueError, KeyError, zipfile.BadZipFile, zlib.error, DamagedFileError, EOFError),
    *(MemoryError, RecursionError, NotImplementedError, RuntimeError),
    *(SyntaxError, tokenize.TokenError),  # of the line that says shape and type of an array
)


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
_TOGETHER = {"points": ("explained", "basis", "centre"), "chosen_points": ("start_point",)}
"""What is shown of an array needs these others."""


class TraceError(RuntimeError):
    """A file that cannot be used as a trace, and why."""


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
    ``latent [L], observation [O]``       where it began, and ``warm_start [H, A]`` the Gaussian's first mean, with
                                          ``initial="wide"``
    ====================================  ======================================================================

    Args:
        manifest (mapping): plain values: ``format``, ``planner``, ``settings``, ``task``, ``state``, ``versions``,
            ``checkpoint`` and ``seconds``.
        arrays (mapping of str to ndarray): some of the above.

    Raises:
        TraceError: if an array is missing, has another shape, names no candidate or is unknown, or the manifest's
            ``settings``, ``state`` or ``checkpoint`` is no mapping.

    >>> from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv
    >>> from torchrl_etdmpc.inspector import trace_plan
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
        for name in ("settings", "state", "checkpoint"):
            value = self.manifest.get(name, {})
            if not isinstance(value, Mapping) and (name, value) != ("checkpoint", None):
                raise TraceError(
                    f"{name} in the manifest of a trace must be names with values, got {value!r}; write "
                    f"{{'name': {value!r}}}."
                )
        missing = sorted(REQUIRED.keys() - self.arrays.keys())
        if missing:
            raise TraceError(
                f"a trace needs the array {missing[0]!r}, which is missing; it has {', '.join(self.arrays)}."
            )
        centre = self.get("centre")
        sizes: dict[str, int] = {"C": COMPONENTS if centre is None or not centre.ndim else min(COMPONENTS, len(centre))}
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
        for name, needed in _TOGETHER.items():
            lacking = [other for other in needed if name in self.arrays and other not in self.arrays]
            if lacking:
                raise TraceError(f"a trace with the array {name!r} needs {lacking[0]!r}, which is missing.")
        for name, least in (("elites", 0), ("chosen", -1)):
            array, most = self[name], sizes["N"] - 1
            if array.dtype.kind not in "iu" or array.size and not least <= array.min() <= array.max() <= most:
                raise TraceError(f"{name} of a trace must be whole numbers in [{least}, {most}], its candidates.")
        if self["proposals"].dtype.kind != "b":
            raise TraceError(f"proposals of a trace must be true or false, got {self['proposals'].dtype}.")

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
        for name in ("points", "returns"):
            if self.get(name) is not None:
                return self[name].shape[3]
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


def load_trace(path: str | Path) -> Trace:
    """Reads a file of :meth:`Trace.save`; no code in it is run.

    Raises:
        TraceError: if it is missing, no trace, of a newer format, or damaged.

    >>> import tempfile
    >>> from torchrl_etdmpc import EnsembleMPPIPlanner, LatentEnv
    >>> from torchrl_etdmpc.inspector import trace_plan
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
    except TraceError:
        raise
    except _UNREADABLE as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise TraceError(f"{path} is not a trace ({reason}); write one with Trace.save.") from error
    missing = {"settings", "planner", "state"} - manifest.keys()
    if missing:
        raise TraceError(f"{path} is not a whole trace: its manifest lacks {', '.join(sorted(missing))}.")
    try:
        return Trace(manifest, arrays)
    except TraceError as error:
        raise TraceError(f"{path} is not a trace: {error}") from error


def checksum(path: str | Path) -> str:
    """sha256 of a file, for a manifest."""
    return hashlib.sha256(read_whole(Path(path).expanduser())).hexdigest()


def trace_of(
    planner: Any, settings: Mapping[str, Any], tensors: Mapping[str, Any], *, started: float, **about: Any
) -> Trace:
    """A new trace of a planner; ``started`` is when planning began, by ``time.perf_counter``."""
    manifest = {
        "kind": KIND,
        "format": FORMAT,
        "planner": type(planner).__name__,
        "settings": settings,
        "state": {},
        "versions": dict(versions()),
        "seconds": round(time.perf_counter() - started, 4),
    }
    return Trace(manifest | about, {name: as_array(tensor) for name, tensor in tensors.items()})


def as_array(tensor: Tensor) -> np.ndarray:
    """The array that a trace keeps of a tensor: float32, int32 or as it is."""
    tensor = tensor.detach().cpu()
    if tensor.is_floating_point():
        return tensor.float().numpy()
    return tensor.to(torch.int32).numpy() if tensor.dtype == torch.int64 else tensor.numpy()
