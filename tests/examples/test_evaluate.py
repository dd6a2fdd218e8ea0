from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pandas as pd
import pytest
import torch

pytest.importorskip("dm_control")
pytest.importorskip("hydra")

from torchrl_etdmpc.collectors import Episodes, evaluate  # noqa: E402
from torchrl_etdmpc.commands.agent_command import AgentCommandConfig, PlannerCommandConfig  # noqa: E402
from torchrl_etdmpc.envs import get_task, make_env  # noqa: E402
from torchrl_etdmpc.envs.layers import simulator_of  # noqa: E402
from torchrl_etdmpc.inspector import with_settings  # noqa: E402
from torchrl_etdmpc.planners import BarePolicy  # noqa: E402
from torchrl_etdmpc.training import load_agent, save_agent  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "examples" / "evaluate.py"
TASK = get_task("cartpole-balance", episode_length=100)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory, save_untrained) -> Path:
    return save_untrained(tmp_path_factory.mktemp("run"), 5, task=TASK.name, episode_length=TASK.episode_length)


@pytest.fixture
def run_main(run_here) -> Callable[..., tuple[str | None, str, str]]:
    return partial(run_here, "evaluate.py")


def closing_line(returns: torch.Tensor, policy: str) -> str:
    return (
        f"cartpole-balance ({policy}, trained for 400 env steps): return {returns.mean():.1f} "
        f"+- {returns.std(correction=0):.1f} over {len(returns)} episode{'s' if len(returns) > 1 else ''}"
    )


def test_the_planner_s_returns_are_printed_in_one_line(tmp_path, checkpoint, run_script):
    process = run_script(SCRIPT, f"checkpoint={checkpoint}", "episodes=1", "seed=5", "device=cpu", cwd=tmp_path)
    assert process.returncode == 0, process.stderr
    assert process.stderr == ""
    assert list(tmp_path.iterdir()) == []
    agent, _, _ = load_agent(checkpoint)
    env = make_env(TASK, seed=5).append_transform(agent.eval_planner.make_tensordict_primer())
    torch.manual_seed(5)
    assert process.stdout == closing_line(evaluate(env, agent.eval_planner, episodes=1).returns, "planner") + "\n"


def test_the_bare_policy_s_returns_are_printed_in_one_line(tmp_path, checkpoint, run_main):
    message, out, err = run_main(f"checkpoint={checkpoint}", "episodes=2", "policy=bare", "seed=5", "device=cpu")
    assert (message, err) == (None, "")
    agent, _, _ = load_agent(checkpoint)
    env = make_env(TASK, seed=5, num_envs=2, parallel=False)
    assert out == closing_line(evaluate(env, BarePolicy(agent.world_model), episodes=2).returns, "bare") + "\n"
    assert list(tmp_path.iterdir()) == []


def test_the_bare_policy_is_that_of_the_averaged_weights_if_the_agent_has_them(tmp_path, save_untrained, run_main):
    task = {"task": TASK.name, "episode_length": TASK.episode_length}
    checkpoint = save_untrained(tmp_path, 5, **task, optim={"average_decay": 0.9})
    agent, config, _ = load_agent(checkpoint)
    torch.nn.init.normal_(agent.world_model.policy.output.weight)  # what is trained goes on, its average stays
    save_agent(checkpoint, agent, config, {"env_steps": 400})
    env = make_env(TASK, seed=5, num_envs=2, parallel=False)
    acting = evaluate(env, BarePolicy(agent.acting_model), episodes=2).returns
    message, out, _ = run_main(f"checkpoint={checkpoint}", "episodes=2", "policy=bare", "seed=5", "device=cpu")
    assert (message, out) == (None, closing_line(acting, "bare") + "\n")
    env.set_seed(5)
    assert evaluate(env, BarePolicy(agent.world_model), episodes=2).returns.mean() != acting.mean()


def test_every_episode_has_its_line_in_a_table(tmp_path, monkeypatch, checkpoint, run_main):
    monkeypatch.setenv("HOME", str(tmp_path))
    message, out, err = run_main(
        f"checkpoint={checkpoint}", "episodes=3", "policy=bare", "seed=5", "device=cpu", "csv=~/tables/a.csv"
    )
    assert (message, err) == (None, "")
    assert out.endswith(f" over 3 episodes; episodes in {tmp_path}/tables/a.csv\n")
    assert [path.name for path in tmp_path.iterdir()] == ["tables"]
    agent, _, _ = load_agent(checkpoint)
    env = make_env(TASK, seed=5, num_envs=3, parallel=False)
    played = evaluate(env, BarePolicy(agent.world_model), episodes=3)
    assert len(set(played.returns.tolist())) == 3
    table = pd.read_csv(tmp_path / "tables" / "a.csv")
    assert list(table.columns) == ["episode", "return", "decisions"]
    assert table["episode"].tolist() == [0, 1, 2]
    assert table["return"].tolist() == played.returns.tolist()
    assert table["decisions"].tolist() == [50, 50, 50]


def test_an_agent_whose_file_is_replaced_while_it_plays_loses_no_returns(tmp_path, monkeypatch, checkpoint, run_main):
    """A run that goes on does so."""
    own = tmp_path / "last.pt"
    own.write_bytes(checkpoint.read_bytes())

    def play_and_remove(*arguments, **options):
        own.unlink()
        return evaluate(*arguments, **options)

    monkeypatch.setattr("torchrl_etdmpc.commands.evaluate.evaluate", play_and_remove)
    settings = ("episodes=2", "device=cpu", "planner.horizon=1", "task.episode_length=40", "csv=here.csv")
    message, out, err = run_main(f"checkpoint={own}", *settings)
    assert (message, err) == (None, "")
    assert out.startswith("cartpole-balance with episode_length=40 (planner with horizon=1, trained for 400 env steps)")
    assert len((tmp_path / "here.csv").read_text().splitlines()) == 3


def test_a_table_is_written_anew_and_another_file_stays(tmp_path, checkpoint, run_main):
    arguments = (f"checkpoint={checkpoint}", "episodes=1", "policy=bare", "device=cpu", "task.episode_length=20")
    (tmp_path / "a.csv").write_text("episode,return,decisions\n0,1.0,1\n1,1.0,1\n")
    message, out, _ = run_main(*arguments, "csv=a.csv")
    assert message is None
    assert out.startswith("cartpole-balance with episode_length=20 (bare, trained for 400 env steps): return ")
    assert out.endswith(" over 1 episode; episodes in a.csv\n")
    assert len((tmp_path / "a.csv").read_text().splitlines()) == 2
    for content in ("", "env_steps,return_mean\n0,1.0\n", "\0ü"):
        (tmp_path / "eval.csv").write_text(content)
        message, out, _ = run_main(*arguments, "csv=eval.csv")
        assert message == "error: csv=eval.csv is there, and is no table of evaluated episodes; choose another file."
        assert out == ""
        assert (tmp_path / "eval.csv").read_text() == content


def test_a_sweep_over_seeds_writes_a_table_for_each(tmp_path, checkpoint, run_main):
    message, out, _ = run_main(
        "--multirun", f"checkpoint={checkpoint}", "episodes=1", "policy=bare", "device=cpu", "seed=1,2",
        "task.episode_length=20", "csv=tables/${seed}.csv",
    )  # fmt: skip
    assert message is None
    assert [line.rpartition(" ")[2] for line in out.splitlines() if "episodes in" in line] == [
        "tables/1.csv",
        "tables/2.csv",
    ]
    assert sorted(path.name for path in (tmp_path / "tables").iterdir()) == ["1.csv", "2.csv"]


def test_the_table_says_which_episodes_are_a_success(tmp_path, monkeypatch, checkpoint, run_main):
    returns = torch.tensor([80.0, 120.0, 100.0])
    monkeypatch.setattr("torchrl_etdmpc.commands.evaluate.success_return", lambda task: 100.0)
    monkeypatch.setattr(
        "torchrl_etdmpc.commands.evaluate.evaluate", lambda *args, **options: Episodes(returns, torch.tensor([9, 7, 8]))
    )
    message, out, err = run_main(f"checkpoint={checkpoint}", "episodes=3", "device=cpu", "csv=a.csv")
    assert (message, err) == (None, "")
    assert ", 2 of them at 100 or more, a success; episodes in a.csv" in out
    assert (tmp_path / "a.csv").read_text() == (
        "episode,return,decisions,success\n0,80.0,9,0\n1,120.0,7,1\n2,100.0,8,1\n"
    )


def test_a_film_that_cannot_be_written_costs_no_returns(tmp_path, monkeypatch, checkpoint, run_main):
    def fail(*args, **options) -> None:
        raise OSError("path=film.mp4 cannot be written (No space left on device).")

    where = "torchrl_etdmpc.commands.evaluate."
    monkeypatch.setattr(where + "render_frame", lambda *args: torch.zeros(3, 2, 2))
    monkeypatch.setattr(where + "film_writer", lambda path: None)
    monkeypatch.setattr(where + "write_film", fail)
    message, out, _ = run_main(
        f"checkpoint={checkpoint}", "episodes=2", "policy=bare", "device=cpu", "csv=a.csv", "video=film.mp4"
    )
    assert message == "error: path=film.mp4 cannot be written (No space left on device)."
    assert out.endswith(" over 2 episodes; episodes in a.csv\n")
    assert len((tmp_path / "a.csv").read_text().splitlines()) == 3


def test_an_agent_can_be_evaluated_on_another_task_of_its_size(checkpoint, run_main):
    message, out, err = run_main(
        f"checkpoint={checkpoint}", "task=cartpole-swingup", "episodes=1", "policy=bare", "device=cpu"
    )
    assert (message, err) == (None, "")
    assert out.startswith("cartpole-swingup (bare, trained on cartpole-balance for 400 env steps): return ")


def test_another_task_is_played_as_the_agent_s_own_was(tmp_path, save_untrained):
    checkpoint = str(save_untrained(tmp_path, 5, task="cartpole-balance", action_repeat=4, episode_length=400))
    spec = AgentCommandConfig(checkpoint=checkpoint, task="cartpole-swingup").task_spec
    assert (spec.name, spec.action_repeat, spec.episode_length) == ("cartpole-swingup", 4, 400)
    told = AgentCommandConfig(checkpoint=checkpoint, task="cartpole-swingup", action_repeat=2).task_spec
    assert (told.action_repeat, told.episode_length) == (2, 400)


def test_another_planner_discounts_as_the_agent_s_own_does(tmp_path, save_untrained):
    checkpoint = str(save_untrained(tmp_path, 5, task="cartpole-balance", loss={"discount": 0.9}))
    agent, config, _ = load_agent(checkpoint)
    planner = PlannerCommandConfig(checkpoint=checkpoint, planner=config.planner).planner_of(agent)
    assert planner.discount == agent.eval_planner.discount == 0.9


def test_an_agent_of_a_gymnasium_task_is_evaluated_as_it_was_trained(tmp_path, run_main, save_untrained):
    pytest.importorskip("gymnasium")
    task = {"task": "gym/Pendulum-v1", "action_repeat": 2, "episode_length": 40}
    checkpoint = save_untrained(tmp_path, 3, **task)
    message, out, err = run_main(f"checkpoint={checkpoint}", "episodes=2", "seed=5", "device=cpu")
    assert (message, err) == (None, "")
    agent, config, _ = load_agent(checkpoint)
    assert config.task_spec.decision_steps_per_episode == 20
    env = make_env(config.task_spec, seed=5, num_envs=2, parallel=False)
    env = env.append_transform(agent.eval_planner.make_tensordict_primer())
    torch.manual_seed(5)
    line = closing_line(evaluate(env, agent.eval_planner, episodes=2).returns, "planner")
    assert out == line.replace("cartpole-balance", "gym/Pendulum-v1") + "\n"


def test_the_command_may_change_the_protocol(tmp_path, run_main, save_untrained):
    pytest.importorskip("gymnasium")
    checkpoint = save_untrained(tmp_path, 3, task="gym/Pendulum-v1", action_repeat=2, episode_length=40)
    common = (f"checkpoint={checkpoint}", "episodes=1", "policy=bare", "device=cpu", "task.action_repeat=4")
    returns = []
    for arguments in (["task.episode_length=8"], ["task=gym/Pendulum-v1", "task.episode_length=4"]):
        message, out, err = run_main(*common, *arguments)
        assert (message, err) == (None, "")
        returns.append(float(out.split("return ")[1].split()[0]))
    assert returns[0] < returns[1] < 0  # two decisions from the same state cost more than the first alone


def test_the_command_may_change_the_planner(checkpoint, run_main):
    common = (f"checkpoint={checkpoint}", "episodes=1", "seed=5", "device=cpu", "task.episode_length=40")
    as_trained = run_main(*common)
    assert run_main(*common, "planner.horizon=2") == as_trained  # what it was trained with
    message, out, err = run_main(*common, "planner.horizon=4", "planner.num_samples=20")
    assert (message, err) == (None, "")
    assert out.startswith(
        "cartpole-balance with episode_length=40 (planner with horizon=4, num_samples=20, trained for 400 env "
        "steps): return "
    )
    agent, _, _ = load_agent(checkpoint)
    planner = with_settings(agent.eval_planner, horizon=4, num_samples=20)
    env = make_env(get_task("cartpole-balance", episode_length=40), seed=5, num_envs=1, parallel=False)
    torch.manual_seed(5)
    returns = evaluate(env.append_transform(planner.make_tensordict_primer()), planner, episodes=1).returns
    assert f"return {returns.mean():.1f} +- " in out


def test_a_film_ends_with_the_first_episode(tmp_path, monkeypatch, run_main, save_untrained):
    """Even if it terminates early and others follow."""
    pytest.importorskip("gymnasium")
    pytest.importorskip("mujoco")
    checkpoint = save_untrained(tmp_path, 4, task="gym/InvertedPendulum-v5")
    pictures, films = [], []

    def render_frame(env):
        pictures.append(torch.as_tensor(simulator_of(env)._env.unwrapped.data.qpos.copy()))
        return pictures[-1]

    monkeypatch.setattr("torchrl_etdmpc.commands.evaluate.render_frame", render_frame)
    monkeypatch.setattr(
        "torchrl_etdmpc.commands.evaluate.write_film", lambda frames, path, fps: films.append(torch.stack(frames))
    )
    arguments = ("episodes=3", "policy=bare", "device=cpu", "video=a.mp4", "seed=10")
    message, out, err = run_main(f"checkpoint={checkpoint}", *arguments)
    assert (message, err) == (None, "")
    agent, config, _ = load_agent(checkpoint)
    envs = make_env(config.task_spec, seed=10, num_envs=3, parallel=False)
    seen = []  # observations of InvertedPendulum begin with its positions
    played = evaluate(
        envs, BarePolicy(agent.world_model), episodes=3, on_step=lambda step: seen.append(step["observation"][0, :2])
    )
    length = played.lengths[0].item()
    assert length < played.lengths.max() < 200
    torch.testing.assert_close(films[0], torch.stack(seen[:length]).double(), rtol=0, atol=1e-6)


def test_a_gif_has_small_frames_and_any_film_one_of_each_decision(monkeypatch, run_main, checkpoint):
    where, films, sizes = "torchrl_etdmpc.commands.evaluate.", [], []

    def render_frame(env, *size):
        sizes.append(size)
        return torch.zeros(2, 2, 3, dtype=torch.uint8)

    monkeypatch.setattr(where + "render_frame", render_frame)
    monkeypatch.setattr(where + "write_film", lambda frames, path, fps: films.append((len(frames), path, fps)))
    same = (f"checkpoint={checkpoint}", "episodes=2", "policy=bare", "device=cpu", "task.episode_length=20")
    for file in ("a.gif", "a.mp4"):
        assert run_main(*same, f"video={file}")[0] is None
    assert films == [(10, "a.gif", 50), (10, "a.mp4", 50)]
    assert sizes == [(200, 200)] * 10 + [()] * 10


@pytest.mark.parametrize("policy", ["bare", "planner"])
@pytest.mark.parametrize("episodes", [1, 3])
def test_a_film_changes_none_of_the_episodes(tmp_path, monkeypatch, run_main, save_untrained, policy, episodes):
    checkpoint = save_untrained(tmp_path, 5, task="cartpole-balance")
    picture = torch.zeros(2, 2, 3, dtype=torch.uint8)
    monkeypatch.setattr("torchrl_etdmpc.commands.evaluate.render_frame", lambda env: picture)
    monkeypatch.setattr("torchrl_etdmpc.commands.evaluate.write_film", lambda *_, **__: None)
    same = [f"checkpoint={checkpoint}", f"episodes={episodes}", f"policy={policy}", "device=cpu", "seed=3"]
    same.append("task.episode_length=60")
    for more in (["csv=without.csv"], ["csv=with.csv", "video=a.mp4"]):
        assert run_main(*same, *more)[0] is None
    assert Path("with.csv").read_text() == Path("without.csv").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "checkpoint=... is missing: an agent file, e.g. runs/"),
        (["checkpoint=nowhere.pt"], "nowhere.pt is not a file; pass a checkpoint such as "),
        (["checkpoint=noise.pt"], "noise.pt is not a readable checkpoint ("),
        (["checkpoint=GOOD", "task=walker-walk"], "GOOD was trained with observation size 5 and action size 1, the "),
        (["checkpoint=GOOD", "episodes=0"], "episodes must be between 1 and 10000, got 0."),
        (["checkpoint=GOOD", "episodes=10001"], "episodes must be between 1 and 10000, got 10001."),
        (["checkpoint=GOOD", "seed=-1"], "seed must be in [0, 2**32 - 1], got -1."),
        (["checkpoint=GOOD", "seed=4294967296"], "seed must be in [0, 2**32 - 1], got 4294967296."),
        (["checkpoint=GOOD", "policy=best"], "policy must be one of planner, bare, got 'best'."),
        (["checkpoint=GOOD", "policy=bare", "planner.horizon=4"], "planner.horizon changes nothing with policy=bare, "),
        (["checkpoint=GOOD", "planner.horizon=0"], "planner.horizon must be at least 1, got 0."),
        (["checkpoint=GOOD", "video=film.avi"], "video must end in .mp4 or .gif, got 'film.avi'."),
        (["checkpoint=GOOD", "video=noise.pt/film.mp4"], "noise.pt/film.mp4 cannot be written (File exists); choose "),
        (["checkpoint=GOOD", "csv=folder.csv"], "folder.csv is a folder; name a file."),
        (["checkpoint=GOOD", "csv=/proc/a.csv"], "/proc/a.csv cannot be written ("),
        (["checkpoint=GOOD", "csv=a.txt"], "csv must end in .csv, got 'a.txt'."),
        (["checkpoint=GOOD", "csv=noise.pt/b/a.csv"], "noise.pt/b/a.csv cannot be written (Not a directory); choose "),
        (["checkpoint=GOOD", "epsiodes=2"], "unknown setting epsiodes; did you mean episodes?"),
        (["checkpoint=GOOD", "device=cuda"], "device=cuda needs a CUDA device and this PyTorch sees none; use "),
    ],
)
def test_a_bad_input_ends_in_one_line(tmp_path, monkeypatch, checkpoint, run_main, arguments, message):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    (tmp_path / "noise.pt").write_bytes(b"\x80\x02noise")
    (tmp_path / "folder.csv").mkdir()
    error, out, err = run_main(*(argument.replace("GOOD", str(checkpoint)) for argument in arguments))
    assert error.startswith("error: " + message.replace("GOOD", str(checkpoint)))
    assert "\n" not in error
    assert (out, err) == ("", "")
    assert {path.name for path in tmp_path.iterdir()} == {"noise.pt", "folder.csv"}


def test_a_machine_that_cannot_render_is_noticed_before_the_episodes(tmp_path, monkeypatch, checkpoint, run_main):
    def render_frame(env):
        raise RuntimeError("cannot render: there is no display; set MUJOCO_GL=egl before Python starts.")

    def no_episodes(*args, **options):
        raise AssertionError("the episodes had begun")

    monkeypatch.setattr("torchrl_etdmpc.commands.evaluate.render_frame", render_frame)
    monkeypatch.setattr("torchrl_etdmpc.commands.evaluate.evaluate", no_episodes)
    error, out, err = run_main(f"checkpoint={checkpoint}", "video=film.mp4", "device=cpu")
    assert error == "error: cannot render: there is no display; set MUJOCO_GL=egl before Python starts."
    assert (out, err) == ("", "")
    assert list(tmp_path.iterdir()) == []


def test_a_film_that_cannot_be_written_is_an_error_before_the_episodes(
    run_main, checkpoint, tmp_path, monkeypatch: pytest.MonkeyPatch
):
    from torchrl_etdmpc.commands import evaluate as command

    played = []
    monkeypatch.setattr(command, "render_frame", lambda env, *size: torch.zeros(32, 32, 3, dtype=torch.uint8))
    monkeypatch.setattr(command, "evaluate", lambda *arguments, **options: played.append(arguments))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)  # not installed
    error, out, err = run_main(f"checkpoint={checkpoint}", "video=film.mp4", "policy=bare", "device=cpu")
    assert error == "error: write_mp4 needs imageio-ffmpeg, which is not installed; run `pip install imageio-ffmpeg`."
    assert (played, out, err) == ([], "", "")
    assert list(tmp_path.iterdir()) == []


# Runs the script with frames that are quickly drawn.
SMALL_FRAMES = """
import functools, runpy, sys
import os
os.environ["MUJOCO_GL"] = "egl"
from torchrl_etdmpc.commands import evaluate
evaluate.render_frame = functools.partial(evaluate.render_frame, height=48, width=64)
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def test_a_film_shows_every_decision_of_the_first_episode(tmp_path, checkpoint, run_process):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    arguments = f"checkpoint={checkpoint} video=films/cartpole.mp4 episodes=2 policy=bare device=cpu".split()
    process = run_process("-c", SMALL_FRAMES, str(SCRIPT), *arguments, cwd=tmp_path)
    if "cannot render" in process.stderr:
        assert process.stderr.startswith("error: ")
        assert process.stderr.count("\n") == 1
        pytest.skip(process.stderr.strip())
    assert process.returncode == 0, process.stderr
    assert process.stdout.endswith("over 2 episodes; film in films/cartpole.mp4\n")
    assert process.stdout.count("\n") == 1
    film = tmp_path / "films" / "cartpole.mp4"
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [film]
    frames, seconds = ffmpeg.count_frames_and_secs(str(film))
    assert (frames, seconds) == (50, pytest.approx(1, abs=0.1))
    reader = ffmpeg.read_frames(str(film))
    assert next(reader)["size"] == (64, 48)
    picture = torch.frombuffer(bytearray(next(reader)), dtype=torch.uint8)
    reader.close()
    assert picture.float().std() > 5  # there is something to see
