"""TorchRL loggers that receive the numbers of a run besides its own files."""

from __future__ import annotations

import importlib.util
import os
import secrets
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl.record.loggers import Logger, get_logger

LOGGERS = ("none", "tensorboard", "wandb")
_WANDB_TIMEOUT_S = 30


def require_logger(name: str) -> None:
    """Raises ImportError if the logger's package is not installed."""
    spec = importlib.util.find_spec(name)
    # A plain folder called "wandb" (what wandb leaves behind in the working directory) is found too, without an origin.
    if spec is None or spec.origin is None:
        raise ImportError(
            f"logger={name} needs {name}, which is not installed; run `pip install torchrl_etdmpc[{name}]`."
        )


def make_logger(name: str, run_dir: Path, config: Mapping[str, Any]) -> Logger | None:
    """The logger, or None for ``"none"``. ``wandb`` is offline where it cannot be reached, or has no API key."""
    if name == "none":
        return None
    if name == "tensorboard":
        return get_logger("tensorboard", logger_name=str(run_dir), experiment_name="tensorboard")
    import wandb

    identity = run_dir / "wandb_id"  # a run that goes on is the same run there
    if not identity.exists():
        identity.write_text(secrets.token_hex(4), encoding="utf-8")
    # The installed packages and their source locations are the user's business, not the run's.
    options = {"project": "torchrl_etdmpc", "log_env_packages": False, "id": identity.read_text(encoding="utf-8")}
    options["settings"] = wandb.Settings(init_timeout=_WANDB_TIMEOUT_S)
    if "WANDB_MODE" not in os.environ and not wandb.login(prompt=False, verify=False):
        options["mode"] = "offline"

    def start() -> Logger:
        logger = get_logger("wandb", logger_name=str(run_dir), experiment_name=run_dir.name, wandb_kwargs=options)
        logger.log_hparams(dict(config))
        return logger

    try:
        return start()
    except wandb.errors.Error as error:
        if options.get("mode") == "offline":
            raise
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        warnings.warn(
            f"wandb cannot be reached ({reason}), so it is offline; `wandb sync` sends it later.", stacklevel=4
        )
        options["mode"] = "offline"
        wandb.teardown()  # the failed attempt holds the run's id
        return start()
