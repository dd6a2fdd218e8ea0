"""Experiments as files: what they may say, and how a folder's experiment grows."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import yaml

from torchrl_etdmpc.envs import DMC_TASKS, EASY_DMC, HARD_DMC
from torchrl_etdmpc.suites import extended, find_experiment, read_experiment, write_experiment

GOOD = {
    "title": "Two",
    "tasks": ["walker-walk", "cup-catch"],
    "seeds": 2,
    "budget": 50_000,
    "settings": {"preset": "cpu", "planner": {"horizon": 4}},
    "variants": {"one": {}, "two heads": {"model.num_dynamics": 2}},
    "base": "two heads",
}


@pytest.fixture
def write(tmp_path):
    def to_file(text: str | None = None, **changes) -> Path:
        file = tmp_path / "mine.yaml"
        values = {name: value for name, value in (GOOD | changes).items() if value is not None}
        file.write_text(yaml.safe_dump(values, sort_keys=False) if text is None else text)
        return file

    return to_file


def test_a_file_comes_to_a_run_for_every_task_seed_and_variant(write, tmp_path):
    experiment = read_experiment(write())
    runs = experiment.runs(tmp_path)
    assert [run.name for run in runs[:3]] == ["one/walker-walk/seed1", "one/walker-walk/seed2", "one/cup-catch/seed1"]
    assert len({run.path for run in runs}) == len(runs) == 8
    assert runs[-1].path == tmp_path / "two heads" / "cup-catch" / "seed2"
    config = runs[-1].config
    assert (config.task, config.seed, config.total_env_steps, config.preset) == ("cup-catch", 2, 50_000, "cpu")
    assert (config.model.num_dynamics, config.planner.horizon) == (2, 4)
    assert runs[0].config.model.num_dynamics == 2  # the preset's
    assert (experiment.name, experiment.base) == ("mine", "two heads")


def test_what_is_written_is_read_again(write, tmp_path):
    search = {"search": {"optim.lr": {"low": 1e-4, "high": 3e-3, "log": True}, "model.mlp_dim": [64, 128]}, "trials": 3}
    experiment = read_experiment(write(variants={"one": {}, "tuned": search | {"loss.rho": 0.4}}, base="one"))
    write_experiment(experiment, tmp_path / "mine.yaml")
    assert read_experiment(tmp_path / "mine.yaml") == experiment
    assert experiment.searches["tuned"].settings == {"loss.rho": 0.4}
    # PyYAML writes these without quotes, as texts, which the loader takes for numbers.
    rates = dataclasses.replace(experiment, variants={"1e-3": {}, "3E4": {}}, base="1e-3")
    write_experiment(rates, tmp_path / "rates.yaml")
    assert read_experiment(tmp_path / "rates.yaml").variants == rates.variants


@pytest.mark.parametrize("spelling", ["action_repeat", "task.action_repeat", "nested"])
def test_settings_of_the_task_are_one_setting_however_they_are_spelled(write, tmp_path, spelling):
    repeats = {name: {"task": {"action_repeat": 4}} if spelling == "nested" else {spelling: 4} for name in "ab"}
    for own in ("action_repeat", "task.action_repeat"):
        file = write(variants=repeats, settings={"preset": "cpu", own: 2}, base=None)
        for changes, expected in (({}, 4), ({"task.action_repeat": 1}, 1), ({"action_repeat": 1}, 1)):
            runs = read_experiment(file, settings=changes).runs(tmp_path)
            assert {run.config.action_repeat for run in runs} == {expected}
    for searched, given in (("action_repeat", "task.action_repeat"), ("task.action_repeat", "action_repeat")):
        variants = {"tuned": {"search": {searched: [1, 2]}, "trials": 2, given: 4}}
        with pytest.raises(ValueError, match=r"searches task\.action_repeat, which is given as well"):
            read_experiment(write(variants=variants, base=None))


def test_a_setting_of_the_task_under_both_of_its_names_is_refused(write):
    both = {"action_repeat": 2, "task.action_repeat": 4}
    with pytest.raises(ValueError, match=r"sets action_repeat and task\.action_repeat, which are the same; leave one"):
        read_experiment(write(variants={"a": both}, base=None))


def test_a_base_that_is_not_named_is_the_first_variant_from_then_on(write, tmp_path):
    write_experiment(read_experiment(write(base=None)), tmp_path / "experiment.yaml")
    assert read_experiment(tmp_path / "experiment.yaml").base == "one"


def test_numbers_may_be_written_as_they_are_in_json(write):
    file = write(
        "tasks: [walker-walk]\nseeds: 1\nbudget: 1e5\nvariants: {a: {optim.lr: 1e-3}, b: {optim.lr: 2.5E-4}}\n"
    )
    experiment = read_experiment(file)
    assert experiment.budget == 100_000
    assert [experiment.config(name, "walker-walk", 1).optim.lr for name in "ab"] == [1e-3, 2.5e-4]


def test_tasks_are_lists_or_names_of_sets(write):
    assert read_experiment(write(tasks="dmc-hard")).tasks == HARD_DMC
    assert read_experiment(write(tasks="dmc")).tasks == DMC_TASKS
    assert read_experiment(write(tasks=["dmc-hard", "gym/Pendulum-v1"])).tasks == (*HARD_DMC, "gym/Pendulum-v1")
    assert read_experiment(write(), tasks=["dmc-easy"]).tasks == EASY_DMC


def test_seeds_are_a_list_or_how_many(write):
    assert read_experiment(write(seeds=3)).seeds == (1, 2, 3)
    assert read_experiment(write(seeds=[7, 5])).seeds == (7, 5)
    assert read_experiment(write(), seeds=[4]).seeds == (4,)


def test_a_budget_may_be_the_benchmark_s(write):
    experiment = read_experiment(write(budget="benchmark", tasks=["walker-walk", "dog-run"]))
    budgets = [experiment.config("one", task, 1).total_env_steps for task in experiment.tasks]
    assert budgets == [200_000, 600_000]
    with pytest.raises(
        ValueError, match="'one' .*gym/Pendulum-v1 is of no benchmark, so budget must be a number of env"
    ):
        read_experiment(write(budget="benchmark", tasks=["gym/Pendulum-v1"])).runs(Path())
    with pytest.raises(ValueError, match="unknown task 'walker-wlak'; did you mean walker-walk"):
        read_experiment(write(budget="benchmark"), tasks=["walker-wlak"]).runs(Path())


def test_settings_of_the_command_come_after_those_of_every_variant(write):
    changes = {"settings": {"model.num_dynamics": 3, "total_env_steps": 30_000}}
    experiment = read_experiment(write(), **changes)
    assert experiment.budget == 30_000
    for variant in experiment.variants:
        assert experiment.config(variant, "cup-catch", 1).model.num_dynamics == 3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": []}, "tasks of experiment mine must not be empty."),
        ({"tasks": None}, "tasks of .*mine.yaml must be a list of tasks or one of dmc-easy, .*, got None."),
        ({"tasks": [3]}, r"tasks of .*mine.yaml must be a list of tasks or one of .*, got \[3\]."),
        (
            {"tasks": ["cup-catch", "cup-catch"]},
            "tasks of experiment mine must differ, got .'cup-catch'. more than once",
        ),
        ({"seeds": 0}, "seeds of .*mine.yaml must be a list of numbers or how many, at least 1, got 0."),
        ({"seeds": None}, "seeds of .* must be a list of numbers or how many, at least 1, got None."),
        ({"seeds": [1.5]}, r"seeds of .* must be a list of numbers or how many, at least 1, got \[1.5\]."),
        ({"seeds": True}, "seeds of .* must be a list of numbers or how many, at least 1, got True."),
        ({"seeds": [2, 2]}, "seeds of experiment mine must differ, got .2. more than once."),
        ({"variants": None}, "variants of experiment mine must not be empty."),
        ({"variants": {False: {}}}, "variants of .*mine.yaml must have texts for names, got False; put it in quotes."),
        ({"variants": {1.0: {}}}, "variants of .*mine.yaml must have texts for names, got 1.0; put it in quotes."),
        ({"variants": ["a"]}, "variants of .*mine.yaml must be settings by name, got .'a'."),
        ({"variants": {"a": 3}}, "variant a of .*mine.yaml must be settings by name, got 3."),
        ({"variants": {"a/b": {}}}, "a variant's name becomes a folder's: .*, got 'a/b'."),
        ({"variants": {"..": {}}}, "a variant's name becomes a folder's: .*, got '..'."),
        ({"variants": {"a ": {}}}, "a variant's name becomes a folder's: .*, got 'a '."),
        ({"variants": {"a\0": {}}}, "a variant's name becomes a folder's: .*"),
        ({"variants": {"a" * 200: {}}}, "a variant's name becomes a folder's: .*"),
        (
            {"variants": {"a": {"seed": 3}}, "base": "a"},
            "variant a of .* sets seed, which a suite gives each run itself",
        ),
        ({"settings": {"run_dir": "/"}}, "settings of .*mine.yaml sets run_dir, which a suite gives each run itself."),
        ({"settings": [1]}, r"settings of .*mine.yaml must be settings by name, got \[1\]."),
        ({"budget": "much"}, "budget of .* must be a number of env steps or 'benchmark', got 'much'."),
        ({"budget": -1}, "budget of .* must be a number of env steps or 'benchmark', got -1."),
        ({"budget": 1000.5}, "budget of .* must be a number of env steps or 'benchmark', got 1000.5."),
        ({"base": "three"}, "base of experiment mine must be one of one, two heads, got 'three'."),
        (
            {"variants": {"one": {}, "tuned": {"search": {"loss.rho": [0.4]}, "trials": 1}}, "base": "tuned"},
            "base of experiment mine must be one of one, got 'tuned'.",
        ),
        ({"what": 1}, "mine.yaml has an unknown entry what; known: base, budget, seeds, "),
    ],
)
def test_what_a_file_says_wrong_is_named(write, changes, message):
    with pytest.raises(ValueError, match=message) as error:
        read_experiment(write(**changes))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("search", "message"),
    [
        ({"search": {}}, "variant a of .*: search must name at least one setting, got none."),
        ({"search": 3}, "variant a of .*mine.yaml must search settings by name."),
        ({"search": {"optim.lr": []}}, r"search of optim.lr must be a list of values or low and high.*, got \[\]"),
        ({"search": {"optim.lr": 3}}, "search of optim.lr must be a list of values or low and high"),
        ({"search": {"optim.lr": {"low": 1}}}, "search of optim.lr must be a list of values or low and high"),
        (
            {"search": {"optim.lr": {"low": 1, "high": 1}}},
            "search of optim.lr must be a list of values or low and high",
        ),
        (
            {"search": {"optim.lr": {"low": 2, "high": 1}}},
            "search of optim.lr must be a list of values or low and high",
        ),
        (
            {"search": {"optim.lr": {"low": 0.0, "high": 1, "log": True}}},
            "search of optim.lr must be a list of values or",
        ),
        (
            {"search": {"optim.lr": {"low": 0.1, "high": 1, "lg": True}}},
            "search of optim.lr must be a list of values or",
        ),
        ({"search": {"seed": [1]}}, "search cannot look for seed; make a variant for each."),
        ({"search": {"preset": ["cpu"]}}, "search cannot look for preset; make a variant for each."),
        ({"search": {"optim.lr": [1.0]}, "trials": 0}, "trials must be a number, got 0."),
        ({"search": {"optim.lr": [1.0]}, "trials": None}, "trials must be a number, got None."),
        ({"search": {"optim.lr": [1.0]}, "prune": 1}, "prune must be true or false, got 1."),
        (
            {"search": {"optim.lr": [1.0]}, "optim.lr": 2.0},
            "variant a of .* searches optim.lr, which is given as well.",
        ),
    ],
)
def test_what_a_search_says_wrong_is_named(write, search, message):
    with pytest.raises(ValueError, match=message):
        read_experiment(write(variants={"a": {"trials": 2} | search}, base=None))


@pytest.mark.parametrize(
    ("variants", "message"),
    [
        (
            {"a": {"planner.horizont": 3}},
            "variant 'a' of experiment mine: unknown setting planner.horizont; known: horizon",
        ),
        ({"a": {"plannr.horizon": 3}}, "variant 'a' of experiment mine: unknown setting plannr; known: task, "),
        ({"a": {"seed_decisions.x": 3}}, "unknown setting seed_decisions"),
        ({"a": {"total_env_steps.x": 3}}, "unknown setting total_env_steps.x; total_env_steps has none below it."),
        ({"a": {"optim.lr": "fast"}}, "variant 'a' of experiment mine: optim.lr must be of type float, got 'fast'."),
        (
            {"a": {"preset": "gpu"}},
            "variant 'a' of experiment mine: unknown preset 'gpu'; choose one of efficient-tdmpc",
        ),
        ({"a": {"preset": ["cpu"]}}, "variant 'a' of experiment mine: preset must be a name, got .'cpu'."),
        (
            {"a": {"search": {"planner.horizont": [1]}, "trials": 1}},
            "variant 'a' of .*: unknown setting planner.horizont",
        ),
        (
            {"a": {"search": {"optim.batch_size": [8, 0]}, "trials": 1}},
            "variant 'a' .*optim.batch_size must be at least 1",
        ),
        (
            {"a": {"search": {"optim.lr": {"low": 0.1, "high": float("inf")}}, "trials": 1}},
            "variant 'a' .*finite number",
        ),
    ],
)
def test_a_setting_that_does_not_exist_is_found_before_anything_is_made(write, tmp_path, variants, message):
    experiment = read_experiment(write(variants=variants, base=None))
    with pytest.raises(ValueError, match=message):
        experiment.runs(tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


def test_a_task_that_does_not_exist_is_answered_with_the_nearest(write, tmp_path):
    with pytest.raises(ValueError, match="unknown task 'walker-wlak'; did you mean walker-walk"):
        read_experiment(write(tasks=["walker-wlak"])).runs(tmp_path)


def test_two_tasks_never_share_a_directory(write, tmp_path):
    pytest.importorskip("gymnasium")
    from torchrl_etdmpc.envs import Task, register_task, tasks

    register_task(Task("gym_Pendulum-v1", "made up", episode_length=200))
    try:
        with pytest.raises(ValueError, match="two tasks must not differ by / and _ alone"):
            read_experiment(write(tasks=["gym/Pendulum-v1", "gym_Pendulum-v1"])).runs(tmp_path)
    finally:
        del tasks._tasks["gym_Pendulum-v1"]


@pytest.mark.parametrize(
    "text", ["", "- a\n", "tasks: [\n", "a: &a [*a]\n", "\xff", "!!python/object:os.system {}\n", "3"]
)
def test_a_file_that_is_no_experiment_is_refused_in_a_line(write, text):
    file = write(text)
    if text == "\xff":
        file.write_bytes(b"\xff\xfe\xff")
    with pytest.raises(
        ValueError, match="mine.yaml (is not an experiment: |must hold entries|has an unknown entry)"
    ) as error:
        read_experiment(file)
    assert "\n" not in str(error.value)


def test_a_missing_file_and_a_folder_are_no_experiments(tmp_path):
    for path in (tmp_path / "none.yaml", tmp_path):
        with pytest.raises(ValueError, match="is not an experiment: "):
            read_experiment(path)


def test_experiments_are_found_by_name_or_by_path(tmp_path, write):
    file = write()
    assert find_experiment("mine", tmp_path) == file
    assert find_experiment(str(file), Path("elsewhere")) == file
    with pytest.raises(
        ValueError, match="unknown experiment 'mien'; did you mean mine. A path to a .yaml file does as well"
    ):
        find_experiment("mien", tmp_path)
    with pytest.raises(ValueError, match="unknown experiment 'zzz'; there are mine. A path"):
        find_experiment("zzz", tmp_path)
    with pytest.raises(ValueError, match="experiment=.*none.yaml is not a file"):
        find_experiment(str(tmp_path / "none.yaml"), tmp_path)


@pytest.mark.parametrize("where", ["tasks", "settings"])
def test_no_file_makes_this_process_import_code(write, tmp_path, monkeypatch, where):
    (tmp_path / "evil.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    changes = {"tasks": ["evil:make"]} if where == "tasks" else {"settings": {"planner.score": "evil:score"}}
    with pytest.raises(ValueError, match="names code, which must be given on the command line"):
        read_experiment(write(**changes)).runs(tmp_path)


# -- an experiment grows ----------------------------------------------------------------------------------------------


def test_tasks_seeds_variants_and_budget_may_be_added(write, tmp_path):
    stored = read_experiment(write())
    asked = read_experiment(
        write(tasks=["cup-catch", "dog-run"], seeds=[2, 9], budget=60_000, variants={"three": {}}, base=None)
    )
    both = extended(stored, asked, tmp_path)
    assert both.tasks == ("walker-walk", "cup-catch", "dog-run")
    assert both.seeds == (1, 2, 9)
    assert list(both.variants) == ["one", "two heads", "three"]
    assert both.budget == 60_000
    assert both.base == "two heads"  # what a command leaves out stays


def test_the_base_may_be_changed(write, tmp_path):
    stored = read_experiment(write())
    assert extended(stored, dataclasses.replace(stored, base="one"), tmp_path).base == "one"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"settings": {"preset": "cpu", "planner.horizon": 5}},
            "with planner.horizon=4 for variant 'one', now it is 5",
        ),
        (
            {"settings": {"preset": "cpu", "task.action_repeat": 4, "planner.horizon": 4}},
            "task.action_repeat=None .* 4",
        ),
        (
            {"variants": {"one": {}, "two heads": {"model.num_dynamics": 3}}},
            "model.num_dynamics=2 for variant 'two heads'",
        ),
        ({"settings": {"preset": "tdmpc2-cpu", "planner.horizon": 4}}, "was begun in .* with preset=cpu"),
    ],
)
def test_a_changed_setting_is_refused_by_its_name(write, tmp_path, changes, message):
    stored = read_experiment(write())
    with pytest.raises(ValueError, match=f"{message}.*; choose another runs_dir for the changed one."):
        extended(stored, read_experiment(write(**changes)), tmp_path)


def test_what_no_result_depends_on_may_change(write, tmp_path):
    stored = read_experiment(write())
    settings = {"preset": "cpu", "planner.horizon": 4, "checkpoint_every": 1000, "threads": 2, "logger": "none"}
    assert extended(stored, read_experiment(write(settings=settings)), tmp_path).settings == settings


def test_a_search_may_have_more_trials_but_no_other_space_tasks_seeds_or_budget(write, tmp_path):
    search = {"search": {"optim.lr": [1e-3, 1e-4]}, "trials": 2}
    stored = read_experiment(write(variants={"a": search}, base=None))
    more = read_experiment(write(variants={"a": search | {"trials": 5, "prune": False}}, base=None))
    assert extended(stored, more, tmp_path).searches["a"].trials == 5
    for changes in (
        {"variants": {"a": search | {"search": {"optim.lr": [1e-3]}}}},
        {"variants": {"a": search | {"loss.rho": 0.4}}},
        {"variants": {"a": search}, "seeds": 3},
        {"variants": {"a": search}, "budget": 60_000},
    ):
        with pytest.raises(ValueError, match="was begun in .* for the search 'a', whose trials would not compare"):
            extended(stored, read_experiment(write(**changes, base=None)), tmp_path)


@pytest.mark.parametrize("left_out", [False, True])
def test_what_all_trials_of_a_search_share_may_not_change(write, tmp_path, left_out):
    variants = {"a": {"search": {"optim.lr": [1e-3, 1e-4]}, "trials": 2}}
    stored = read_experiment(write(variants=variants, base=None))
    settings = {"preset": "cpu", "planner.horizon": 5}
    asked = read_experiment(write(variants={"b": {}} if left_out else variants, settings=settings, base=None))
    with pytest.raises(ValueError, match="with planner.horizon=4 for variant 'a', now it is 5; choose"):
        extended(stored, asked, tmp_path)


def test_a_search_goes_on_with_its_tasks_and_seeds_in_another_order(write, tmp_path):
    search = {"search": {"optim.lr": [1e-3, 1e-4]}, "trials": 2}
    both = [["walker-walk", "cup-catch"], [1, 2]], [["cup-catch", "walker-walk"], [2, 1]]
    stored, asked = (read_experiment(write(variants={"a": search}, base=None, tasks=t, seeds=s)) for t, s in both)
    assert extended(stored, asked, tmp_path).tasks == ("walker-walk", "cup-catch")


def test_a_shorter_budget_is_refused(write, tmp_path):
    stored = read_experiment(write(variants={"a": {}, "long": {"total_env_steps": 90_000}}, base=None))
    asked = read_experiment(write(variants={"b": {}}, base=None, budget=49_999))
    with pytest.raises(ValueError, match="with total_env_steps=50000 for variant 'a', now it is 49999, which is less"):
        extended(stored, asked, tmp_path)


def test_a_budget_that_is_shorter_on_one_of_the_tasks_is_refused(write, tmp_path):
    tasks = ["walker-walk", "dog-run"]  # of two benchmarks
    stored, asked = (read_experiment(write(tasks=tasks, budget=budget)) for budget in ("benchmark", 200_000))
    with pytest.raises(ValueError, match="with total_env_steps=600000 for variant 'one', now it is 200000, which is"):
        extended(stored, asked, tmp_path)


def test_env_steps_among_the_settings_are_the_budget(write, tmp_path):
    experiment = read_experiment(write(budget=None, settings={"preset": "cpu", "total_env_steps": 30_000}))
    assert experiment.budget == 30_000
    assert "total_env_steps" not in experiment.settings
    write_experiment(experiment, tmp_path / "stored.yaml")
    assert read_experiment(tmp_path / "stored.yaml").budget == 30_000
    assert read_experiment(tmp_path / "mine.yaml", settings={"total_env_steps": 60_000}).budget == 60_000


def test_env_steps_of_the_command_replace_those_of_a_variant(write):
    variants = {"one": {}, "short": {"total_env_steps": 20_000}}
    file = write(variants=variants, base="one")
    experiment = read_experiment(file)
    steps = {name: experiment.config(name, "cup-catch", 1).total_env_steps for name in variants}
    assert steps == {"one": 50_000, "short": 20_000}
    longer = read_experiment(file, settings={"total_env_steps": 60_000})
    assert {longer.config(name, "cup-catch", 1).total_env_steps for name in variants} == {60_000}
    assert longer.variants["one"] == {}


def test_no_seeds_of_the_command_are_not_those_of_the_file(write):
    with pytest.raises(ValueError, match="seeds of .* must be a list of numbers or how many, at least 1, got 0"):
        read_experiment(write(), seeds=0)


def test_a_name_that_stands_twice_is_refused(write):
    text = "tasks: [walker-walk]\nseeds: 1\nbudget: 100\nvariants:\n  a: {optim.lr: 1e-3}\n  a: {optim.lr: 3e-3}\n"
    with pytest.raises(ValueError, match=r"mine.yaml is not an experiment: 'a' stands twice, at line 5 and after it\."):
        read_experiment(write(text))


def test_settings_may_be_shared_by_yaml_s_own_means(write):
    text = "tasks: [walker-walk]\nseeds: 1\nbudget: 100\nvariants:\n  a: &shared {optim.lr: 1e-3, loss.rho: 0.4}\n"
    experiment = read_experiment(write(text + "  b: {<<: *shared, loss.rho: 0.6}\n"))
    assert experiment.variants["b"] == {"optim.lr": 1e-3, "loss.rho": 0.6}
