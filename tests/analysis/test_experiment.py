from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")
pytest.importorskip("scipy")

import yaml  # noqa: E402

from torchrl_etdmpc.analysis import Run, experiment_root, find_runs, incomplete_runs, read_experiment  # noqa: E402

PLAN = {"variants": ["a", "b"], "tasks": ["walker-walk"], "seeds": [1, 2], "budget": 100}


def make_run(
    root: Path, variant: str, seed: int, *, last: int = 100, finished: bool = True, task="walker-walk"
) -> Path:
    run = root / variant / task / f"seed{seed}"
    run.mkdir(parents=True)
    (run / "config.yaml").write_text(yaml.safe_dump({"task": task, "preset": "cpu", "seed": seed}))
    rows = [f"{step},{seed}" for step in range(0, last + 1, 50)] if last >= 0 else []
    (run / "eval.csv").write_text("\n".join(["env_steps,return_mean", *rows, ""]))
    if finished:
        (run / "summary.json").write_text(json.dumps({}))
    return run


def read(root: Path) -> list[Run]:
    return [Run.read(path, method=path.relative_to(root).parts[0]) for path in find_runs([root])]


def plan(root: Path, **changes) -> Path:
    root.mkdir(parents=True, exist_ok=True)
    (root / "experiment.yaml").write_text(yaml.safe_dump(PLAN | changes))
    return root


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    for variant in "ab":
        for seed in (1, 2):
            make_run(tmp_path, variant, seed)
    return plan(tmp_path)


def test_a_whole_experiment_has_nothing_to_name(whole):
    assert incomplete_runs(read(whole), [read_experiment(whole)]) == []
    assert incomplete_runs(read(whole)) == []


def test_a_search_has_no_runs_of_its_own_but_its_trials_have(whole):
    search = {"search": {"optim.lr": [1e-3, 1e-4]}, "trials": 1}
    root = plan(whole, variants={"a": {}, "tuned": search, "tuned trial 0": {"optim.lr": 1e-3}})
    assert read_experiment(root).variants == ("a", "tuned trial 0")


def test_missing_runs_of_an_experiment_are_named(whole):
    root = plan(whole, variants={"a": {}, "b": {"seed": 3}, "c": None}, seeds=[1, 2, 3])
    expected = [("a", 3), ("b", 3), ("c", 1), ("c", 2), ("c", 3)]
    lines = incomplete_runs(read(root), [read_experiment(root)])
    assert lines == [f"{variant} on walker-walk with seed {seed}: no run" for variant, seed in expected]


def test_unfinished_runs_and_those_that_end_early_are_named(tmp_path):
    make_run(tmp_path, "a", 1)
    make_run(tmp_path, "a", 2, last=50)
    make_run(tmp_path, "b", 1, finished=False, last=50)
    make_run(tmp_path, "b", 2, finished=False, last=-1)
    others = [
        "a on walker-walk with seed 2: ends at 50 env steps, others at 100",
        "b on walker-walk with seed 1: not finished, ends at 50 env steps",
        "b on walker-walk with seed 2: not finished, has no evaluation",
    ]
    assert incomplete_runs(read(tmp_path)) == others
    root = plan(tmp_path, budget=200)
    lines = incomplete_runs(read(root), [read_experiment(root)])
    assert lines[0] == "a on walker-walk with seed 1: ends at 100 env steps, its budget is 200"
    assert len(lines) == 4


def test_a_run_with_nothing_but_the_untrained_agent_is_named(tmp_path):
    make_run(tmp_path, "a", 1, last=0)
    assert incomplete_runs(read(tmp_path)) == ["a on walker-walk with seed 1: no evaluation after 0 env steps"]


def test_a_run_that_is_a_step_short_of_its_budget_is_whole_and_one_that_is_a_tenth_short_is_not(tmp_path):
    root = plan(tmp_path, variants=["a"], seeds=[1, 2])
    make_run(root, "a", 1), make_run(root, "a", 2)
    for budget, short in ((101, 0), (111, 2)):
        assert len(incomplete_runs(read(root), [read_experiment(plan(root, variants=["a"], budget=budget))])) == short


def test_a_run_that_is_a_step_short_is_named_where_it_has_no_value_in_the_comparison(tmp_path):
    make_run(tmp_path, "a", 1, last=10_000), make_run(tmp_path, "a", 2, last=9_950)
    for budget, short in ((None, []), (9_950, []), (10_000, [2]), (20_000, [2])):
        lines = incomplete_runs(read(tmp_path), budget=budget)
        assert lines == [
            f"a on walker-walk with seed {seed}: ends at 9,950 env steps, others at 10,000" for seed in short
        ]


@pytest.mark.parametrize("inner", ["m", "z"])
def test_of_two_experiments_around_a_run_the_inner_one_s_budget_counts(tmp_path, inner):
    roots = plan(tmp_path, variants=["a"], budget=200), plan(tmp_path / inner, variants=["a"], seeds=[1])
    make_run(roots[1], "a", 1)
    runs = [Run.read(path, method="a") for path in find_runs([tmp_path])]
    assert not any("its budget" in line for line in incomplete_runs(runs, map(read_experiment, roots)))


def test_without_a_plan_a_seed_that_another_method_has_on_the_task_is_missed(tmp_path):
    for variant, seed in (("a", 1), ("a", 2), ("b", 1)):
        make_run(tmp_path, variant, seed)
    make_run(tmp_path, "a", 1, task="walker-run")  # b was not run on it at all
    assert incomplete_runs(read(tmp_path)) == ["b on walker-walk with seed 2: no run"]


def test_methods_without_a_shared_seed_miss_nothing(tmp_path):
    make_run(tmp_path, "a", 1)
    make_run(tmp_path, "b", 2)
    assert incomplete_runs(read(tmp_path)) == []


def test_the_root_is_found_from_a_run_whose_task_has_a_slash(tmp_path):
    root = plan(tmp_path / "exp")
    assert experiment_root(make_run(root, "a", 1, task="gym/Pendulum-v1")) == root
    assert experiment_root(make_run(tmp_path / "other", "a", 1)) is None


def test_a_set_of_tasks_may_be_named(tmp_path):
    assert len(read_experiment(plan(tmp_path, tasks="dmc-easy")).tasks) == 21
    assert read_experiment(plan(tmp_path, budget=None)).budget is None


def test_the_budget_may_be_the_benchmark_s_and_the_base_is_read(tmp_path):
    found = read_experiment(plan(tmp_path, budget="benchmark", base="b"))
    assert (found.env_steps("walker-walk"), found.env_steps("dog-run"), found.env_steps("mine")) == (
        200_000,
        600_000,
        None,
    )
    assert found.base == "b"


def test_a_base_that_is_not_named_is_the_first_variant(tmp_path):
    assert read_experiment(plan(tmp_path, variants=["b", "a"], base=None)).base == "b"


def test_a_variant_may_have_a_budget_of_its_own(tmp_path):
    variants = {"a": {}, "short": {"total_env_steps": 100}}
    root = plan(tmp_path, budget=200, variants=variants, seeds=[1])
    found = read_experiment(root)
    assert (found.env_steps("walker-walk", "a"), found.env_steps("walker-walk", "short")) == (200, 100)
    for variant in variants:
        make_run(root, variant, 1)
    assert incomplete_runs(read(root), [found]) == [
        "a on walker-walk with seed 1: ends at 100 env steps, its budget is 200"
    ]


def test_a_plan_that_a_suite_wrote_is_read(tmp_path):
    from torchrl_etdmpc.suites import Experiment, write_experiment

    written = Experiment(
        "e", ("walker-walk", "gym/Pendulum-v1"), (1, 2), {"a": {}, "b": {"planner.horizon": 4}}, base="b"
    )
    write_experiment(written, tmp_path / "experiment.yaml")
    found = read_experiment(tmp_path)
    assert (found.variants, found.tasks, found.seeds) == (tuple(written.variants), written.tasks, written.seeds)
    assert (found.budget, found.base) == (None, "b")


@pytest.mark.parametrize(
    "text",
    ["", "[", "variants: 3\n", "\0\1", "- a\n", *(yaml.safe_dump(PLAN | {key: None}) for key in ("tasks", "seeds"))]
    + [yaml.safe_dump(PLAN | change) for change in ({"seeds": ["1"]}, {"tasks": []}, {"budget": -1}, {"tasks": "x"})],
)
def test_a_plan_that_is_none_is_one_line(tmp_path, text):
    (tmp_path / "experiment.yaml").write_text(text)
    with pytest.raises(
        ValueError, match=r"experiment\.yaml does not list variants, tasks, seeds and a budget"
    ) as caught:
        read_experiment(tmp_path)
    assert len(str(caught.value).splitlines()) == 1
