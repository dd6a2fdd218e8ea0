"""Trains EfficientTDMPC with workers: they plan and step in processes of their own while one learner updates.

    python examples/distributed.py task=gym/Pendulum-v1 preset=cpu total_env_steps=10000 workers=2
    python examples/distributed.py task=walker-walk preset=cpu workers=2 engine=ray
    python examples/distributed.py task=walker-walk preset=cpu workers=16 engine=ray address=10.0.0.1:6379

`engine=multi` is TorchRL's MultiAsyncCollector, `engine=ray` its RayCollector, on a cluster of this machine or at
`address=`. The learner has buffer, reanalyze and updates, and sends its weights on. Settings, files and evaluations are
those of train.py. What is lost against it: a decision is made with weights that are some updates old (`weight_age` in
`train.csv`, in updates; `target_age` is that of the plans), a row is stored when its batch arrives, no two runs are the
same, and a run that goes on does so with fresh episodes. The code is `torchrl_etdmpc/commands/distributed.py`.
"""

from __future__ import annotations

from torchrl_etdmpc.commands import main

if __name__ == "__main__":
    main("distributed")
