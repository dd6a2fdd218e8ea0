from __future__ import annotations

import csv
import io
import json
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")
pytest.importorskip("scipy")

from matplotlib.figure import Figure  # noqa: E402
from PIL import Image  # noqa: E402

from torchrl_etdmpc.commands import report_runs  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "examples" / "report.py"
HEADER = "env_steps,decision_steps,updates,wall_time_s,return_mean,return_std,episodes\n"
PER_SEED = "method,task,seed,env_steps,return_mean\n"
FILES = {
    "auc.csv",
    "auc.md",
    "final.csv",
    "final.md",
    "index.md",
    "curves.png",
    "aggregate.png",
    "auc.png",
    "returns.csv",
}
# Evaluations at 0 and 100,000 env steps: the number of the seed with 00 and with 50 behind it.
ROWS = "".join(f"{steps},{steps // 2},7,1.0,{{seed}}{steps // 2000:02d},0.5,10\n" for steps in (0, 100_000))

ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
ENVIRONMENT |= {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}


def make_run(
    path: str, *, task: str = "walker-walk", preset: str = "cpu", seed: int = 1, text: str | None = None
) -> Path:
    run = Path(path)
    run.mkdir(parents=True)
    (run / "config.yaml").write_text(f"task: {task}\npreset: {preset}\nseed: {seed}\n")
    (run / "eval.csv").write_text(HEADER + ROWS.format(seed=seed) if text is None else text)
    (run / "summary.json").write_text("{}")  # it is finished
    return run


def make_baseline(path: str = "baseline.csv", *, method: str = "BMPC") -> str:
    rows = [f"{method},walker-walk,{steps},{steps / 2000},1.0,5\n" for steps in (0, 10_000, 20_000, 100_000, 200_000)]
    Path(path).write_text("method,task,env_steps,mean,standard_error,seeds\n" + "".join(rows))
    return path


def read_table(path: Path) -> dict[str, dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return {row.pop("task"): row for row in csv.DictReader(file)}


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MUJOCO_GL", "disable")  # the script sets it where it is not set; this restores it


@pytest.fixture
def pictures() -> None:
    """Reports with the pictures that a user gets."""


@pytest.fixture(autouse=True)
def quick_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a few dots where a test does not ask for ``pictures``: to draw them takes most of a report's time."""
    if "pictures" not in request.fixturenames:
        monkeypatch.setattr(Figure, "savefig", lambda figure, file, **_: Image.new("RGB", (4, 4)).save(file, "png"))


@pytest.fixture
def run_main(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Runs the command in this process."""

    def run(*arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), *arguments])
        runpy.run_path(str(SCRIPT), run_name="__main__")

    return run


@pytest.fixture
def refused(run_main: Callable[..., None], capfd: pytest.CaptureFixture) -> Callable[..., str]:
    """Runs the command, which must fail with one line and no report; returns the line without "error: "."""

    def run(*arguments: str) -> str:
        before = {path for path in Path().rglob("*")}
        with pytest.raises(SystemExit) as caught:
            run_main(*arguments)
        assert isinstance(caught.value.code, str)  # Python prints it on stderr and exits with 1
        assert capfd.readouterr() == ("", "")
        assert set(Path().rglob("*")) == before
        (line,) = caught.value.code.splitlines()
        assert line.startswith("error: ")
        return line.removeprefix("error: ")

    return run


def test_one_command_in_an_empty_folder_compares_runs_with_the_published_baselines(run_script):
    for seed in (1, 2):
        make_run(
            f"runs/{seed}", seed=seed, text=HEADER + ROWS.format(seed=seed) + f"200000,100000,7,1.0,{seed}00,0,1\n"
        )
    process = run_script("report.py", "runs", cwd=Path.cwd())
    closing = "2 runs on 1 task of Easy DMC, up to 200,000 env steps; the report is report/index.md\n"
    assert (process.returncode, process.stdout, process.stderr) == (0, closing, "")
    assert {path.name for path in Path("report").iterdir()} == FILES
    row = read_table(Path("report", "final.csv"))["walker-walk"]
    assert float(row["cpu"]) == 150
    assert float(row["cpu standard_error"]) == pytest.approx(50)
    assert {"BMPC", "TD-MPC2", "SAC", "DreamerV3"} < set(row)
    assert float(read_table(Path("report", "final.csv"))["Normalized aggregate"]["BMPC"]) == 1


def test_a_path_that_does_not_exist_is_one_line_on_stderr_of_the_real_command(run_script):
    process = run_script("report.py", "nowhere", "--out", "made", cwd=Path.cwd())
    told = "error: no such run directory: nowhere.\n"
    assert (process.returncode, process.stdout, process.stderr) == (1, "", told)
    assert not Path("made").exists()


def test_watching_follows_a_run_survives_a_half_written_row_and_ends_at_an_interrupt(tmp_path, start):
    row = lambda steps, value: f"{steps},{steps // 2},7,1.0,{value},0.5,10\n"  # noqa: E731
    run = make_run("runs/one", text=HEADER + row(0, 1.0) + row(10_000, 5.0))
    (run / "summary.json").unlink()
    options = ("--budget", "20000", "--grid-step", "10000", "--reference", make_baseline(), "--watch", "0.5")
    process = start("report.py", "runs", *options, cwd=tmp_path)

    def wait_for_reports(count: int) -> list[str]:
        deadline = time.monotonic() + 300
        while len(lines := process.printed().splitlines()) < count:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline, "the report does not follow the run"
            time.sleep(0.1)
        assert len(lines) == count
        return lines

    try:
        assert "1 run on 1 task of Easy DMC, up to 10,000 env steps" in wait_for_reports(1)[0]
        assert read_table(Path("report", "final.csv"))["walker-walk"]["cpu"] == ""
        half, rest = row(20_000, 77.5)[:-11], row(20_000, 77.5)[-11:]
        assert half.endswith(",7")
        with (run / "eval.csv").open("a") as file:
            file.write(half)
        assert "up to 10,000 env steps" in wait_for_reports(2)[1]
        assert read_table(Path("report", "final.csv"))["walker-walk"]["cpu"] == ""
        with (run / "eval.csv").open("a") as file:
            file.write(rest)
        assert "up to 20,000 env steps" in wait_for_reports(3)[2]
        assert float(read_table(Path("report", "final.csv"))["walker-walk"]["cpu"]) == 77.5
        assert "not finished, ends at 20,000 env steps" in Path("report", "index.md").read_text()
        (run / "summary.json").write_text("{}")  # written after the last row
        assert "unfinished" not in wait_for_reports(4)[3]
        assert "not finished" not in Path("report", "index.md").read_text()
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
        assert (process.returncode, err) == (130, "")
    finally:
        process.kill()
    assert {path.name for path in Path("report").iterdir()} == FILES
    assert not list(Path().glob(".report*"))


def test_watching_waits_for_what_is_not_there_yet_and_tries_again_what_failed(monkeypatch, run_main, capfd):
    def block() -> None:
        make_run("runs/one")
        Path("report").write_text("mine")

    def interrupt() -> None:
        raise KeyboardInterrupt

    between, pauses = iter([block, Path("report").unlink, interrupt]), []

    def sleep(seconds: float) -> None:
        pauses.append(seconds)
        next(between)()

    Path("runs").mkdir()
    monkeypatch.setattr(time, "sleep", sleep)
    with pytest.raises(SystemExit, match="^130$"):
        run_main("runs", "--reference", "--watch")
    out, err = capfd.readouterr()
    assert out.startswith("1 run on 1 task of Easy DMC") and out.count("\n") == 1
    missing, blocked = err.splitlines()
    assert missing.startswith("waiting: no runs found in runs;")
    assert blocked == "waiting: report is a file; name a folder."
    assert pauses == [30.0] * 3


def test_watching_ends_when_nobody_reads_it_any_more(monkeypatch, run_main):
    class Gone(io.TextIOWrapper):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    def sleep(seconds: float) -> None:
        raise AssertionError("it goes on")

    make_run("runs/one")
    monkeypatch.setattr(time, "sleep", sleep)
    with open("stdout", "wb") as file:
        monkeypatch.setattr(sys, "stdout", Gone(file))
        with pytest.raises(SystemExit, match="^141$"):
            run_main("runs", "--reference", "--watch")


@pytest.mark.parametrize("name", ["config.yaml", "eval.csv", "summary.json", "experiment.yaml"])
def test_watching_notices_what_a_report_reads(name):
    root = make_experiment()
    runs = [str(root)]
    before = report_runs.stamp(runs)
    assert report_runs.stamp(runs) == before
    file = next(path for path in (root / name, root / "a" / "walker-walk" / "seed1" / name) if path.exists())
    file.write_text(file.read_text() + "\n")
    changed = report_runs.stamp(runs)
    assert changed != before
    os.utime(file, (0, 0))  # as when it is written again with as many characters
    assert report_runs.stamp(runs) != changed


def test_names_make_methods_of_folders_and_options_are_obeyed(pictures, run_main, capfd):
    for name in ("a", "b"):
        make_run(f"runs/{name}")
    make_run("runs/=c", preset="utd4")  # a path that exists is a path, whatever it is called
    options = ("--budget", "100000", "--grid-step", "50000", "--vector", "pdf", "--out", "deep/er")
    run_main("first=runs/a", "runs/=c", "second=runs/b", "--reference", make_baseline(), *options)
    out, err = capfd.readouterr()
    assert out == "3 runs on 1 task of Easy DMC, up to 100,000 env steps; the report is deep/er/index.md\n"
    assert err == ""
    more = {"curves.pdf", "aggregate.pdf", "auc.pdf", "paired.csv"}
    assert {path.name for path in Path("deep", "er").iterdir()} == FILES | more
    header = Path("deep", "er", "auc.md").read_text().splitlines()[0]
    assert header == "| task | first | utd4 | second | BMPC |"
    assert "Evaluation grid of the AUC: 0 to 100,000 every 50,000" in Path("deep", "er", "index.md").read_text()


def test_without_baselines_all_tasks_of_a_named_benchmark_are_rows(run_main, capfd):
    make_run("runs/walker")
    make_run("runs/dog", task="dog-run")
    run_main("runs", "--benchmark", "dmc-hard", "--all-tasks", "--budget", "100000", "--reference")
    assert capfd.readouterr().out.startswith("1 run on 7 tasks of Hard DMC")
    table = read_table(Path("report", "final.csv"))
    assert len(table) == 7 + 1
    assert float(table["dog-run"]["cpu"]) == 150  # the one at 100,000 env steps
    assert "No return of BMPC to normalise by on" in Path("report", "index.md").read_text()


def test_a_path_that_does_not_exist_is_refused(refused):
    make_run("runs/a")
    assert refused("runs/a", "runs/b") == "no such run directory: runs/b."
    assert refused("mine=runs/b") == "no such run directory: runs/b."


def test_tasks_of_no_benchmark_are_reported_alone_or_left_out(run_main, refused, capfd):
    make_run("runs/a", task="h1-walk")  # of HumanoidBench, and not one of the thirteen
    assert refused("runs", "--benchmark", "dmc-easy") == "no run on a task of dmc-easy; the runs are on h1-walk."
    make_run("more/b", task="registered")
    run_main("runs", "more", "--reference")
    assert capfd.readouterr().out.startswith("2 runs on 2 tasks of no benchmark")
    make_run("runs/c")
    expected = "h1-walk is of no benchmark, other runs are; report them apart, or pass --benchmark."
    assert refused("runs") == expected
    run_main("runs", "--benchmark", "dmc-easy", "--reference")
    assert capfd.readouterr().out.startswith("1 run on 1 task of Easy DMC")


def test_an_unknown_benchmark_is_refused_with_the_names_of_those_there_are(refused):
    make_run("runs/a")
    message = refused("runs", "--benchmark", "atari")
    assert message == "unknown benchmark 'atari'; choose one of dmc-easy, dmc-hard, humanoidbench-hard."


def test_runs_of_two_benchmarks_are_refused_without_the_name_of_one(refused):
    make_run("runs/a")
    make_run("runs/b", task="dog-run")
    assert "walker-walk is of dmc-easy, dog-run is of dmc-hard" in refused("runs")


def test_a_benchmark_of_none_of_the_runs_is_refused(refused):
    make_run("runs/a")
    assert refused("runs", "--benchmark", "dmc-hard") == "no run on a task of dmc-hard; the runs are on walker-walk."


def test_runs_that_have_not_evaluated_yet_are_refused(refused):
    make_run("runs/a", text=HEADER)
    assert refused("runs").startswith("no evaluation after 0 env steps in any of the runs yet")


@pytest.mark.parametrize(
    "text, message",
    [
        (HEADER + "1000,1000,1,1,1,1,1\n", "mixes units"),
        ("\0\1\2\n\3\n", "eval.csv"),
    ],
)
def test_a_run_whose_table_is_not_one_is_refused(refused, text, message):
    run = make_run("runs/a", text=text)
    assert message in (error := refused("runs"))
    assert str(run / "eval.csv") in error


def test_a_baseline_that_does_not_exist_or_is_none_is_refused(refused):
    make_run("runs/a")
    assert refused("runs", "--reference", "mine.csv") == "no such file of learning curves: mine.csv."
    Path("mine.csv").write_bytes(bytes(range(256)) * 8)
    assert "mine.csv" in refused("runs", "--reference", "mine.csv")


def test_the_same_method_task_and_seed_twice_is_refused_whether_the_name_is_given_or_not(refused):
    make_run("runs/a")
    make_run("runs/b")
    expected = (
        "two runs of cpu on walker-walk with seed 1: runs/a and runs/b; leave one out, or give one of them a name of "
        "its own."
    )
    assert refused("runs") == refused("runs/a", "cpu=runs/b", "--reference") == expected


def test_a_seed_in_two_baseline_files_does_not_count_twice(refused):
    make_run("runs/a")
    for name in ("one.csv", "two.csv"):
        Path(name).write_text(
            PER_SEED + "".join(f"x,walker-walk,{seed},{t},{seed}\n" for seed in (1, 2) for t in (0, 200_000))
        )
    assert "walker-walk" in refused("runs", "--reference", "one.csv", "two.csv")


def test_a_run_with_the_name_of_a_baseline_is_refused(refused):
    make_run("runs/a", preset="BMPC")
    message = "BMPC names both runs and a baseline; give the runs another name (NAME=PATH)."
    assert refused("runs") == message
    assert refused("runs", "--reference", make_baseline()) == message


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("--grid-step", "-5"), "--grid-step must be positive, got -5."),
        (("--grid-step", "0"), "--grid-step must be positive, got 0."),
        (("--budget", "-1"), "--budget must be positive, got -1."),
        (("--grid-start", "0"), "--grid-start must be positive, got 0."),
        (("--budget", "1"), "--budget=1 has no grid of equal steps; take 2."),
        (("--watch", "0"), "--watch must be positive, got 0."),
        (("--watch", "nan"), "--watch must be a number of seconds below 1e+09, got nan."),
        (("--watch", "inf"), "--watch must be a number of seconds below 1e+09, got inf."),
        (("--out", ""), "--out must not be empty; leave it out for report."),
        (("",), "runs are PATH or NAME=PATH, and neither may be empty, got ''."),
        (("a=",), "runs are PATH or NAME=PATH, and neither may be empty, got 'a='."),
        (("=runs",), "runs are PATH or NAME=PATH, and neither may be empty, got '=runs'."),
        (("--grid-step", "1"), "--grid-step=1 makes more than 1,000 points of "),
        (
            ("--budget", "100500", "--grid-step", "1"),
            "--grid-step=1 makes more than 1,000 points of 100,500 env steps; take 101 or more.",
        ),
        (("--budget", f"{10**18}"), "--grid-step=100000 makes more than 1,000 points of 1,000,000,000,000,000,000 env"),
        (("--budget", f"{10**400}"), "--grid-step=100000 makes more than 1,000 points of 1"),
        (("--grid-step", "300000"), "the grid needs at least two steps"),
        (("--budget", "250000", "--grid-step", "100000"), "the budget must be a multiple of the grid step"),
    ],
)
def test_an_option_that_makes_no_sense_is_refused(refused, arguments, message):
    make_run("runs/a")
    assert refused("runs", *arguments).startswith(message)


def test_a_run_with_the_name_of_a_quoted_method_is_refused(refused):
    make_run("runs/a")
    assert refused("MR.Q=runs/a") == ("MR.Q names both runs and a baseline; give the runs another name (NAME=PATH).")


def test_the_traceback_can_be_asked_for(run_main, monkeypatch):
    monkeypatch.setenv("TORCHRL_ETDMPC_TRACEBACK", "1")
    with pytest.raises(OSError, match="nowhere"):
        run_main("nowhere")


def test_a_baseline_of_unknown_seeds_shows_no_nan(run_main):
    make_run("runs/a")
    text = Path(make_baseline()).read_text().replace("standard_error,seeds", "standard_error").replace(",5\n", "\n")
    Path("baseline.csv").write_text(text)
    run_main("runs", "--reference", "baseline.csv")
    page = Path("report/index.md").read_text()
    assert "| walker-walk | BMPC | 50.0 | – | 1.0 | 48.0 to 52.0 | ? |" in page
    assert "nan" not in page


@pytest.mark.parametrize(
    "text",
    ["", "task: walker-walk\npreset: cpu\nseed: 1\na: &a {x: 1}\nb: {y: *a, z: *a}\n"],
)
def test_a_broken_configuration_is_refused(refused, text):
    (make_run("runs/a") / "config.yaml").write_text(text)
    assert refused("runs") == "runs/a/config.yaml does not give the run's task, preset and seed."


def test_an_output_that_is_a_file_is_refused_and_stays(refused):
    make_run("runs/a")
    Path("report").write_text("mine")
    assert "report" in refused("runs", "--reference", make_baseline(), "--budget", "100000")
    assert Path("report").read_text() == "mine"


def test_a_wrong_benchmark_ends_a_watch_before_it_begins(refused):
    make_run("runs/a")
    assert refused("runs", "--watch", "--benchmark", "atari").startswith("unknown benchmark 'atari'; choose one of ")


def test_runs_of_different_lengths_are_compared_at_the_largest_budget_that_all_reach(run_main, capfd):
    make_run("runs/a")
    make_run("runs/b", seed=2, text=HEADER + ROWS.format(seed=2) + "200000,100000,7,1.0,70,0,1\n")
    run_main("runs", "--reference")
    out, err = capfd.readouterr()
    assert out == (
        "2 runs on 1 task of Easy DMC, up to 200,000 env steps, compared at 100,000, which all of them reach (the "
        "benchmark's budget is 200,000); 1 missing or unfinished (cpu on walker-walk with seed 1: ends at 100,000 env "
        "steps, others at 200,000); the report is report/index.md\n"
    )
    assert err == ""
    assert float(read_table(Path("report", "final.csv"))["walker-walk"]["cpu"]) == 200


def test_a_short_run_has_a_report_without_dashes(run_main, capfd):
    rows = (f"{steps},{steps // 2},7,1.0,{steps // 100},0.5,10\n" for steps in range(0, 25_001, 5_000))
    make_run("runs/a", text=HEADER + "".join(rows))
    run_main("runs/a")
    assert "compared at 25,000, which all of them reach" in capfd.readouterr().out
    row = read_table(Path("report", "final.csv"))["walker-walk"]
    assert float(row["cpu"]) == 250
    assert float(row["TD-MPC"]) > 0
    assert "BMPC" not in row  # its first evaluation is at 100,000
    page = Path("report", "index.md").read_text()
    assert re.search(
        r"^- Not evaluated by 25,000 env steps on these tasks, so left out: .*BMPC \(from 100,000\)", page, re.M
    )


def test_a_run_that_has_only_begun_is_left_out_and_named(run_main, refused, capfd):
    make_run("runs/a", text=HEADER + "0,0,7,1.0,3,0.5,10\n")
    assert refused("runs") == "no evaluation after 0 env steps in any of the runs yet; wait for the first one."
    make_run("runs/b", seed=2)
    run_main("runs")
    out, err = capfd.readouterr()
    assert out == (
        "1 run on 1 task of Easy DMC, up to 100,000 env steps, compared at 100,000, which all of them reach (the "
        "benchmark's budget is 200,000); 1 missing or unfinished (cpu on walker-walk with seed 1: no evaluation "
        "after 0 env steps); the report is report/index.md\n"
    )
    assert err == ""
    # As coarse as can be, where no step is as long as it takes to the first evaluation.
    assert "grid of the AUC: 0 to 100,000 every 50,000 env steps" in Path("report", "index.md").read_text()


def test_runs_on_a_task_of_no_benchmark_say_where_they_are_compared(run_main, capfd):
    rows = [f"{steps},{steps},7,1.0,{steps // 100},0.5,10\n" for steps in range(0, 10_001, 2_000)]
    make_run("runs/a", task="gym/Pendulum-v1", text=HEADER + "".join(rows))
    make_run("runs/b", task="gym/Pendulum-v1", seed=2, text=HEADER + "".join(rows[:2]))
    run_main("runs")
    out, err = capfd.readouterr()
    assert "up to 10,000 env steps, compared at 2,000, which all of them reach; 1 missing" in out
    assert err == ""  # the files of baselines that come with the package need not fit
    Path("own.csv").write_text(PER_SEED + "".join(f"x,gym/Pendulum-v1,1,{t},{t}\n" for t in (0, 1000, 2000)))
    run_main("runs", "--reference", "own.csv")
    assert capfd.readouterr().err == ""
    assert float(read_table(Path("report", "final.csv"))["gym/Pendulum-v1"]["x"]) == 2000


def test_runs_that_end_at_the_benchmark_s_budget_have_its_usual_grid(run_main):
    rows = (f"{steps},{steps // 2},7,1.0,{steps // 100},0.5,10\n" for steps in range(50_000, 200_001, 50_000))
    make_run("runs/a", text=HEADER + "".join(rows))
    run_main("runs", "--reference")
    assert "grid of the AUC: 100,000 to 200,000 every 100,000 env steps" in Path("report", "index.md").read_text()


def test_runs_that_go_beyond_the_benchmark_s_budget_say_where_they_are_compared(run_main, capfd):
    rows = (f"{steps},{steps // 2},7,1.0,{steps // 100},0.5,10\n" for steps in range(50_000, 250_001, 50_000))
    make_run("runs/a", text=HEADER + "".join(rows))
    run_main("runs", "--reference")
    assert "up to 250,000 env steps, compared at 200,000, which all of them reach" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("last", "grid"),
    [(200_000, "50,000 to 200,000 every 50,000"), (10_007, "5,003 to 10,006 every 5,003")],  # a prime has no steps
)
def test_the_grid_of_a_task_of_no_benchmark_is_that_of_its_evaluations(run_main, last, grid):
    rows = (f"{steps},{steps},7,1.0,{steps},0.5,10\n" for steps in range(last // 4, last + 1, last // 4))
    text = "".join(rows) if last % 4 == 0 else f"2000,2000,7,1.0,3,0.5,10\n{last},{last},7,1.0,5,0.5,10\n"
    make_run("runs/exp/a/pendulum/seed1", task="gym/Pendulum-v1", text=HEADER + text)
    # Neither a plan nor a benchmark has a budget for it.
    Path("runs/exp/experiment.yaml").write_text("{variants: [a], tasks: [gym/Pendulum-v1], seeds: [1]}")
    run_main("runs", "--reference")
    assert f"grid of the AUC: {grid} env steps" in Path("report", "index.md").read_text()


def test_a_budget_of_one_usual_step_has_a_finer_grid(run_main):
    rows = (f"{steps},{steps // 2},7,1.0,{steps // 100},0.5,10\n" for steps in range(0, 100_001, 20_000))
    make_run("runs/a", text=HEADER + "".join(rows))
    run_main("runs", "--reference", "--budget", "100000")
    assert "grid of the AUC: 0 to 100,000 every 20,000 env steps" in Path("report", "index.md").read_text()


def test_a_budget_that_the_usual_step_does_not_divide_has_another_one(run_main):
    rows = (f"{steps},{steps // 2},7,1.0,{steps // 100},0.5,10\n" for steps in range(0, 250_001, 50_000))
    make_run("runs/a", text=HEADER + "".join(rows))
    run_main("runs", "--budget", "250000", "--reference")
    assert float(read_table(Path("report", "final.csv"))["walker-walk"]["cpu"]) == 2_500


def test_the_grid_begins_where_all_methods_do_and_its_step_is_no_shorter(run_main):
    for name, first in (("early", 0), ("late", 20_000)):
        rows = (f"{steps},{steps // 2},7,1.0,{steps // 100},0.5,10\n" for steps in range(first, 100_001, 20_000))
        make_run(f"runs/{name}", text=HEADER + "".join(rows))
    run_main("early=runs/early", "late=runs/late")
    assert "grid of the AUC: 20,000 to 100,000 every 20,000 env steps" in Path("report", "index.md").read_text()


def test_a_small_budget_needs_no_step_of_the_grid(run_main, capfd):
    rows = (f"{steps},{steps // 2},7,1.0,{steps // 100},0.5,10\n" for steps in range(0, 25_001, 5_000))
    make_run("runs/a", text=HEADER + "".join(rows))
    run_main("runs", "--budget", "20000", "--reference")
    assert float(read_table(Path("report", "final.csv"))["walker-walk"]["cpu"]) == 200


def test_a_file_in_the_place_of_the_report_is_named(monkeypatch, tmp_path, refused):
    make_run("runs/a")
    Path("notes.txt").write_text("mine")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert refused("runs", "--out", "~/notes.txt") == "--out=~/notes.txt is a file; name a folder."
    assert refused("runs", "--out", "notes.txt") == "--out=notes.txt is a file; name a folder."


@pytest.mark.parametrize("watch", [(), ("--watch",)])
def test_a_folder_with_files_that_a_report_would_replace_or_remove_is_named(refused, watch):
    make_run("runs/a")
    Path("paper").mkdir()
    Path("paper", "curves.svg").write_text("mine")
    assert refused("runs", "--out", "paper", *watch) == (
        "paper holds curves.svg of something other than a report, which would be lost; choose a folder of its own for "
        "the report."
    )
    assert Path("paper", "curves.svg").read_text() == "mine"


def test_a_report_that_cannot_be_written_is_named(refused):
    make_run("runs/a")
    assert refused("runs", "--out", "/proc/report") == (
        "/proc/report cannot be written (No such file or directory); choose another path."
    )


def test_an_option_that_is_written_like_a_setting_is_answered(refused):
    make_run("runs/a")
    assert refused("runs", "out=elsewhere") == (
        "out=elsewhere would call runs 'out'; an option is written --out elsewhere."
    )
    assert refused("runs", "grid-step=10").endswith("an option is written --grid-step 10.")


def test_one_broken_run_is_skipped_and_named(run_main, capfd):
    make_run("runs/a")
    make_run("runs/b", seed=2, text=HEADER + "0,0,7,1.0,much,0.5,10\n")
    lost = make_run("runs/c", seed=3)
    (lost / "config.yaml").unlink()
    (lost / "summary.json").unlink()
    run_main("runs", "--reference")
    out, err = capfd.readouterr()
    assert out.startswith("1 run on 1 task of Easy DMC")
    first, second = err.splitlines()
    assert first.startswith("skipped runs/b: runs/b/eval.csv: column return_mean must hold numbers")
    assert second == "skipped runs/c: runs/c has neither config.yaml nor summary.json, which name its task and seed."
    page = Path("report", "index.md").read_text()
    assert all(f"- {line}" in page for line in (first, second))


def test_a_finished_run_whose_evaluations_are_lost_is_named(run_main, capfd):
    make_run("runs/a")
    (make_run("runs/b", seed=2) / "eval.csv").unlink()
    run_main("runs", "--reference")
    out, err = capfd.readouterr()
    assert "1 missing or unfinished (skipped runs/b: runs/b has no eval.csv" in out
    assert err.startswith("skipped runs/b: runs/b has no eval.csv")


def test_with_a_benchmark_that_was_asked_for_only_its_runs_are_spoken_of(run_main, capfd):
    root = make_experiment()
    (make_run("runs/exp/a/dog-run/seed1", task="dog-run") / "summary.json").unlink()
    make_run("runs/exp/a/dog-walk/seed1", task="dog-walk")
    plan = json.loads((root / "experiment.yaml").read_text())
    (root / "experiment.yaml").write_text(json.dumps(plan | {"tasks": [*plan["tasks"], "dog-run", "dog-walk"]}))
    run_main("runs", "--benchmark", "dmc-easy", "--reference")
    out, err = capfd.readouterr()
    assert "missing" not in out
    assert err == "2 runs on dog-run, dog-walk, not of dmc-easy: left out\n"
    assert f"- {err[:-1]}.\n" in Path("report", "index.md").read_text()


def test_a_method_with_a_curve_and_a_quote_has_one_column(run_main):
    make_experiment()
    rows = [f"theirs,walker-walk,{step},5,1,3\n" for step in (10_000, 20_000, 50_000)]
    Path("curves.csv").write_text("method,task,env_steps,mean,standard_error,seeds\n" + "".join(rows))
    Path("points.csv").write_text("method,task,env_steps,mean,source\ntheirs,cup-catch,50000,9,a talk\n")
    run_main("runs", "--reference", "curves.csv", "--points", "points.csv")
    page = Path("report", "index.md").read_text()
    heads = [line for line in page.splitlines() if line.startswith("| task |")]
    assert heads and all(line.count("theirs") <= 1 for line in heads)
    (row,) = [line for line in page.splitlines() if line.startswith("| cup-catch") and "quoted" in line]
    assert row.endswith(" | 9 (quoted) |")


def test_without_pandas_there_is_one_line(monkeypatch, refused):
    make_run("runs/a")
    for name in [name for name in sys.modules if name.partition(".")[2].startswith("analysis")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pandas", None)
    assert refused("runs") == (
        "reports need pandas, which is not installed; run: pip install matplotlib pandas pyyaml scipy"
    )


def test_the_home_directory_may_be_short(monkeypatch, tmp_path, run_main, capfd):
    monkeypatch.setenv("HOME", str(tmp_path))
    make_run("my runs/a")
    run_main("~/my runs", "--out", "~/a report", "--reference")
    assert (tmp_path / "a report" / "index.md").is_file()
    assert report_runs.named("mine=~/my runs") == ("mine", f"{tmp_path}/my runs")
    Path("mine=runs").mkdir()
    assert report_runs.named("~/mine=runs") == (None, f"{tmp_path}/mine=runs")


def make_experiment(root: str = "runs/exp", *, seeds: tuple[int, ...] = (1, 2)) -> Path:
    """Two variants of one preset on two tasks, whole; variant ``b`` is 10 above ``a`` at every evaluation but 0."""
    for add, variant in ((0, "a"), (10, "b")):
        for task in ("walker-walk", "cup-catch"):
            for seed in seeds:
                rows = [f"{t},{t // 2},7,1.0,{t and t // 1000 + seed + add},0,1" for t in (0, 10_000, 20_000, 50_000)]
                make_run(
                    f"{root}/{variant}/{task}/seed{seed}", task=task, seed=seed, text=HEADER + "\n".join([*rows, ""])
                )
    plan = {
        "variants": {"a": {}, "b": {}},
        "tasks": ["walker-walk", "cup-catch"],
        "seeds": list(seeds),
        "budget": 50_000,
    }
    Path(root, "experiment.yaml").write_text(json.dumps(plan))
    return Path(root)


def read_rows(name: str) -> list[dict[str, str]]:
    with Path("report", name).open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_variants_of_an_experiment_are_compared_in_pairs_at_its_budget(run_main, capfd):
    make_experiment()
    run_main("runs")  # a folder above the experiment
    out, err = capfd.readouterr()
    assert err == ""
    assert out.startswith(
        "8 runs on 2 tasks of Easy DMC, up to 50,000 env steps, compared at 50,000, which all of them "
    )
    assert "missing" not in out
    rows = {row["task"]: row for row in read_rows("paired.csv")}
    assert {(row["variant"], row["base"]) for row in rows.values()} == {("b", "a")}
    assert list(rows) == ["cup-catch", "walker-walk", "Normalized aggregate"]
    for task in ("cup-catch", "walker-walk"):
        assert [float(rows[task][name]) for name in ("pairs", "difference", "lower", "upper", "improvement")] == [
            *(2, 10, 10, 10),
            1,
        ]
    page = Path("report", "index.md").read_text()
    assert "## Variants against a, paired by task and seed, at 50,000 environment steps" in page
    assert "| b | a | cup-catch | +10.0 [+10.0, +10.0] | 1.00 [1.00, 1.00] | 2 | 0 |" in page
    plan = Path("runs", "exp", "experiment.yaml")
    plan.write_text(json.dumps({**json.loads(plan.read_text()), "base": "b", "variants": {"b": {}, "a": {}}}))
    run_main("runs/exp", "--reference")
    assert [row["base"] for row in read_rows("paired.csv")] == ["b"] * 3
    assert Path("report", "auc.md").read_text().startswith("| task | b | a |")  # in the order of the plan
    plan.write_text(json.dumps({**json.loads(plan.read_text()), "base": "b", "variants": {"a": {}, "b": {}}}))
    run_main("runs/exp", "--reference")
    assert [row["base"] for row in read_rows("paired.csv")] == ["b"] * 3  # whatever the order
    run_main("runs/exp", "--paired", "a", "--reference")
    assert [row["base"] for row in read_rows("paired.csv")] == ["a"] * 3
    run_main("runs/exp", "--paired", "b", "--reference")
    assert [float(row["difference"]) for row in read_rows("paired.csv")][:2] == [-10, -10]
    plan.write_text(json.dumps({**json.loads(plan.read_text()), "base": "c", "variants": {"c": {}, "b": {}, "a": {}}}))
    run_main("runs/exp", "--reference")
    assert {row["base"] for row in read_rows("paired.csv")} == {"b"}  # the first of those that have runs
    page = Path("report", "index.md").read_text()
    assert "- The experiment's base c has no runs here.\n" in page and "c has no curve" not in page


def test_runs_below_somebody_else_s_experiment_are_no_variants_of_it(run_main, capfd):
    Path("experiment.yaml").write_text("{variants: {small: {}}, tasks: [walker-walk], seeds: [1], budget: 100000}")
    make_run("runs/walker-walk/cpu/seed1")
    make_run("runs/walker-walk/tdmpc2-cpu/seed2", preset="tdmpc2-cpu", seed=2)
    run_main("runs", "--reference")
    out, err = capfd.readouterr()
    assert (err, "missing" in out) == ("", False)
    assert {"cpu", "tdmpc2-cpu"} < set(read_table(Path("report", "final.csv"))["walker-walk"])


def test_a_variant_has_its_name_from_within_its_folder_too(run_main, monkeypatch):
    root = make_experiment()
    monkeypatch.chdir(root / "b")
    run_main(".", "--reference")
    assert "b" in read_table(Path("report", "final.csv"))["walker-walk"]


def test_methods_that_share_no_run_are_not_paired_and_a_note_says_so_where_it_was_asked_for(run_main):
    make_run("runs/a")
    make_run("runs/b", seed=2)
    for asked, note in (((), False), (("--paired", "a"), True)):
        run_main("a=runs/a", "b=runs/b", "--reference", *asked)
        page = Path("report", "index.md").read_text()
        assert ("b shares no task and seed with a: not paired." in page) == note
    assert not Path("report", "paired.csv").exists()


def test_a_base_that_is_no_name_of_runs_is_refused(refused):
    make_experiment()
    assert refused("runs", "--paired", "c") == "--paired=c is no name of runs; choose one of a, b."


def test_missing_and_unfinished_runs_are_named_on_the_page_and_in_the_line_and_shorten_nobody(run_main, capfd):
    root = make_experiment()
    shutil.rmtree(root / "b" / "cup-catch" / "seed2")
    stopped = root / "a" / "walker-walk" / "seed1"
    (stopped / "summary.json").unlink()
    (stopped / "eval.csv").write_text(HEADER + "0,0,7,1.0,3,0.5,10\n10000,5000,7,1.0,11,0.5,10\n")
    run_main("runs/exp", "--reference")
    named = (
        "a on walker-walk with seed 1: not finished, ends at 10,000 env steps",
        "b on cup-catch with seed 2: no run",
    )
    out = capfd.readouterr().out
    assert "compared at 50,000, the budget of the experiment (the benchmark's budget is 200,000)" in out
    assert f"; 2 missing or unfinished ({'; '.join(named)}); the report is" in out
    page = Path("report", "index.md").read_text()
    assert "## Missing and unfinished runs\n\n" + "".join(f"- {line}\n" for line in named) in page
    assert float(read_table(Path("report", "final.csv"))["walker-walk"]["a"]) == 52  # of the seed that is there
    assert [(row["pairs"], row["left_out"]) for row in read_rows("paired.csv")] == [("1", "1"), ("1", "2"), ("2", "3")]


def test_a_run_that_ends_a_step_before_the_budget_of_the_comparison_is_named(run_main, capfd):
    rows = (f"{steps},{steps // 2},7,1.0,{steps // 100},0.5,10\n" for steps in (0, 50_000, 99_000))
    make_run("runs/short", seed=2, text=HEADER + "".join(rows))
    make_run("runs/whole", text=HEADER + ROWS.format(seed=1))
    run_main("runs", "--budget", "100000", "--reference")
    assert "; 1 missing or unfinished (cpu on walker-walk with seed 2: ends at 99,000 env" in capfd.readouterr().out


def test_of_many_missing_runs_the_line_names_five():
    assert report_runs.missing(list("abcde")) == "; 5 missing or unfinished (a; b; c; d; e)"
    assert report_runs.missing(list("abcdefg")) == "; 7 missing or unfinished (a; b; c; d; e; and 2 more)"


def test_a_plan_for_tasks_without_runs_does_not_count(run_main):
    """The plan is the budget of each task's benchmark, and that of walker-walk is another one."""
    for seed, last in ((1, 600_000), (2, 400_000)):
        rows = (f"{t},{t // 2},7,1.0,{t // 1000},0.5,10\n" for t in range(100_000, last + 1, 100_000))
        make_run(f"runs/exp/a/dog-run/seed{seed}", task="dog-run", seed=seed, text=HEADER + "".join(rows))
    Path("runs/exp/experiment.yaml").write_text("{variants: [a], tasks: [walker-walk, dog-run], seeds: [1, 2]}")
    run_main("runs/exp", "--reference")
    assert float(read_table(Path("report", "final.csv"))["dog-run"]["a"]) == 600  # of the seed that is there


def test_a_plan_that_no_run_has_reached_yet_is_compared_where_all_are(run_main, capfd):
    root = make_experiment()
    plan = root / "experiment.yaml"
    plan.write_text(json.dumps({**json.loads(plan.read_text()), "budget": 100_000}))
    run_main("runs/exp", "--reference")
    assert "compared at 50,000, which all of them reach" in capfd.readouterr().out
    assert float(read_table(Path("report", "final.csv"))["walker-walk"]["a"]) == 51.5


def test_a_part_of_an_experiment_misses_nothing_of_the_rest_and_a_bad_plan_is_one_line(run_main, capfd):
    root = make_experiment()
    run_main("runs/exp/b", "--reference")
    assert "missing" not in capfd.readouterr().out
    assert "b" in read_table(Path("report", "final.csv"))["walker-walk"]
    run_main("mine=runs/exp/b", "--reference")
    assert {"mine", "b"} & set(read_table(Path("report", "final.csv"))["walker-walk"]) == {"mine"}
    capfd.readouterr()
    (root / "experiment.yaml").write_text("variants:")
    run_main("runs/exp", "--reference")
    out, err = capfd.readouterr()
    assert out.startswith("8 runs on 2 tasks")
    (line,) = err.splitlines()
    assert line.startswith("runs/exp/experiment.yaml does not list variants, tasks, seeds and a budget")


def test_a_report_at_low_budgets_holds_every_baseline_that_was_evaluated_there_and_no_other(run_main, capfd):
    make_experiment()
    run_main("runs")
    rows = {(row["method"], row["env_steps"], row["task"]): row for row in read_rows("returns.csv")}
    assert rows["DR.Q", "50000", "walker-walk"]["kind"] == "evaluated"
    assert rows["TD-MPC", "50000", "walker-walk"]["kind"] == "interpolated"
    quoted = rows["EfficientZero V2", "50000", "walker-walk"]
    assert (quoted["kind"], quoted["mean"], quoted["seeds"]) == ("quoted", "847", "")
    assert "read off a figure" in quoted["source"]
    assert ("DR.Q", "20000", "walker-walk") not in rows
    assert not {"BMPC", "TD-MPC2", "SAC"} & {method for method, *_ in rows}
    heads = Path("report", "final.md").read_text().splitlines()[0].split(" | ")
    assert "DR.Q" in heads and "BMPC" not in heads
    assert {"20000", "50000"} == {step for _, step, _ in rows}  # 100,000 is beyond the budget
    page = Path("report", "index.md").read_text()
    assert re.search(r"^- FoG: .*the unit of its steps is unverified$", page, re.M)
    assert "nan" not in page.lower()


def test_quoted_points_of_ones_own_are_read_and_refused_without_a_source(run_main, refused, capfd):
    make_experiment()
    Path("mine.csv").write_text("method,task,env_steps,mean,source\ntheirs,cup-catch,20000,5,a talk\n")
    run_main("runs", "--reference", "--points", "mine.csv", "--out", "own")
    capfd.readouterr()
    assert "- theirs: a talk" in Path("own", "index.md").read_text()
    Path("mine.csv").write_text("method,task,env_steps,mean,source\na,cup-catch,20000,5,a talk\n")
    assert refused("runs", "--points", "mine.csv").startswith("a names both runs and a baseline")
    Path("mine.csv").write_text("method,task,env_steps,mean,source\ntheirs,cup-catch,20000,5,\n")
    assert refused("runs", "--points", "mine.csv").startswith("mine.csv: every point needs a source")
    assert refused("runs", "--points", "no.csv") == "no such file of quoted points: no.csv."


def test_baselines_of_ones_own_stand_without_the_quoted_points_of_others(run_main):
    make_experiment()
    run_main("runs", "--reference", make_baseline())
    assert {row["method"] for row in read_rows("returns.csv")} == {"a", "b", "BMPC"}


@pytest.mark.slow
def test_a_thousand_runs_have_a_report_in_less_than_a_minute():
    name = ROOT / "benchmarks" / "many_runs.py"
    process = subprocess.run([sys.executable, str(name)], capture_output=True, text=True, env=ENVIRONMENT, check=True)
    # of the processor, on which other work may run beside
    (seconds,) = re.findall(r"^1008 runs: [\d.]+ s, ([\d.]+) s of the processor;", process.stdout, re.M)
    assert float(seconds) < 60


def test_runs_that_spell_out_what_the_task_has_anyway_are_not_changed_ones(run_main):
    make_run("runs/a")
    make_run("runs/b", seed=2)
    with open("runs/b/config.yaml", "a") as file:
        file.write("episode_length: 1000\naction_repeat: 2\n")
    run_main("runs", "--out", "out")
    page = Path("out", "index.md").read_text()
    assert "not as the benchmark has it" not in page
    assert "BMPC |" in page


def test_what_a_run_changes_of_one_task_is_said_whatever_it_does_on_others(run_main):
    make_run("runs/a")
    make_run("runs/b", task="walker-stand")
    make_run("runs/c", task="cup-catch", text=HEADER + "0,0,7,1.0,3,0.5,10\n")  # has only begun
    for name in "ac":
        with open(f"runs/{name}/config.yaml", "a") as file:
            file.write("episode_length: 100\n")
    run_main("runs", "--reference")
    page = Path("report", "index.md").read_text()
    assert "- walker-walk was run with episode_length=100, not as the benchmark has it.\n" in page
    assert "walker-stand was run with" not in page and "cup-catch was run with" not in page
    assert "- Nothing published stands beside walker-walk: returns" in page


def test_runs_of_shorter_episodes_stand_beside_nothing_published(run_main):
    make_run("runs/a")
    with open("runs/a/config.yaml", "a") as file:
        file.write("episode_length: 100\n")
    run_main("runs", "--out", "out")
    page = Path("out", "index.md").read_text()
    assert "- walker-walk was run with episode_length=100, not as the benchmark has it.\n" in page
    assert "- Nothing published stands beside walker-walk: returns of other episodes do not compare.\n" in page
    assert "BMPC |" not in page
    assert "(quoted)" not in page
    assert not Path("out", "aggregate.png").exists()


@pytest.mark.parametrize("order", [("a", "b"), ("b", "a")])
def test_every_run_s_changes_of_a_task_count(run_main, order):
    for name, setting in {"a": "episode_length: 100\n", "b": "episode_length: 500\n"}.items():
        make_run(f"runs/{name}")
        with open(f"runs/{name}/config.yaml", "a") as file:
            file.write(setting)
    make_run("runs/own")
    run_main(*(f"{name}=runs/{name}" for name in order), "own=runs/own", "--out", "out")
    page = Path("out", "index.md").read_text()
    told = {"a": "episode_length=100 by a", "b": "episode_length=500 by b"}
    assert f"- walker-walk was run with {'; '.join(told[name] for name in order)}, not as the benchmark has it." in page
    assert "- Nothing published stands beside walker-walk: returns of other episodes do not compare.\n" in page
    assert "BMPC |" not in page


def test_runs_of_one_name_on_other_versions_of_a_task_are_not_averaged(refused):
    make_run("runs/a")
    make_run("runs/b", seed=2)
    with open("runs/b/config.yaml", "a") as file:
        file.write("episode_length: 100\n")
    assert refused("runs") == (
        "runs of cpu on walker-walk with the task's own settings and episode_length=100: runs/a and runs/b; give one "
        "of them a name of its own."
    )


def test_a_folder_that_is_named_twice_counts_once(run_main, capfd):
    make_run("runs/a")
    run_main("runs", "runs/a", "runs/../runs/a", "--reference")
    assert capfd.readouterr().out.startswith("1 run on 1 task of Easy DMC")
    run_main("one=runs", "other=runs/a", "--reference")  # of two names there are two
    assert capfd.readouterr().out.startswith("2 runs on 1 task of Easy DMC")


def test_a_file_of_baselines_may_have_numbers_for_names_and_says_if_it_is_of_no_use(run_main, capfd):
    make_run("runs/a")
    rows = [f"64,{task},1,{step},{step / 100}" for task in ("walker-walk",) for step in (50_000, 100_000, 200_000)]
    Path("own.csv").write_text("\n".join(["method,task,seed,env_steps,return_mean", *rows, ""]))
    Path("other.csv").write_text(Path("own.csv").read_text().replace("walker-walk", "walker_walk"))
    run_main("runs", "--reference", "own.csv", "other.csv", "--out", "out")
    text = "other.csv has no curve on a task of dmc-easy, its tasks are walker_walk: left out"
    assert text in capfd.readouterr().err
    page = Path("out", "index.md").read_text()
    assert "| 64 | " in page
    assert f"- {text}.\n" in page
    assert "Missing and unfinished" not in page


def test_a_misspelt_task_of_a_baseline_is_named_though_others_fit(run_main, capfd):
    make_run("runs/a")
    own = Path(make_baseline("own.csv"))
    own.write_text(own.read_text() + "BMPC,Walker-run,100000,5,1.0,5\nBMPC,dog-run,100000,5,1.0,5\n")
    Path("points.csv").write_text("method,task,env_steps,mean,source\nx,walker-walk,50000,9,a\nx,walk,50000,9,a\n")
    run_main("runs", "--reference", "own.csv", "--points", "points.csv", "--out", "out")
    lines = capfd.readouterr().err.splitlines()
    assert lines == [
        f"{file}: no benchmark has the task {task}: left out"
        for file, task in (("own.csv", "Walker-run"), ("points.csv", "walk"))
    ]
    assert all(f"- {line}.\n" in Path("out", "index.md").read_text() for line in lines)


def test_a_bar_in_a_name_makes_no_column(run_main):
    make_run("runs/a")
    make_run("runs/b", seed=2)
    run_main("x|y=runs/a", "z=runs/b", "--out", "out")
    for table in Path("out", "index.md").read_text().split("\n\n"):
        lines = [line for line in table.splitlines() if line.startswith("|")]
        assert len({line.replace("\\|", "").count("|") for line in lines}) <= 1, table


def test_names_may_hold_what_is_mathematics_elsewhere(pictures, run_main):
    make_run("runs/a")
    make_run("runs/b", seed=2)
    run_main("a $_$ b=runs/a", "$5 and $6=runs/b", "--reference", "--out", "out")
    assert Path("out", "curves.png").exists()


@pytest.mark.parametrize("name", ["best", "second_best"])
def test_runs_are_not_called_like_a_column_of_the_tables(refused, name):
    make_run("runs/a")
    assert refused(f"{name}=runs/a") == f"{name} is a column of the tables; give the runs another name (NAME=PATH)."


def test_a_step_and_a_start_of_the_grid_that_were_given_are_taken(run_main):
    rows = (f"{steps},{steps},7,1.0,{steps // 10},0.5,10\n" for steps in range(0, 7_008, 1_001))
    make_run("runs/a", task="gym/Pendulum-v1", text=HEADER + "".join(rows))
    options = ("--budget", "7007", "--grid-step", "1001")  # 10, 5, 4, 3, 2 do not divide it
    run_main("runs", *options, "--grid-start", "2002", "--out", "out")
    assert "grid of the AUC: 2,002 to 7,007 every 1,001 env steps" in Path("out", "index.md").read_text()


def test_a_budget_without_a_grid_is_refused(refused):
    make_run("runs/a")
    assert refused("runs", "--budget", "49999") == "--budget=49999 has no grid of equal steps; take 49998 or 50000."


def test_runs_of_one_name_with_different_settings_are_named(run_main, capfd):
    for seed, rate in ((1, 0.001), (2, 0.0003)):
        run = make_run(f"runs/seed{seed}", seed=seed)
        settings = f"threads: {seed}\noptim: {{lr: {rate}, batch_size: 64}}\nmodel: {{num_bins: {seed}}}\n"
        (run / "config.yaml").write_text((run / "config.yaml").read_text() + settings)
    run_main("runs", "--reference")
    line = "cpu has runs with different settings: optim.lr is 0.001 in runs/seed1 and 0.0003 in runs/seed2, and 1 more"
    assert capfd.readouterr().err == f"{line}\n"
    assert f"{line}." in Path("report/index.md").read_text()


def test_runs_that_differ_in_what_no_result_depends_on_are_one_method(run_main, capfd):
    for seed in (1, 2):
        run = make_run(f"runs/seed{seed}", seed=seed)
        (run / "config.yaml").write_text((run / "config.yaml").read_text() + f"threads: {seed}\ndevice: d{seed}\n")
    run_main("runs", "--reference")
    assert capfd.readouterr().err == ""


def test_a_return_that_is_not_a_number_is_not_reached(run_main, capfd):
    rows = "0,0,0,1.0,10,1,10\n50000,25000,7,1.0,{},1,10\n100000,50000,7,1.0,{},1,10\n"
    for seed, values in ((1, (300, "nan")), (2, (500, 700)), (3, ("nan", "nan"))):
        make_run(f"runs/seed{seed}", seed=seed, text=HEADER + rows.format(*values))
    run_main("runs")
    out = capfd.readouterr().out
    assert "compared at 50,000, which all of them reach" in out
    assert "cpu on walker-walk with seed 1: ends at 50,000 env steps, others at 100,000" in out
    assert "cpu on walker-walk with seed 3: ends at 0 env steps" in out or "with seed 3: no evaluation after 0" in out
    (row,) = [line for line in Path("report/final.md").read_text().splitlines() if line.startswith("| walker-walk")]
    assert row.split(" | ")[1].strip("*") == "400.0 (2)"


def test_a_run_of_one_env_step_makes_no_curve(refused):
    make_run("runs/seed1", text=HEADER + "0,0,0,1.0,10,1,10\n1,1,1,1.0,10,1,10\n", task="gym/Pendulum-v1")
    assert refused("runs") == ("the runs end at 1 env step, which makes no curve; wait for an evaluation after it.")


def test_an_option_that_makes_no_sense_is_answered_in_a_line(refused):
    make_run("runs/a")
    assert refused("runs", "--budget", "100k") == (
        "argument --budget: invalid int value: '100k'; --help lists the options."
    )
    assert refused("runs", "--grid", "3").startswith("ambiguous option: --grid could match --grid-step, --grid-start; ")
    assert refused() == "the following arguments are required: [NAME=]PATH; --help lists the options."
