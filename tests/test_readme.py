"""The README's and the docs' code runs as it is printed, and what they name exists."""

from __future__ import annotations

import csv
import re
import runpy
import shlex
import statistics
from pathlib import Path

import pytest
import torch
import yaml

from torchrl_etdmpc.commands.evaluate import EvaluateConfig
from torchrl_etdmpc.commands.export import ExportConfig
from torchrl_etdmpc.commands.inspect_planner import InspectConfig
from torchrl_etdmpc.commands.study import StudyConfig
from torchrl_etdmpc.envs import check_env, import_task, make_env
from torchrl_etdmpc.training import PRESETS, DistributedConfig, TrainConfig
from torchrl_etdmpc.training.config import config_from_dict

ROOT = Path(__file__).resolve().parent.parent
PAGES = (
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    *(
        str(page.relative_to(ROOT))
        for page in (ROOT / "docs").rglob("*.md")
        if not {"generated", "gallery"} & set(page.relative_to(ROOT).parts)  # written by make docs
    ),
)
MEAN = "Mean over tasks"
TEXTS = {page: (ROOT / page).read_text(encoding="utf-8") for page in sorted(PAGES)}
# A block that cannot run by itself is marked as "python fragment".
BLOCKS = [(page, code) for page, text in TEXTS.items() for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL)]
COMMANDS = [
    line.replace("\\\n", " ")
    for text in TEXTS.values()
    for block in re.findall(r"```bash\n(.*?)```", text, re.DOTALL)
    for line in re.findall(r"(?:.*\\\n)*.*\S.*", block)
]


def commands(beginning: str) -> list[str]:
    found = [shlex.join(shlex.split(command, comments=True)) for command in COMMANDS if command.startswith(beginning)]
    assert found
    return list(dict.fromkeys(found))


def run_block(code: str) -> dict:
    torch.manual_seed(0)
    names: dict = {}
    exec(compile(code, "a block of the documentation", "exec"), names)
    return names


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    """The docs' own task, where the docs put it."""
    (code,) = (code for _, code in BLOCKS if "def make_env(" in code)
    (tmp_path / "my_task.py").write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.filterwarnings("ignore:.*auto_register_policy_transforms.*:FutureWarning")
@pytest.mark.parametrize(("page", "code"), BLOCKS, ids=[page for page, _ in BLOCKS])
def test_a_block_of_python_runs_as_it_is_printed_and_a_pipeline_trains_the_planner_s_weights(page, code):
    pytest.importorskip("gymnasium")
    # One episode of the README's pipeline, and not a random one.
    short = code.replace("total_frames=3_000", "total_frames=200").replace(
        "init_random_frames=600", "init_random_frames=0"
    )
    names = run_block(short)
    if "collector" not in names:
        assert page != "README.md"
        return
    assert int(names["world_model"].version) == 200
    assert all(value.isfinite().all() for value in names["terms"].values())
    assert names["planner"].world_model is names["world_model"]
    assert len(names["buffer"]) == 200
    assert names["buffer"][:]["plan", "version"].max() > 0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*auto_register_policy_transforms.*:FutureWarning")
def test_the_pipeline_of_the_readme_prints_a_return_that_rises(capsys):
    pytest.importorskip("gymnasium")
    (code,) = (code for page, code in BLOCKS if page == "README.md" and "collector" in code)
    assert "total_frames=3_000" in code
    run_block(code)
    returns = [float(line.rpartition(" ")[2]) for line in capsys.readouterr().out.splitlines()]
    assert len(returns) == 15
    assert max(returns[:2]) < -800
    assert sum(returns[-5:]) / 5 > -400


def test_the_task_of_the_docs_keeps_the_contract(own_module):
    pytest.importorskip("gymnasium")
    task = import_task("my_task:make_env", terminates=False)
    assert (task.episode_length, task.action_repeat) == (200, 1)
    env = make_env(task, seed=0)
    check_env(env)
    env.close()


@pytest.mark.parametrize("command", commands(".venv/bin/python examples/"))
def test_a_command_names_settings_and_options_that_exist(command, own_module, monkeypatch, capsys):
    pytest.importorskip("hydra")
    pytest.importorskip("gymnasium")
    words = shlex.split(command)
    (script,) = (word for word in words if word.startswith("examples/"))
    path, arguments = ROOT / script, words[words.index(script) + 1 :]
    assert path.is_file()
    if script.endswith("report.py"):
        from torchrl_etdmpc.commands import report

        monkeypatch.setattr("sys.argv", [script, *arguments])
        report.parse()
        return
    if script.endswith("suite.py"):
        # Files of the repository are named from its root, where the docs' reader is.
        arguments = [argument.replace("=benchmarks/", f"={ROOT}/benchmarks/") for argument in arguments]
        arguments = [argument for argument in arguments if argument != "status"]
        arguments += [] if "list" in arguments else ["dry_run=true"]
        monkeypatch.setattr("sys.argv", [script, *arguments])
        runpy.run_path(str(path), run_name="__main__")
        assert " runs" in capsys.readouterr().out
        return
    if "--help" in arguments:
        monkeypatch.setattr("sys.argv", [script, *arguments])
        runpy.run_path(str(path), run_name="__main__")
        assert "usage: " in capsys.readouterr().out
        return
    if "--multirun" in arguments:  # its first run
        arguments = [re.sub(",.*", "", argument) for argument in arguments if argument != "--multirun"]
    arguments += [] if "--cfg" in arguments else ["--cfg", "job"]
    monkeypatch.setattr("sys.argv", [script, *arguments])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # the script sets it; this restores it
    runpy.run_path(str(path), run_name="__main__")  # prints the settings and does nothing else
    settings = yaml.safe_load(capsys.readouterr().out)
    kinds = {"evaluate.py": EvaluateConfig, "export.py": ExportConfig, "distributed.py": DistributedConfig}
    kinds |= {"study.py": StudyConfig, "inspect_planner.py": InspectConfig}
    if path.name in ("evaluate.py", "inspect_planner.py"):  # what is not named is taken from the checkpoint
        settings["planner"] = {name: value for name, value in settings["planner"].items() if value is not None}
    config_from_dict(kinds.get(path.name, TrainConfig), settings)


@pytest.mark.parametrize("command", commands("make "))
def test_a_target_of_make_exists(command):
    targets = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)[1].split()
    words = shlex.split(command)
    assert {word for word in words[1:] if "=" not in word} <= set(targets)


def test_every_script_that_is_named_exists():
    scripts = {
        script
        for text in TEXTS.values()
        for script in re.findall(r"(?:examples|benchmarks|tests|src)/[\w/]+\.py", text)
    }
    assert len(scripts) > 5
    assert [script for script in sorted(scripts) if not (ROOT / script).is_file()] == []


def test_the_table_of_presets_is_the_code_s():
    rows = re.findall(
        r"^\| `([a-z0-9-]+)`[^|]*\| (\d) \| (\d), [a-z ]+\| (\d) \| (\d+) \| every (\w+) \|$",
        TEXTS["docs/presets.md"],
        re.M,
    )
    assert {row[0] for row in rows} == set(PRESETS)
    for name, heads, horizon, updates, every, insertion in rows:
        config = PRESETS[name]
        assert (config.model.num_dynamics, config.planner.horizon) == (int(heads), int(horizon))
        assert (config.optim.updates_per_decision, config.reanalyze.every) == (int(updates), int(every))
        assert config.replay.insertion == insertion


def anchors(page: Path) -> set[str]:
    """What GitHub calls the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", TEXTS)
def test_every_file_and_heading_that_is_linked_exists(page):
    links = [link for link in re.findall(r"\]\(([^)]+)\)", TEXTS[page]) if not link.startswith("http")]
    missing = []
    for link in links:
        if "generated/" in link:  # written by make docs, which looks for dead links too
            continue
        file, _, heading = link.partition("#")
        target = (ROOT / page).parent / file if file else ROOT / page
        if not target.exists() or (heading and heading not in anchors(target)):
            missing.append(link)
    assert missing == []


def test_the_pages_are_linked_from_the_readme():
    pages = [
        page for page in TEXTS if page.count("/") < 2 and page != "README.md"
    ]  # others are linked from docs/index.md
    assert [page for page in pages if f"]({page})" not in TEXTS["README.md"]] == []


def test_the_columns_that_every_table_of_evaluations_has_are_named():
    from torchrl_etdmpc.runs import EVAL_COLUMNS

    assert [column for column in EVAL_COLUMNS if f"`{column}`" not in TEXTS["docs/running.md"]] == []


def test_the_means_of_the_readme_are_those_of_the_table():
    table, page = _table_of_means(), TEXTS["README.md"]
    (text,) = re.findall(r"^\| after \|.*?\n\n", page, re.M | re.S)
    head, _, *rows = ([cell.strip(" *") for cell in line.strip("|").split("|")] for line in text.splitlines()[:-1])
    names = {"this": "cpu", "SimbaV2, UTD 8": "SimbaV2-UTD8"}
    assert len(rows) == 4
    for steps, tasks, *returns in rows:
        column = steps.removesuffix(" env steps"), tasks.split()[1]
        assert returns == [table[names.get(method, method)][column] for method in head[2:]], column
    figure = table["TD-MPC2 (EZ-V2's figure)"]["50,000", "tuned"]
    told = f"On the six tuned tasks TD-MPC2 has {figure} at 50,000 env steps, read off a figure"
    assert told in " ".join(page.split())
    (row,) = re.findall(r"^\| \*\*cpu\*\* \|.*\[.*$", TEXTS["docs/results.md"], re.M)
    tuned, others, every, *_, at_end = (" to ".join(ends) for ends in re.findall(r"\[(\d+), (\d+)\]", row))
    assert f"row by row, {every}, {tuned}, {others} and {at_end}." in " ".join(page.split())


def test_the_means_with_former_settings_are_those_that_are_committed():
    (text,) = re.findall(r"\*\*With former settings\*\*(.*?)\n\n", TEXTS["docs/results.md"], re.S)
    six = [path.name for path in (ROOT / "benchmarks" / "results" / "cpu" / "width-64").glob("*-*")]
    for place, former in enumerate(("imagined", "bins-101", "width-64")):
        mean = statistics.mean(_evaluated(f"{former}/{task}/seed{seed}", 50_000) for task in six for seed in (1, 2, 3))
        assert re.findall(r"(\d{3}) \[", text)[place] == f"{mean:.0f}", former
    returns = _returns_at_the_end("imagined/untuned_returns.csv")
    tasks = [task for method, task in returns if method == "cpu" and task != MEAN]
    now = statistics.mean(_evaluated(f"{task}/seed1", 50_000) for task in tasks)
    former, count = returns["cpu", MEAN]
    assert (count, len(tasks)) == ("8", 8)
    assert f"{former} on eight others, where the preset has {now:.0f}" in " ".join(text.split())


def _table_of_means() -> dict[str, dict[tuple[str, str], str]]:
    """Mean returns on the page on results, by method, number of env steps and kind of tasks."""
    (text,) = re.findall(r"<!-- means: .*?-->\n(.*?)\n<!-- end -->", TEXTS["docs/results.md"], re.S)
    heads, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.split("\n")]
    columns = [re.fullmatch(r"([\d,]+): \d+ (\w+)", head).groups() for head in heads[1:]]
    values = [[cell.removeprefix("\u2248 ").split(" ")[0] for cell in row[1:]] for row in rows]
    methods = [row[0].removesuffix(" (quoted)").strip("*") for row in rows]
    return {method: dict(zip(columns, numbers, strict=True)) for method, numbers in zip(methods, values, strict=True)}


def _evaluated(run: str, env_steps: int) -> float:
    """Return of a committed run after so many env steps."""
    with open(ROOT / "benchmarks" / "results" / "cpu" / run / "eval.csv", newline="", encoding="utf-8") as file:
        (row,) = (row for row in csv.DictReader(file) if row["env_steps"] == str(env_steps))
    return float(row["return_mean"])


def _returns_at_the_end(name: str, env_steps: str = "50000") -> dict[tuple[str, str], tuple[str, str]]:
    """Rounded return and number of tasks after so many env steps, by method and task, of a committed table."""
    with open(ROOT / "benchmarks" / "results" / "cpu" / name, newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["env_steps"] == env_steps]
    return {(row["method"], row["task"]): (f"{float(row['mean']):.0f}", row["tasks"]) for row in rows}
