"""What every tutorial begins with, so that its numbers do not depend on the others."""

from __future__ import annotations

import warnings

import torch


def tutorial(gallery_conf, file_name) -> None:
    torch.manual_seed(0)
    torch.set_num_threads(1)
    torch.set_grad_enabled(True)
    warnings.filterwarnings("ignore", message=".*auto_register_policy_transforms.*", category=FutureWarning)
