"""The figure of the data flow, drawn by graphviz: ``python docs/figures/data_flow.py`` writes ``data_flow.svg``.

Every box names what is imported below, so that a renamed part breaks this file; a test says when the picture is older
than its text.
"""

from __future__ import annotations

import hashlib
import subprocess
from pathlib import Path

from torchrl_etdmpc import (
    EfficientTDMPCLoss,
    EnsembleMPPIPlanner,
    LatentEnv,
    ReanalyzeTransform,
    StepCollector,
    StepSliceSampler,
    WorldModel,
)
from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.training import Updater

SVG = Path(__file__).with_name("data_flow.svg")
BOXES = {
    "env": (make_env, "envs", "observation [O], reward, ends"),
    "collector": (StepCollector, "collectors", "acts, steps and stores each step"),
    "planner": (EnsembleMPPIPlanner, "planners", "Gaussian over action sequences"),
    "latent": (LatentEnv, "planners", "imagined steps, F heads"),
    "model": (WorldModel, "modules", "encoder, dynamics, reward, values, policy"),
    "sampler": (StepSliceSampler, "replay", "slices of T steps of one episode"),
    "reanalyze": (ReanalyzeTransform, "replay", "plans again with today's weights"),
    "loss": (EfficientTDMPCLoss, "objectives", "consistency, reward, value, policy"),
    "updater": (Updater, "training", "two clipped gradients, Adam, targets"),
}
ARROWS = (
    ("env", "collector", "observation"),
    ("collector", "planner", "observation,\nwarm start"),
    ("planner", "collector", "action,\nplan (loc, scale)"),
    ("collector", "env", "action in [-1, 1]"),
    ("collector", "sampler", "transition with its plan"),
    ("planner", "latent", "candidates [N, H, A]"),
    ("latent", "planner", "return table [N, D, F, V]"),
    ("latent", "model", "latent, action"),
    ("sampler", "reanalyze", "batch [B, T]"),
    ("reanalyze", "loss", "batch with fresh plans"),
    ("reanalyze", "sampler", "fresh plans, written back"),
    ("model", "loss", "predictions"),
    ("loss", "updater", "loss_* terms"),
    ("updater", "model", "new weights,\ntarget weights"),
)
COLOURS = {
    "envs": "#dcecd9",
    "collectors": "#dcecd9",
    "planners": "#d8e6f5",
    "modules": "#f7e6c8",
    "replay": "#e7def2",
    "objectives": "#f6d9d9",
    "training": "#f6d9d9",
}


def dot() -> str:
    """The figure as text of graphviz."""
    lines = [
        "digraph data_flow {",
        'graph [bgcolor=white, pad=0.2, ranksep=0.55, nodesep=0.4, fontname="sans-serif"]',
        'node [shape=box, style="rounded,filled", color="#555555", fontname="sans-serif", fontsize=12]',
        'edge [color="#555555", fontname="sans-serif", fontsize=10]',
    ]
    for key, (part, room, what) in BOXES.items():
        lines.append(
            f'{key} [fillcolor="{COLOURS[room]}", '
            f'label=<<b>{part.__name__}</b><br/>{what}<br/><font point-size="9">{room}/</font>>]'
        )
    for start, end, label in ARROWS:
        text = label.replace("\n", "\\n")
        lines.append(f'{start} -> {end} [label="{text}"]')
    return "\n".join([*lines, "}"]) + "\n"


def digest() -> str:
    """Of the text, written into the picture that was drawn of it."""
    return hashlib.sha256(dot().encode()).hexdigest()


if __name__ == "__main__":
    drawn = subprocess.run(["dot", "-Tsvg"], input=dot(), capture_output=True, text=True, check=True).stdout
    SVG.write_text(drawn.rstrip() + f"\n<!-- {digest()} -->\n", encoding="utf-8")
    print(f"wrote {SVG}")
