"""TorchRL loggers that receive the numbers of a run besides its own files."""

from __future__ import annotations

import importlib.util
import os
import secrets
import warnings
from collections.abc import Mapping
from typing import Any, Literal, get_args

from torchrl.record.loggers import Logger, get_logger

from torchrl_etdmpc.runs.directory import RunDirectory
from torchrl_etdmpc.runs.errors import first_line
from torchrl_etdmpc.runs.files import write_whole

LoggerName = Literal["none", "tensorboard", "wandb"]
"""Where numbers go besides a run's own files."""
_WANDB_TIMEOUT_S = 30


def require_logger(name: LoggerName) -> None:
    """Checks that a logger can be made, before a run makes its directory.

    Raises:
        ValueError: if there is none of that name.
        ImportError: if its package is not installed.

    >>> require_logger("none")
    """
    if name not in get_args(LoggerName):
        raise ValueError(f"logger must be one of {', '.join(get_args(LoggerName))}, got {name!r}.")
    if name == "none":
        return
    spec = importlib.util.find_spec(name)
    # A plain folder called "wandb" (what wandb leaves behind in the working directory) is found too, without an origin.
    if spec is None or spec.origin is None:
        raise ImportError(f"logger={name} needs {name}, which is not installed; run `pip install {name}`.")


def make_logger(name: LoggerName, directory: RunDirectory, config: Mapping[str, Any]) -> Logger | None:
    """A TorchRL logger that writes into the run directory, or ``None`` for ``"none"``.

    ``wandb`` is offline where it cannot be reached or has no API key; the environment variable ``WANDB_MODE`` is
    obeyed. A run that goes on is the same run there.

    Args:
        name (str): ``"none"``, ``"tensorboard"`` or ``"wandb"``.
        directory (RunDirectory): it exists.
        config (mapping): shown as the run's hyper-parameters.

    Raises:
        ValueError: if there is none of that name.
        ImportError: if its package is not installed.

    >>> make_logger("none", RunDirectory("runs/a"), {}) is None
    True
    """
    require_logger(name)
    if name == "none":
        return None
    if name == "tensorboard":
        folder = directory.tensorboard
        return get_logger("tensorboard", logger_name=str(folder.parent), experiment_name=folder.name)
    import wandb  # pyright: ignore[reportMissingImports]  # an extra
    from wandb.errors import Error as WandbError  # pyright: ignore[reportMissingImports]

    if not directory.wandb_id.exists():
        write_whole(directory.wandb_id, secrets.token_hex(4))
    # The installed packages and their source locations are the user's business, not the run's.
    options = {"project": "torchrl_etdmpc", "log_env_packages": False}
    options["id"] = directory.wandb_id.read_text(encoding="utf-8")
    options["settings"] = wandb.Settings(init_timeout=_WANDB_TIMEOUT_S)
    if "WANDB_MODE" not in os.environ and not wandb.login(prompt=False, verify=False):
        options["mode"] = "offline"

    def start() -> Logger:
        path = directory.path
        logger = get_logger("wandb", logger_name=str(path), experiment_name=path.name, wandb_kwargs=options)
        assert logger is not None  # as the name is one of its own
        logger.log_hparams(dict(config))
        return logger

    try:
        return start()
    except WandbError as error:
        if options.get("mode") == "offline":
            raise
        warnings.warn(
            f"wandb cannot be reached ({first_line(error)}), so it is offline; `wandb sync` sends it later.",
            stacklevel=3,
        )
        options["mode"] = "offline"
        wandb.teardown()  # the failed attempt holds the run's id
        return start()
