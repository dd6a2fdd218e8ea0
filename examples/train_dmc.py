"""Trains EfficientTDMPC on a DeepMind Control task.

    python examples/train_dmc.py task=walker-walk preset=efficient-tdmpc-utd4 seed=1 total_env_steps=200000

Every setting of a preset can be overridden (`planner.horizon=4 optim.lr=1e-3`); `--cfg job` prints them all.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "disable")  # MuJoCo looks for a renderer when it is imported; training needs none

import torch  # noqa: E402

from torchrl_etdmpc.envs import make_dmc_env  # noqa: E402
from torchrl_etdmpc.training import (  # noqa: E402
    EXIT_CODE,
    CheckpointStore,
    RunInterrupted,
    RunLog,
    TrainConfig,
    TrainingRun,
    explicit_settings,
    hydra_main,
    read_run_config,
    resolve_device,
    resumed_config,
)


@hydra_main(config_path=str(Path(__file__).resolve().parent / "config"), config_name="train")
def main(config: TrainConfig) -> None:
    """One run, from an empty directory, or from where it was stopped, to `summary.json`."""
    run_dir = Path(config.run_dir or f"runs/{config.task}/{config.preset}/seed{config.seed}")
    resume = config.resume == "on" or (config.resume == "auto" and CheckpointStore(run_dir / "checkpoints").exists())
    begun = resume or (config.resume == "auto" and (run_dir / "config.yaml").exists())  # perhaps killed very early
    if begun:
        saved = read_run_config(run_dir)
        config = resumed_config(saved, config, explicit_settings())
        if (run_dir / "summary.json").exists() and config.total_env_steps <= saved.total_env_steps:
            print(f"{run_dir} is finished; nothing to do")
            return
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    resolve_device(config.device)  # an error now leaves no run directory behind
    torch.set_float32_matmul_precision("high")
    torch.manual_seed(config.seed)
    env = make_dmc_env(config.task, seed=config.seed, num_envs=config.num_envs)
    eval_env = make_dmc_env(config.task, seed=config.seed + 10_000, num_envs=config.eval_episodes, parallel=False)
    log = (RunLog.reopen if begun else RunLog.create)(
        run_dir, config=config.to_dict(), logger=config.logger, total_env_steps=config.total_env_steps
    )
    if begun and not resume:
        log.start_over()
    try:
        summary = TrainingRun(config, env=env, eval_env=eval_env, log=log, resume=resume).run()
    except RunInterrupted as stop:
        log.close()
        print(stop)
        sys.exit(EXIT_CODE)
    print(
        f"{config.task}: return {summary['final_return']:.1f} after {summary['env_steps']} env steps in "
        f"{summary['wall_time_s']:.0f} s; curve, tables and checkpoint are in {log.run_dir}"
    )


if __name__ == "__main__":
    main()
