"""Collects what the benchmarks measured in ``results/<device>/speed.{json,md}``."""

from __future__ import annotations

import json
import re
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from torchrl_etdmpc.runs import library_versions, processor

CUDA = torch.cuda.is_available()
RESULTS = Path(__file__).parent / "results" / ("gpu" if CUDA else "cpu")
PRODUCT_SIZE = 8192 if CUDA else 2048
ROWS = pytest.StashKey[list]()


def pytest_configure(config: pytest.Config) -> None:
    sys.path.insert(0, str(Path(__file__).parent))
    config.stash[ROWS] = []
    torch.set_float32_matmul_precision("high")


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)  # every time: closing a batched environment of TorchRL changes it


class Measure:
    """Times a call with pytest-benchmark and keeps the row."""

    def __init__(self, benchmark, rows: list[dict]) -> None:
        self.benchmark, self.rows = benchmark, rows

    @staticmethod
    def flop(call: Callable[[], object]) -> int:
        """Floating point operations of the matrix products of one call."""
        with FlopCounterMode(display=False) as counter:
            call()
        return counter.get_total_flops()

    def __call__(
        self,
        case: str,
        variant: str,
        call: Callable[[], object],
        *,
        rounds: int,
        warmup_rounds: int = 2,
        calls: int = 1,
        flop: int | None = None,
        baseline: str = "eager",
    ) -> None:
        """Keeps the median time of ``call``, divided by how many ``calls`` of the case it makes."""

        def timed() -> None:
            call()
            if CUDA:
                torch.cuda.synchronize()

        products = [] if flop is None else time_products()
        self.benchmark.pedantic(timed, rounds=rounds, warmup_rounds=warmup_rounds)
        median = self.benchmark.stats.stats.median / calls
        row = {"case": case, "variant": variant, "threads": torch.get_num_threads(), "median_ms": 1000 * median}
        row["gflop"] = None if flop is None else flop / 1e9
        if flop is None:
            row["of_limit"] = None
        else:  # before and after, because the speed of a shared machine changes within minutes
            limit = 2 * PRODUCT_SIZE**3 / statistics.median(products + time_products())
            row["of_limit"] = flop / median / limit
        row["baseline"] = baseline
        known = [other["median_ms"] for other in self.rows if other["case"] == case and other["variant"] == baseline]
        row["ratio"] = 1.0 if variant == baseline else known[0] / row["median_ms"] if known else None
        self.rows.append(row)


def time_products() -> list[float]:
    """Seconds of each of some large matrix products, on this many threads."""
    left, right = (torch.randn(PRODUCT_SIZE, PRODUCT_SIZE, device="cuda" if CUDA else "cpu") for _ in range(2))
    times = []
    for _ in range(6):
        tick = time.perf_counter()
        left @ right
        if CUDA:
            torch.cuda.synchronize()
        times.append(time.perf_counter() - tick)
    return times[1:]


@pytest.fixture
def measure(benchmark, request: pytest.FixtureRequest) -> Measure:
    return Measure(benchmark, request.config.stash[ROWS])


def pytest_sessionfinish(session: pytest.Session) -> None:
    rows = session.config.stash[ROWS]
    if not rows:
        return
    file = RESULTS / "speed.json"
    about = {
        "device": torch.cuda.get_device_name() if CUDA else processor(),
        "versions": library_versions(),
    }
    done = {(row["case"], row["variant"]) for row in rows}
    old = json.loads(file.read_text()) if file.exists() else []
    rows = [row for row in old if (row["case"], row["variant"]) not in done] + [row | about for row in rows]
    RESULTS.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(rows, indent=1) + "\n")
    write_speed_table(rows)
    write_plan_table()


def write_speed_table(rows: list[dict[str, Any]]) -> None:
    """Every row that was measured, in ``speed.md``."""
    machines = {
        f"{row['device']}; {', '.join(f'{name} {number}' for name, number in row['versions'].items())}" for row in rows
    }
    lines = [
        "# Speed",
        "",
        f"Made by `make bench` on {'. Some rows on '.join(sorted(machines))}.",
        "Medians; `of limit` is the share of the speed of large matrix products just before and after. The ratio is",
        "the baseline's time over this one, both of one process.",
        "",
        "| case | variant | threads | ms | GFLOP | of limit | baseline | ratio |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in sorted(rows, key=lambda row: row["case"]):
        cells = [row["case"], row["variant"], row["threads"], three_digits(row["median_ms"])]
        cells += ["" if row["gflop"] is None else three_digits(row["gflop"])]
        cells += ["" if row["of_limit"] is None else f"{row['of_limit']:.2f}", row["baseline"]]
        cells += ["" if row["ratio"] is None else f"{row['ratio']:.2f}"]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    (RESULTS / "speed.md").write_text("\n".join(lines) + "\n")


def three_digits(number: float) -> str:
    """Three significant digits, without an exponent: 0.0123, 4.67, 4,670."""
    return f"{float(f'{number:.3g}'):,.10g}"


def write_plan_table() -> None:
    """The plans of every size on every device that was measured, in ``benchmarks/README.md``."""
    pattern = re.compile(r"plan of (\d+), (\d) heads, horizon (\d), (\d+) samples")
    lines = ["| device | variant | states | heads | horizon | samples | ms | ms per state | of the limit |"]
    lines += ["|---" * 9 + "|"]
    for file in sorted(RESULTS.parent.glob("*/speed.json")):
        for row in json.loads(file.read_text()):
            if match := pattern.fullmatch(row["case"]):
                sizes = [int(number) for number in match.groups()]
                milliseconds = [three_digits(row["median_ms"]), three_digits(row["median_ms"] / sizes[0])]
                cells = [
                    row["device"],
                    row["variant"],
                    *sizes,
                    *milliseconds,
                    "" if row["of_limit"] is None else f"{row['of_limit']:.2f}",
                ]
                lines.append("| " + " | ".join(map(str, cells)) + " |")
    readme = Path(__file__).parent / "README.md"
    begin, end = "<!-- plan table: written by make bench -->\n", "<!-- end -->"
    head, rest = readme.read_text().split(begin)
    readme.write_text(head + begin + "\n".join(lines) + "\n" + rest[rest.index(end) :])
