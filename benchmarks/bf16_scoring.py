"""What scoring candidates in bfloat16 changes: elites and scores on trained weights, and learning over three seeds.

    python benchmarks/bf16_scoring.py                 # three runs of 50,000 env steps, two at a time
    python benchmarks/bf16_scoring.py --report-only   # from the committed curves

Trains the cpu preset with bfloat16 for acting and reanalyze and sets the curves beside those of `width-64`
(float32, same seeds); then plans from states of an evaluation episode with both dtypes, the trained weights and the
same noise. Writes `benchmarks/results/cpu/bf16/`: `seed<k>/eval.csv`, `scores.json` and `README.md`.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
import torch
from cpu_learning import RESULTS, SEEDS, run
from sized import FORMER_CPU

from torchrl_etdmpc.collectors import evaluate
from torchrl_etdmpc.envs import make_env
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.training import load_agent

FOLDER = RESULTS / "bf16"
TASK, ENV_STEPS = "walker-stand", 50_000
HALF = ("planner.scoring_dtype=bfloat16", "reanalyze.scoring_dtype=bfloat16")
SIZES = ("model.latent_dim=64", "model.mlp_dim=64", *FORMER_CPU)  # of the runs in float32
EVERY = 10  # of the states of an evaluation episode are planned from


def compare(checkpoint: Path) -> dict[str, float]:
    """Scores, elites and actions in both dtypes, from the same states with the same noise."""
    agent, _, _ = load_agent(checkpoint, compile_setting="off")
    states: list[torch.Tensor] = []
    env = make_env(TASK, seed=1000).append_transform(agent.eval_planner.make_tensordict_primer())
    torch.manual_seed(0)
    evaluate(env, agent.eval_planner, episodes=1, on_step=lambda step: states.append(step["observation"].clone()))
    env.close()
    planner = agent.planner
    observation = torch.stack(states[::EVERY])
    noise = planner.draw_noise(len(observation))
    plans = {}
    for dtype in (None, torch.bfloat16):
        planner.scoring_dtype = dtype
        plans[dtype] = planner.plan(observation, noise=noise, explore=False, trace=True)
    full, half = plans[None], plans[torch.bfloat16]
    first = [plan.trace.scores[:, 0] for plan in (full, half)]  # the only iteration in which both try the same actions
    elites = [scores.topk(planner.num_elites).indices for scores in first]
    shared = (elites[0].unsqueeze(-1) == elites[1].unsqueeze(-2)).any(-1).float().mean(-1)
    centred = [scores - scores.mean(-1, keepdim=True) for scores in first]
    correlation = torch.nn.functional.cosine_similarity(*centred, dim=-1)
    spread = first[0].std(-1)
    return {
        "states": len(observation),
        "score_correlation_mean": correlation.mean().item(),
        "score_correlation_least": correlation.min().item(),
        "elites_shared_mean": shared.mean().item(),
        "elites_shared_least": shared.min().item(),
        "score_error_over_spread": ((first[1] - first[0]).abs().mean(-1) / spread).mean().item(),
        "action_difference_mean": (full.loc - half.loc).abs().mean().item(),
    }


def report() -> str:
    """Both curves, and what the scores say."""
    curves = []
    for name, folder in (("float32", RESULTS / "width-64" / TASK), ("bfloat16", FOLDER)):
        for seed in SEEDS:
            table = pd.read_csv(RunDirectory(folder / f"seed{seed}").eval)
            curves.append(table.assign(scoring=name, seed=seed)[["scoring", "seed", "env_steps", "return_mean"]])
    table = pd.concat(curves).pivot(index=["scoring", "seed"], columns="env_steps", values="return_mean").dropna(axis=1)
    lines = [
        "# Scoring candidates in bfloat16",
        "",
        f"Made by `python benchmarks/bf16_scoring.py`: the cpu preset at half its width on {TASK}, return of every",
        "evaluation (mean of 10 episodes) by env steps; the float32 runs are those of `width-64`.",
        "",
        "| scoring | seed | " + " | ".join(map(str, table.columns)) + " |",
        "|---" * (2 + len(table.columns)) + "|",
    ]
    for (scoring, seed), row in table.iterrows():
        lines.append(f"| {scoring} | {seed} | " + " | ".join(f"{value:.0f}" for value in row) + " |")
    for scoring, rows in table.groupby(level="scoring"):
        lines.append(f"| {scoring} | mean | " + " | ".join(f"{value:.0f}" for value in rows.mean()) + " |")
    scores = json.loads((FOLDER / "scores.json").read_text())
    lines += ["", f"Trained weights, every {EVERY}th state of an evaluation episode, first iteration of a plan:", ""]
    lines += ["| seed | " + " | ".join(key.replace("_", " ") for key in scores["1"]) + " |"]
    lines += ["|---" * (1 + len(scores["1"])) + "|"]
    for seed, row in scores.items():
        lines.append(f"| {seed} | " + " | ".join(f"{value:.4g}" for value in row.values()) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--report-only", action="store_true")
    arguments = parser.parse_args()
    if not arguments.report_only:
        keep = ("eval", "summary", "last_agent")

        def train(seed: int) -> str:
            return run(TASK, seed, ENV_STEPS, *SIZES, *HALF, target=FOLDER / f"seed{seed}", keep=keep)

        with ThreadPoolExecutor(2) as pool:
            for line in pool.map(train, SEEDS):
                print(line, flush=True)
        agents = {seed: FOLDER / f"seed{seed}" / RunDirectory("").last_agent.name for seed in SEEDS}
        scores = {str(seed): compare(file) for seed, file in agents.items()}
        (FOLDER / "scores.json").write_text(json.dumps(scores, indent=1) + "\n")
        for file in agents.values():
            file.unlink()  # megabytes; the numbers are what is kept
    (FOLDER / "README.md").write_text(report())
    print(f"written: {FOLDER / 'README.md'}")


if __name__ == "__main__":
    main()
