"""The command ``suite``: what it prints, what it refuses, and what it leaves alone."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

import pytest
import yaml

from torchrl_etdmpc.commands import suite
from torchrl_etdmpc.runs import RunDirectory
from torchrl_etdmpc.suites import RunQueue, read_experiment, write_experiment
from torchrl_etdmpc.suites.attempt import note

SMALL = {"preset": "cpu", "device": "cpu", "task.episode_length": 200, "replay.seed_decisions": 40}
MINE = {
    "tasks": ["cup-catch"],
    "seeds": 2,
    "budget": 400,
    "settings": SMALL,
    "variants": {"a": {}, "b": {"loss.rho": 0.4}},
}


@pytest.fixture
def mine(tmp_path):
    def write(**changes) -> str:
        file = tmp_path / "mine.yaml"
        file.write_text(yaml.safe_dump(MINE | changes, sort_keys=False))
        return str(file)

    return write


@pytest.fixture
def call(monkeypatch, tmp_path, run_main):
    """Runs ``torchrl-etdmpc suite`` in this process; returns its exit message and what it printed."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> tuple[object, str]:
        message, out, err = run_main("suite", *arguments)
        assert err == ""
        return message, out

    return run


@pytest.fixture
def trained(monkeypatch):
    """Instead of training: the queues that would have been, and runs that are finished by it."""
    queues: list[RunQueue] = []

    def run_locally(queue, **places):
        queues.append(queue)
        while (run := queue.next()) is not None:
            run.path.mkdir(parents=True, exist_ok=True)
            row = f"{run.config.total_env_steps},200,0,9.0"
            head = "env_steps,decision_steps,updates,wall_time_s"
            (run.path / "config.yaml").write_text(yaml.safe_dump(run.config.to_dict()))
            (run.path / "train.csv").write_text(f"{head}\n{row}\n")
            (run.path / "eval.csv").write_text(f"{head},return_mean,return_std,episodes\n{row},321.0,0,1\n")
            (run.path / "summary.json").write_text(f'{{"env_steps": {run.config.total_env_steps}}}')
            queue.ended(run, 0)
        return True

    monkeypatch.setattr(suite, "run_locally", run_locally)
    return queues


@pytest.fixture
def locks_held(monkeypatch):
    """Those that the process has whenever it writes an experiment."""
    lock, held, found = suite.file_lock, [], []

    @contextlib.contextmanager
    def locked(file):
        with lock(file):
            held.append(file.name)
            yield
            held.pop()

    def write(*arguments):
        found.append(list(held))
        write_experiment(*arguments)

    monkeypatch.setattr(suite, "file_lock", locked)
    monkeypatch.setattr(suite, "write_experiment", write)
    return found


def test_the_committed_experiments_are_listed(call):
    message, out = call("list")
    assert message is None
    assert len(out.splitlines()) == len(list(suite.EXPERIMENTS.glob("*.yaml")))
    assert "dynamics-ensemble           96 runs  Dynamics heads, 1, 2, 4 or 8, added to BMPC" in out.splitlines()


def test_the_help_names_every_setting(call):
    message, out = call("--help")
    assert message is None
    for name in (
        "experiment=",
        "engine=local",
        "runs_dir=null",
        "sbatch=",
        "address=",
        "cpus_per_run=1.0",
        "retries=2",
    ):
        assert f"  {name}" in out


@pytest.mark.parametrize(("asked", "seeds"), [("3", [1, 2, 3]), ("[3]", [3]), ("7,5", [7, 5]), ("[7,5]", [7, 5])])
def test_seeds_are_how_many_or_which(call, mine, asked, seeds):
    message, out = call(f"experiment={mine()}", "dry_run=true", f"seeds={asked}", "variants=a")
    assert message is None
    planned = [line for line in out.splitlines() if line.startswith("python ")]
    assert [int(word.removeprefix("seed=")) for line in planned for word in line.split() if "seed=" in word] == seeds


def test_a_default_that_is_none_can_be_typed_as_the_help_prints_it(call, mine):
    experiment = f"experiment={mine()}"
    message, expected = call(experiment, "dry_run=true")
    assert message is None
    nothing = ("runs_dir=null", "tasks=null", "seeds=null", "variants=null", "workers=null", "address=null")
    assert call(experiment, "dry_run=true", *nothing) == (None, expected)
    message, out = call(experiment, "dry_run=true", "loss.extra_terms=null")
    assert message is None
    assert "extra_terms=null" in out or "extra_terms" not in out


@pytest.mark.parametrize("empty", ["tasks=[]", "variants=[]", "seeds=[]"])
def test_an_empty_list_is_not_the_whole_experiment(call, mine, empty):
    message, out = call(f"experiment={mine()}", "dry_run=true", empty)
    assert str(message).startswith("error: ") and "\n" not in str(message)
    assert out == ""


@pytest.mark.parametrize("tasks", ["reacher-easy,cup-catch", "[reacher-easy,cup-catch]", "[reacher-easy, cup-catch]"])
@pytest.mark.parametrize("variants", ["b,a", "[b, a]", "['b', \"a\"]"])
def test_tasks_and_variants_are_lists_with_or_without_brackets(call, mine, tasks, variants):
    message, out = call(f"experiment={mine()}", "dry_run=true", f"tasks={tasks}", f"variants={variants}", "seeds=1")
    assert message is None
    planned = [line for line in out.splitlines() if line.startswith("python ")]
    for part in ("task=reacher-easy", "task=cup-catch", "/a/", "/b/"):
        assert sum(part in line for line in planned) == 2


def test_a_dry_run_says_what_would_be_run_and_changes_nothing(call, mine, tmp_path):
    message, out = call(f"experiment={mine()}", "dry_run=true", "runs_dir=here")
    assert message is None
    lines = out.splitlines()
    assert len(lines) == 6
    assert lines[0].startswith("python -P -m torchrl_etdmpc.commands train task=")
    assert f"run_dir={tmp_path}/here/b/cup-catch/seed2" in lines[3]
    assert "loss.rho=0.4" in lines[3]
    assert lines[-1] == "4 runs, 1,600 env steps"
    _, longer = call(f"experiment={mine(variants={'a': {}, 'b': {'total_env_steps': 600}})}", "dry_run=true")
    assert longer.splitlines()[-1] == "4 runs, 2,000 env steps"
    assert not (tmp_path / "here").exists()
    search = {"search": {"optim.lr": [1e-3, 1e-4]}, "trials": 7}
    _, out = call(f"experiment={mine(variants={'tuned': search})}", "dry_run=true")
    assert out.splitlines()[-1] == "tuned: a search of 7 trials, 2 runs each"


@pytest.mark.parametrize(
    ("experiment", "twins"),
    [
        ("utd", ("efficient-tdmpc", "efficient-tdmpc-utd2")),
        ("main-easy", ("bmpc", "efficient-tdmpc")),
        ("main-hard", ("bmpc", "efficient-tdmpc")),
        ("dynamics-ensemble", None),
        ("horizon", None),
        ("insertion", None),
        ("cheap-reanalyze", None),
        ("pessimism-scope", None),
        ("reanalyze-pessimism", None),
    ],
)
def test_a_setting_of_the_command_makes_no_two_variants_one_run(call, experiment, twins):
    message, out = call(f"experiment={experiment}", "preset=cpu", "seeds=1", "dry_run=true")
    if twins is None:
        assert message is None and "runs, " in out
    else:
        assert str(message).startswith(
            f"error: variants '{twins[0]}' and '{twins[1]}' of experiment {experiment} have the same settings on "
        )
        assert "leave those out, or write variants=" in str(message)
        message, _ = call(f"experiment={experiment}", "preset=cpu", f"variants={twins[0]}", "seeds=1", "dry_run=true")
        assert message is None


def test_presets_that_come_to_the_same_settings_are_one_run(call, mine):
    twins = {"a": {"preset": "efficient-tdmpc-utd4", "reanalyze.beta": 10.0}, "b": {"preset": "humanoidbench"}}
    message, _ = call(f"experiment={mine(variants=twins)}", "dry_run=true")
    assert str(message).startswith("error: variants 'a' and 'b' of experiment mine have the same settings on cup-catch")


def test_trials_of_a_search_may_be_the_same_run(call, mine, trained, tmp_path):
    pytest.importorskip("optuna")
    search = {"search": {"optim.lr": [1e-3, 1e-4]}, "trials": 4}
    message, _ = call(f"experiment={mine(variants={'tuned': search}, base=None)}")
    assert message == 0
    message, out = call(f"experiment={mine(variants={'tuned': search | {'trials': 5}}, base=None)}")
    assert message == 0 and "tuned trial 4/cup-catch/seed1: finished" in out


def test_an_experiment_is_trained_told_and_grown(call, mine, trained, tmp_path):
    message, out = call(f"experiment={mine()}", "variants=b", "seeds=1", "runs_dir=here")
    assert message == 0
    assert "b/cup-catch/seed1: finished, return 321.0" in out
    assert out.splitlines()[-1] == "1 runs: 1 finished"
    message, out = call(f"experiment={mine()}", "runs_dir=here", "total_env_steps=500")
    assert message == 0
    assert out.splitlines()[-1] == "4 runs: 4 finished"
    assert len(trained[1].runs) == 4
    stored = read_experiment(tmp_path / "here" / "experiment.yaml")
    assert (list(stored.variants), stored.seeds, stored.budget, stored.base) == (["b", "a"], (1, 2), 500, "a")
    message, out = call("status", "runs_dir=here")
    assert message is None
    assert out.splitlines()[0].startswith("variant  task       seeds done")
    assert out.splitlines()[-1] == "4 runs: 4 finished"


def test_two_commands_that_begin_at_once_both_add_to_the_experiment(
    call, mine, trained, tmp_path, monkeypatch, locks_held
):
    check, calls = suite._require_parts, []

    def while_the_other_begins(runs) -> None:
        check(runs)
        calls.append(runs)
        if len(calls) == 1:
            call(f"experiment={mine()}", "runs_dir=here", "variants=b", "seeds=[2]")

    monkeypatch.setattr(suite, "_require_parts", while_the_other_begins)
    message, _ = call(f"experiment={mine()}", "runs_dir=here", "variants=a", "seeds=[1]")
    assert message == 0
    stored = read_experiment(tmp_path / "here" / "experiment.yaml")
    assert (sorted(stored.variants), sorted(stored.seeds)) == (["a", "b"], [1, 2])
    assert locks_held == [[".experiment.lock"]] * 2


def test_the_base_stays_when_a_command_trains_other_variants(call, mine, trained, tmp_path):
    call(f"experiment={mine(base='a')}", "runs_dir=here")
    call(f"experiment={mine(base='a')}", "runs_dir=here", "variants=b")
    assert read_experiment(tmp_path / "here" / "experiment.yaml").base == "a"


def test_the_status_needs_none_of_the_settings_that_it_was_begun_with(call, mine, trained):
    call(f"experiment={mine()}", "runs_dir=here", "model.num_dynamics=1")
    message, out = call("status", f"experiment={mine()}", "runs_dir=here")
    assert message is None
    assert out.splitlines()[-1] == "4 runs: 4 finished"


def test_the_status_is_that_of_the_runs_that_are_named(call, mine, trained):
    call(f"experiment={mine(tasks=['cup-catch', 'reacher-easy'])}", "runs_dir=here")
    for named, count in {"tasks=reacher-easy": 4, "seeds=[2]": 4, "variants=b": 4, "seeds=1 variants=a": 2}.items():
        message, out = call("status", "runs_dir=here", *named.split())
        assert message is None
        assert out.splitlines()[-1] == f"{count} runs: {count} finished"
    message, out = call("status", "runs_dir=here", "seeds=[7]")
    assert message == (
        f"error: runs_dir={Path.cwd()}/here holds no run of these tasks, seeds and variants; leave some out."
    )


def test_the_status_shares_the_time_left_among_as_many_as_will_run(call, mine, monkeypatch, tmp_path):
    monkeypatch.setattr(suite, "run_locally", lambda queue, **places: True)
    call(f"experiment={mine()}", "runs_dir=here")
    run = tmp_path / "here" / "a" / "cup-catch" / "seed1"
    run.mkdir(parents=True)
    (run / "train.csv").write_text("env_steps,decision_steps,updates,wall_time_s\n100,50,0,9\n200,100,0,18\n")
    assert call("status", "runs_dir=here", "workers=3")[1].endswith(" left with 3 at a time\n")


def test_a_run_that_fails_makes_the_command_fail(call, mine, monkeypatch):
    def fail(queue, **places):
        while (run := queue.next()) is not None:
            run.path.mkdir(parents=True, exist_ok=True)
            queue.ended(run, 3)
        return True

    monkeypatch.setattr(suite, "run_locally", fail)
    message, out = call(f"experiment={mine()}", "seeds=1", "retries=0", "runs_dir=here")
    assert message == 1
    assert out.splitlines()[-3:] == [
        "2 runs: 2 failed",
        "failed: a/cup-catch/seed1: exit code 3",
        "failed: b/cup-catch/seed1: exit code 3",
    ]


def test_runs_that_are_left_make_the_command_fail(call, mine, monkeypatch):
    monkeypatch.setattr(suite, "run_locally", lambda queue, **places: True)
    message, _ = call(f"experiment={mine()}", "runs_dir=here")
    assert message == 1


def test_a_trial_that_ended_early_is_no_failure(call, mine, monkeypatch):
    def prune(queue, **places):
        while (run := queue.next()) is not None:
            note(run, "pruned", "below the median")
        return True

    monkeypatch.setattr(suite, "run_locally", prune)
    message, out = call(f"experiment={mine()}", "runs_dir=here")
    assert message == 0
    assert out.splitlines()[-1] == "4 runs: 4 pruned"


def test_a_suite_whose_output_nobody_reads_still_stops_its_runs(call, mine, monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)  # as Ctrl-C ends the tee of `suite | tee log`, too

    def run_locally(queue, **places) -> bool:
        monkeypatch.setattr(sys, "stdout", open(writer, "w"))
        queue.say("stopping: 2 runs save themselves")  # before they are told
        return False

    monkeypatch.setattr(suite, "run_locally", run_locally)
    assert call(f"experiment={mine()}")[0] == 75
    sys.stdout.close()


@pytest.mark.parametrize(
    ("engine", "settings"),
    [
        ("run_locally", {"workers": 3, "per_gpu": 2}),
        ("run_on_ray", {"workers": 3, "address": "node:6379", "cpus_per_run": 2.0, "gpus_per_run": 0.5}),
    ],
)
def test_settings_of_an_engine_reach_it(call, mine, monkeypatch, engine, settings):
    given = {}
    monkeypatch.setattr(suite, engine, lambda queue, **places: given.update(places) or True)
    words = [f"{name}={value}" for name, value in settings.items()] + ["engine=ray"] * (engine == "run_on_ray")
    _, out = call(f"experiment={mine()}", "runs_dir=here", *words)
    assert given == settings
    assert "4 runs: 4 waiting" in out


def test_a_suite_that_is_stopped_says_so_with_the_code_for_later(call, mine, monkeypatch):
    monkeypatch.setattr(suite, "run_locally", lambda queue, **places: False)
    message, out = call(f"experiment={mine()}", "runs_dir=here")
    assert message == 75
    assert out.splitlines()[-1] == "stopped; the same command goes on."


def test_a_search_adds_its_trials_to_the_experiment(call, mine, trained, tmp_path, locks_held):
    pytest.importorskip("optuna")
    search = {"search": {"optim.lr": {"low": 1e-4, "high": 1e-2, "log": True}}, "trials": 2}
    message, out = call(f"experiment={mine(variants={'a': {}, 'tuned': search})}", "runs_dir=here")
    assert message == 0
    assert locks_held == [[".experiment.lock"]] * 3  # at the beginning, and for each trial
    stored = read_experiment(tmp_path / "here" / "experiment.yaml")
    assert [name for name in stored.variants if name.startswith("tuned trial")] == ["tuned trial 0", "tuned trial 1"]
    assert call("status", "runs_dir=here", "variants=tuned")[1].splitlines()[-1] == "4 runs: 4 finished"
    assert stored.searches["tuned"].trials == 2
    _, out = call("status", "runs_dir=here")
    assert out.splitlines()[-1] == "6 runs: 6 finished"
    message, out = call(f"experiment={mine(variants={'a': {}, 'tuned': search})}", "runs_dir=here")
    assert message == 0
    assert "6 runs: 6 finished" in out


def test_a_search_goes_on_by_its_folder_alone(call, mine, monkeypatch):
    pytest.importorskip("optuna")
    monkeypatch.setattr(suite, "run_locally", lambda queue, **places: queue.next() is None)
    search = {"search": {"optim.lr": [1e-3, 1e-4]}, "trials": 1}
    for begin in (f"experiment={mine(variants={'tuned': search}, base=None)}", None):
        message, out = call(*filter(None, (begin, "runs_dir=here", "seeds=1")))
        assert message == 75
        assert "1 runs: 1 waiting" in out
        assert "tuned: no trial is finished" in out.splitlines()


def test_slurm_gets_the_runs_that_are_left(call, mine, trained, tmp_path):
    call(f"experiment={mine()}", "seeds=1", "runs_dir=here")
    message, out = call(
        f"experiment={mine()}", "engine=slurm", "runs_dir=here", "sbatch=--time=1:00:00 --mem=8G", "workers=1"
    )
    assert message is None
    script = tmp_path / "here" / "slurm.sh"
    assert out == f"2 runs; submit them: sbatch {script}\n"
    assert "#SBATCH --array=0-1%1\n" in script.read_text()
    assert "#SBATCH --mem=8G\n" in script.read_text()
    call(f"experiment={mine()}", "runs_dir=here")
    message, out = call(f"experiment={mine()}", "engine=slurm", "runs_dir=here")
    assert out == "mine: all 4 runs are finished; nothing to do\n"


def test_slurm_gets_a_run_that_was_stopped_or_failed_and_tries_it_as_often_as_told(call, mine, tmp_path):
    pick = f"experiment={mine()}", "variants=a", "runs_dir=here"
    for seed in (1, 2):
        (tmp_path / "here" / "a" / "cup-catch" / f"seed{seed}").mkdir(parents=True)
    folder = tmp_path / "here" / "a" / "cup-catch"
    (folder / "seed1" / "suite.log").write_text("suite: failed: the simulator is gone\n")
    (folder / "seed2" / "train.csv").write_text("env_steps,decision_steps,updates,wall_time_s\n200,100,0,9.0\n")
    _, out = call(*pick, "engine=slurm", "retries=5")
    assert out.startswith("2 runs; submit them: sbatch ")
    assert '[ "$tries" -gt 5 ]' in (tmp_path / "here" / "slurm.sh").read_text()


# -- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["experiment=dynamics-ensmble"],
            "unknown experiment 'dynamics-ensmble'; did you mean dynamics-ensemble? A path",
        ),
        (["experiment=none.yaml"], "experiment=none.yaml is not a file."),
        ([], "experiment=... is missing: the name of an experiment; `suite list` lists them."),
        (["status"], "experiment=... is missing"),
        (["status", "runs_dir=none"], "runs_dir=none holds no experiment; begin it with experiment=NAME."),
        (
            ["experiment=cpu-easy", "seeds=0"],
            "seeds of this call must be a list of numbers or how many, at least 1, got 0",
        ),
        (["status", "experiment=cpu-easy"], "runs_dir={here}/runs/cpu-easy holds no experiment; begin it, or name its"),
        (
            ["stauts", "experiment=cpu-easy"],
            "unknown word 'stauts'; a setting is written name=value, --help lists them.",
        ),
        (
            ["experiment=cpu-easy", "task=walker-walk"],
            "task is not for a suite, which gives it to each run; write tasks=",
        ),
        (["experiment=cpu-easy", "seed=7"], "seed is not for a suite, which gives it to each run; write seeds=3 for "),
        (
            ["experiment=cpu-easy", "run_dir=a"],
            "run_dir is not for a suite, which gives it to each run; write runs_dir",
        ),
        (
            ["experiment=cpu-easy", "resume=true"],
            "resume is not for a suite, which gives it to each run; leave it out,",
        ),
        (["experiment=cpu-easy", "taks=a"], "unknown setting taks; did you mean tasks? --help lists all."),
        (["experiment=cpu-easy", "worker=3"], "unknown setting worker; did you mean workers? --help lists all."),
        (
            ["experiment=cpu-easy", "planner.horizont=3"],
            "unknown setting planner.horizont; did you mean planner.horizon",
        ),
        (["experiment=cpu-easy", "tasks="], "tasks must not be empty; leave it out for all that the experiment has."),
        (["experiment=cpu-easy", "seeds="], "seeds must not be empty; leave it out for all that the experiment has."),
        (["experiment=cpu-easy", "variants="], "variants must not be empty; leave it out for all"),
        (["experiment=cpu-easy", "runs_dir="], "runs_dir must not be empty; leave it out for runs/EXPERIMENT."),
        (["experiment=cpu-easy", "address=auto"], "address is for engine=ray; leave it out with engine=local."),
        (["experiment=cpu-easy", "gpus_per_run=1"], "gpus_per_run is for engine=ray; leave it out with engine=local."),
        (["experiment=cpu-easy", "sbatch=--gres=gpu:1"], "sbatch is for engine=slurm; leave it out with engine=local."),
        (
            ["experiment=cpu-easy", "engine=ray", "per_gpu=2"],
            "per_gpu is for engine=local; leave it out with engine=ray.",
        ),
        (["experiment=cpu-easy", "workers=0"], "workers must be at least 1, got 0."),
        (["experiment=cpu-easy", "workers=two"], "workers must be of type int, got 'two'."),
        (["experiment=cpu-easy", "cpus_per_run=-1"], "cpus_per_run must be at least 0, got -1.0."),
        (["experiment=cpu-easy", "engine=spark"], "engine must be one of local, ray, slurm, got 'spark'."),
        (
            ["experiment=cpu-easy", "tasks=walker-wlak"],
            "variant 'cpu' of experiment cpu-easy: unknown task 'walker-wlak'",
        ),
        (
            ["experiment=cpu-easy", "seeds=x"],
            "seeds of this call must be a list of numbers or how many, at least 1, got 'x'.",
        ),
        (["experiment=cpu-easy", "variants=gpu"], "variants must be some of cpu, got 'gpu'."),
        (
            ["experiment=cpu-easy", "planner.horizon=x"],
            "variant 'cpu' of experiment cpu-easy: planner.horizon must be of",
        ),
        (["experiment=cpu-easy", "total_env_steps=0"], "budget of {experiments}/cpu-easy.yaml must be a number of env"),
        (
            ["experiment=cpu-easy", "engine=slurm", "sbatch=gpu"],
            "sbatch must hold options written as --name=value, got",
        ),
    ],
)
def test_bad_input_is_answered_in_a_line(call, tmp_path, arguments, message):
    code, out = call(*arguments)
    assert str(code).startswith("error: " + message.format(here=tmp_path, experiments=suite.EXPERIMENTS))
    assert "\n" not in str(code)
    assert out == ""


def test_a_setting_of_a_variant_that_does_not_exist_is_found_before_anything_starts(call, mine, trained, tmp_path):
    code, _ = call(f"experiment={mine(variants={'a': {}, 'b': {'optim.lrr': 1}})}", "runs_dir=here")
    assert code.startswith("error: variant 'b' of experiment mine: unknown setting optim.lrr; known: ")
    assert trained == []
    assert not (tmp_path / "here").exists()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"planner.horizon": 0}, "planner.horizon must be at least 1, got 0."),
        ({"reanalyze.num_slices": 0}, "reanalyze.num_slices must be at least 1, got 0."),
        ({"search": {"loss.rho": [0.5, 7.0], "optim.lr": [1e-3, 1e-4]}, "trials": 2}, "loss.rho must be "),
        ({"search": {"planner.num_elites": {"low": 6, "high": 900}}, "trials": 2}, "planner.num_elites must be "),
    ],
)
def test_a_setting_that_only_a_part_refuses_is_found_before_anything_starts(call, mine, tmp_path, settings, message):
    code, _ = call(f"experiment={mine(variants={'a': {}, 'b': settings})}", "runs_dir=here", "dry_run=true")
    assert str(code).startswith(f"error: variant 'b': {message}")
    assert not (tmp_path / "here").exists()


def test_an_experiment_that_was_changed_is_never_mixed_with_what_it_was(call, mine, trained, tmp_path):
    call(f"experiment={mine()}", "runs_dir=here")
    before = (tmp_path / "here" / "experiment.yaml").read_bytes()
    code, _ = call(f"experiment={mine(variants={'a': {'loss.rho': 0.7}})}", "runs_dir=here")
    assert code == (
        f"error: experiment mine was begun in {tmp_path}/here with loss.rho=0.5 for variant 'a', now it is 0.7; choose "
        "another runs_dir for the changed one."
    )
    assert (tmp_path / "here" / "experiment.yaml").read_bytes() == before
    assert len(trained) == 1


def begun(run, **loss) -> RunDirectory:
    """The directory of a run that another version stopped after its first steps; ``None`` is a setting it had not."""
    directory, values = RunDirectory(run.path), run.config.to_dict()
    values["loss"] = {name: value for name, value in (values["loss"] | loss).items() if value is not None}
    directory.begin(values)
    directory.close()
    directory.eval.write_text("env_steps,decision_steps,updates,wall_time_s,return_mean\n100,50,0,1,2.0\n")
    return directory


@pytest.mark.parametrize(
    ("changes", "was"),
    [
        ({"rho": 0.7}, "loss.rho=0.7, now it is 0.5"),
        ({"value_replayed": None}, "loss.value_replayed=0.0, now it is 0.5"),
    ],
)
def test_a_run_that_was_begun_with_other_values_of_its_preset_is_not_mixed_in(
    call, mine, trained, tmp_path, changes, was
):
    file = mine()
    experiment = read_experiment(Path(file))
    run = experiment.runs(tmp_path / "here")[1]
    directory = begun(run, **changes)
    write_experiment(experiment, tmp_path / "here" / "experiment.yaml")
    for more in ("dry_run=true", "variants=b", "engine=slurm"):  # the experiment is one, whatever part is trained
        code, _ = call(f"experiment={file}", "runs_dir=here", more)
        assert code == f"error: {run.path} was begun with {was}; choose another runs_dir for the changed one."
    assert trained == []
    directory.eval.unlink()  # then it ended before its first step, and begins anew
    assert call(f"experiment={file}", "runs_dir=here", "dry_run=true")[0] is None


def test_a_shorter_budget_is_refused_by_its_number(call, mine, trained, tmp_path):
    call(f"experiment={mine()}", "runs_dir=here")
    code, _ = call(f"experiment={mine()}", "runs_dir=here", "total_env_steps=300", "dry_run=true")
    assert code == (
        f"error: experiment mine was begun in {tmp_path}/here with total_env_steps=400 for variant 'a', now it is 300, "
        "which is less; choose another runs_dir for the changed one."
    )


def test_the_directory_of_a_run_is_no_folder_for_many(call, mine, tmp_path):
    directory = RunDirectory(tmp_path / "here")
    directory.begin({"task": "walker-walk", "preset": "cpu", "seed": 1})
    before = sorted(path.name for path in directory.path.iterdir())
    code, _ = call(f"experiment={mine()}", "runs_dir=here")
    assert code == f"error: runs_dir={directory.path} is the directory of a run; choose a folder for many of them."
    assert sorted(path.name for path in directory.path.iterdir()) == before
    directory.close()


def test_a_file_says_its_budget_once(call, mine):
    code, _ = call(f"experiment={mine(settings={**SMALL, 'total_env_steps': 700})}", "runs_dir=here")
    assert "says budget and, in its settings, total_env_steps, which are the same; leave one out." in code


def test_a_folder_that_cannot_be_written_is_named(call, mine, tmp_path):
    (tmp_path / "file").write_text("")
    code, _ = call(f"experiment={mine()}", "runs_dir=file")
    assert (
        code
        == f"error: runs_dir={tmp_path}/file cannot be written (File exists); choose a folder that you can write to."
    )


def test_a_full_disk_is_named(call, mine, small_disk, leave_free, tmp_path):
    leave_free(small_disk, 0)
    code, _ = call(f"experiment={mine()}", f"runs_dir={small_disk}/runs")
    assert code.startswith(f"error: runs_dir={small_disk}/runs cannot be written (No space left on device); choose a")


def test_slurm_cannot_search(call, mine):
    search = {"search": {"optim.lr": [1e-3, 1e-4]}, "trials": 2}
    code, _ = call(f"experiment={mine(variants={'tuned': search})}", "engine=slurm", "runs_dir=here")
    assert code == "error: engine=slurm cannot search: the next trial depends on those before it; use local or ray."
    assert not Path("here").exists()


@pytest.mark.parametrize(("module", "package"), [("ray", "ray>=2.60,<3"), ("optuna", "optuna>=5,<6")])
def test_a_missing_extra_is_named_with_its_remedy(call, mine, monkeypatch, module, package):
    monkeypatch.setitem(sys.modules, module, None)
    search = {"search": {"optim.lr": [1e-3, 1e-4]}, "trials": 2}
    variants = {"tuned": search} if module == "optuna" else {"a": {}}
    code, _ = call(f"experiment={mine(variants=variants)}", "engine=ray", "runs_dir=here")
    assert code.endswith(f"; run: pip install '{package}'")


# -- code of one's own ------------------------------------------------------------------------------------------------

OWN = """
from torchrl_etdmpc.envs import Task
task = Task("mine", "dm_control", action_repeat=2, episode_length=1000, terminates=False)
def score(returns):
    return returns[..., -1, :, :].mean((-2, -1))
"""


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    name = f"own_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(OWN.replace('"mine"', '"cup-catch"'))
    monkeypatch.syspath_prepend(str(tmp_path))
    yield name
    sys.modules.pop(name, None)


def test_a_file_cannot_name_code_unless_the_command_line_does(call, mine, trained, own_module):
    file = mine(settings=SMALL | {"planner.score": f"{own_module}:score"}, tasks=[f"{own_module}:task"])
    code, _ = call(f"experiment={file}", "runs_dir=here")
    assert "names code, which must be given on the command line" in code
    assert own_module not in sys.modules
    code, out = call(f"experiment={file}", "runs_dir=here", f"code={own_module}:score,{own_module}:task")
    assert code == 0
    assert out.splitlines()[-1] == "4 runs: 4 finished"


def test_a_task_of_one_s_own_can_be_given_and_gone_on_with(call, mine, trained, own_module):
    for _ in range(2):
        code, out = call(f"experiment={mine()}", "runs_dir=here", f"tasks={own_module}:task")
        assert code == 0
        assert out.splitlines()[-1] == "4 runs: 4 finished"
    assert trained[0].runs[0].path.parent == Path.cwd() / "here" / "a" / f"{own_module}_task"


NO_LIMIT = """
from torchrl.envs import ActionScaling, GymEnv, TransformedEnv
def make():
    env = TransformedEnv(GymEnv("Pendulum-v1"), ActionScaling())
    env.base_env._env = env.base_env._env.unwrapped
    env.base_env._env.spec = None
    return env
"""


def test_variants_may_have_episodes_of_their_own_of_a_task_that_shows_no_limit(call, mine, own_module, tmp_path):
    pytest.importorskip("gymnasium")
    (tmp_path / f"{own_module}.py").write_text(NO_LIMIT)
    task = f"tasks={own_module}:make"
    settings = {"preset": "cpu", "task.terminates": False, "replay.seed_decisions": 40}
    lengths = {"short": {"task.episode_length": 100}, "long": {"task.episode_length": 200}}
    code, out = call(f"experiment={mine(settings=settings, variants=lengths)}", task, "dry_run=true")
    assert code is None and "task.episode_length=100" in out and "task.episode_length=200" in out
    code, _ = call(f"experiment={mine(settings=settings, variants=lengths | {'a': {}})}", task, "dry_run=true")
    assert str(code).endswith("shows no time limit; give one in env steps: task.episode_length=")
