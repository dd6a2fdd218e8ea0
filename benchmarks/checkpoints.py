"""What a checkpoint costs at a million transitions: seconds that training waits, and bytes on disk.

    python benchmarks/checkpoints.py

Fills a buffer with a million rows as humanoid's collector writes them and saves it; then, before every further save,
adds 25,000 rows and refreshes 150,000 targets, drawn with repetition, as reanalyze does in 25,000 decisions of UTD 1.
Writes `benchmarks/results/<cpu or gpu>/checkpoints.json`.
"""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from pathlib import Path

import torch
from memory import HUMANOID, MILLION, RESULTS, humanoid_row

from torchrl_etdmpc.checkpoints import CheckpointStore
from torchrl_etdmpc.runs import library_versions
from torchrl_etdmpc.training import AgentFile, BestAgent, TrainConfig, build_agent, build_replay, preset, row_bytes

NEW_ROWS, REFRESHED, SAVES = 25_000, 150_000, 6


def main() -> None:
    values = preset("efficient-tdmpc").to_dict()
    values |= {"task": "humanoid-walk", "total_env_steps": 2 * MILLION, "compile": "off"}
    config = TrainConfig.from_dict(values)
    agent, buffer, row = build_agent(config, *HUMANOID), build_replay(config, sizes=HUMANOID), humanoid_row()

    def write(count: int) -> None:
        for _ in range(count // 5000):
            rows = row.expand(5000).clone()
            rows["observation"].normal_()
            rows["plan", "version"].fill_(int(agent.world_model.version))
            buffer.extend(rows)
            agent.world_model.version += 5000

    def refresh(count: int) -> None:
        index = torch.randint(len(buffer), (count,)).unique()
        patch = {("plan", "loc"): torch.randn(len(index), HUMANOID[1])}
        patch["plan", "version"] = torch.full((len(index), 1), int(agent.world_model.version))
        buffer.update_if_present(index=index, generation=buffer.writer.generations_of(index), patch=patch)

    write(MILLION)
    seconds, sizes = [], []
    with tempfile.TemporaryDirectory() as folder:
        store, file = CheckpointStore(Path(folder)), AgentFile(agent, config, dict)
        best = BestAgent(file, Path(folder) / "best.pt")
        best.note(0.0)
        parts = {"agent": file, "best": best}
        for number in range(SAVES + 1):
            if number:
                write(NEW_ROWS)
                refresh(REFRESHED)
            tick = time.perf_counter()
            store.save(number, parts, buffer)
            seconds.append(time.perf_counter() - tick)
            sizes.append(sum(file.stat().st_size for file in (Path(folder) / "replay").iterdir()))
        other = build_replay(config, sizes=HUMANOID)
        tick = time.perf_counter()
        store.load(parts, other)
        load = time.perf_counter() - tick
        assert (other.storage[:] == buffer.storage[:]).all()
    arithmetic = MILLION * row_bytes(*HUMANOID)
    answer = {
        "rows": MILLION,
        "new_rows_per_save": NEW_ROWS,
        "refreshed_per_save": REFRESHED,
        "first_save_s": seconds[0],
        "median_later_save_s": statistics.median(seconds[1:]),
        "longest_later_save_s": max(seconds[1:]),
        "load_s": load,
        "arithmetic_mb": arithmetic / 1e6,
        "replay_files_mb": [round(size / 1e6, 1) for size in sizes],
        "largest_over_arithmetic": max(sizes) / arithmetic,
        "versions": library_versions(),
    }
    folder = RESULTS / ("gpu" if torch.cuda.is_available() else "cpu")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "checkpoints.json").write_text(json.dumps(answer, indent=1) + "\n")
    print(json.dumps(answer, indent=1))


if __name__ == "__main__":
    main()
