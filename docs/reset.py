"""What every tutorial begins with, so that its numbers do not depend on the others."""

from __future__ import annotations

import warnings

import torch
from torchrl import torchrl_logger


def tutorial(gallery_conf, file_name) -> None:
    torch.manual_seed(0)
    torch.set_num_threads(1)
    torch.set_grad_enabled(True)
    torchrl_logger.setLevel("WARNING")  # what a run says on a terminal would be spread over the build's
    warnings.filterwarnings("ignore", message=".*auto_register_policy_transforms.*", category=FutureWarning)
