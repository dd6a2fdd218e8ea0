from __future__ import annotations

import io
import math
import os
import pickle
import random
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from torchrl_etdmpc.envs import import_task
from torchrl_etdmpc.testing import random_slices
from torchrl_etdmpc.training import (
    Agent,
    AgentFile,
    BestAgent,
    CheckpointError,
    TrainConfig,
    build_agent,
    load_agent,
    read_agent_file,
    save_agent,
)
from torchrl_etdmpc.training.agent_file import FORMAT

OBSERVATION_DIM, ACTION_DIM = 3, 1
COUNTERS = {"env_steps": 100, "decision_steps": 50, "updates": 3, "wall_time_s": 1.5}


@pytest.fixture(scope="module")
def config(tiny_config) -> TrainConfig:
    return tiny_config(task="pendulum-swingup", episode_length=None)  # nobody plays here


def train(agent: Agent, updates: int, seed: int) -> None:
    torch.manual_seed(seed)
    for _ in range(updates):
        agent.updater.step(random_slices(OBSERVATION_DIM, ACTION_DIM))


def trained_agent(config: TrainConfig) -> Agent:
    """An agent of which every tensor has left its initial value."""
    torch.manual_seed(0)
    agent = build_agent(config, OBSERVATION_DIM, ACTION_DIM)
    train(agent, 3, seed=1)
    agent.loss.kl_scale.fill_(2.5)
    return agent


def tensors(agent: Agent) -> dict[str, Tensor]:
    """All tensors that training goes on from, by name."""
    found = {f"loss.{name}": value for name, value in agent.loss.state_dict().items()}
    found |= {f"world_model.{name}": value for name, value in agent.world_model.state_dict().items()}
    for index, moments in agent.updater.state_dict()["optimizer"]["state"].items():
        found |= {f"optimiser.{index}.{moment}": value for moment, value in moments.items()}
    return found


def torch_bytes(content: Any) -> bytes:
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory, config) -> tuple[Path, Agent, TrainConfig]:
    """An agent file and what it was made of; tests that write make a copy."""
    agent = trained_agent(config)
    path = save_agent(tmp_path_factory.mktemp("run") / "checkpoints" / "last.pt", agent, config, COUNTERS)
    return path, agent, config


def refusal(path: Path, read=read_agent_file) -> str:
    with pytest.raises(CheckpointError) as caught:
        read(path)
    message = str(caught.value)
    assert "\n" not in message
    assert "\x1b" not in message
    assert message.startswith(str(path))
    return message.removeprefix(str(path)).strip()


def test_an_agent_file_restores_every_tensor_the_configuration_and_the_counters(saved):
    path, agent, config = saved
    torch.manual_seed(99)
    loaded, loaded_config, counters = load_agent(path)
    expected, actual = tensors(agent), tensors(loaded)
    for part in (
        "target_value_params",
        "kl_scale",
        "world_model.version",
        "optimiser.0.exp_avg_sq",
        "optimiser.3.exp_avg",
    ):
        assert any(part in name for name in expected), f"the test would not notice that {part} is missing"
    assert actual.keys() == expected.keys()
    assert [name for name in expected if not torch.equal(actual[name], expected[name])] == []
    assert loaded_config == config
    assert counters == COUNTERS
    assert loaded.updater.updates == 3
    assert loaded.loss.kl_scale == 2.5


def test_the_saved_tensors_differ_from_those_of_a_new_agent(saved):
    _, agent, config = saved
    torch.manual_seed(0)
    fresh = tensors(build_agent(config, OBSERVATION_DIM, ACTION_DIM))
    learned = [name for name, _ in agent.loss.named_parameters()] + ["kl_scale"]
    trained = tensors(agent)
    unchanged = [name for name in learned if torch.equal(trained[f"loss.{name}"], fresh[f"loss.{name}"])]
    assert unchanged == []


def test_training_goes_on_from_an_agent_file_as_if_it_had_not_stopped(tmp_path, config):
    agent = trained_agent(config)
    loaded, _, _ = load_agent(save_agent(tmp_path / "last.pt", agent, config, COUNTERS))
    for one in (agent, loaded):
        train(one, 2, seed=5)
    expected, actual = tensors(agent), tensors(loaded)
    assert [name for name in expected if not torch.equal(actual[name], expected[name])] == []


def test_a_loaded_agent_s_planners_see_the_loaded_weights(saved):
    path, agent, _ = saved
    loaded, _, _ = load_agent(path)
    observation = torch.randn(2, OBSERVATION_DIM)
    for name in ("planner", "eval_planner", "reanalyze_planner"):
        noise = getattr(agent, name).draw_noise(2)
        plans = [getattr(one, name).plan(observation, noise=noise) for one in (agent, loaded)]
        assert torch.equal(plans[0].mean, plans[1].mean)


def test_the_weights_are_written_once(tmp_path, tiny_config):
    config = tiny_config(task="pendulum-swingup", model={"mlp_dim": 128})
    torch.manual_seed(0)
    agent = build_agent(config, OBSERVATION_DIM, ACTION_DIM)
    train(agent, 1, seed=1)
    size = save_agent(tmp_path / "last.pt", agent, config, COUNTERS).stat().st_size
    unique = {value.data_ptr(): value.numel() * value.element_size() for value in tensors(agent).values()}
    weights = sum(parameter.numel() * parameter.element_size() for parameter in agent.world_model.parameters())
    assert sum(unique.values()) > 3 * weights  # the weights and Adam's two moments
    assert size < sum(unique.values()) + 0.5 * weights


def test_an_agent_file_leaves_nothing_beside_it_and_makes_its_folder(saved):
    path, _, _ = saved
    assert [entry.name for entry in path.parent.iterdir()] == ["last.pt"]


def test_a_newer_file_replaces_the_older(tmp_path, saved):
    _, agent, config = saved
    path = tmp_path / "last.pt"
    for updates in (3, 4):
        save_agent(str(path), agent, config, {"updates": updates})
    assert read_agent_file(path)["counters"] == {"updates": 4}
    assert [entry.name for entry in tmp_path.iterdir()] == ["last.pt"]


def test_a_save_that_fails_keeps_the_old_file_and_leaves_no_other(tmp_path, saved, monkeypatch):
    _, agent, config = saved
    path = save_agent(tmp_path / "last.pt", agent, config, COUNTERS)
    before = path.read_bytes()

    def fill_the_disk(descriptor):
        raise OSError("No space left on device")

    monkeypatch.setattr(os, "fsync", fill_the_disk)
    with pytest.raises(OSError, match="No space left"):
        save_agent(path, agent, config, COUNTERS)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["last.pt"]


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.9, 0.999])
def test_a_file_that_was_cut_off_is_refused(tmp_path, saved, share):
    content = saved[0].read_bytes()
    path = tmp_path / "cut.pt"
    path.write_bytes(content[: int(share * len(content))])
    message = refusal(path)
    assert message.startswith("is not a readable checkpoint (")
    assert message.endswith("cut off, damaged or another kind); use another checkpoint.")


def test_random_bytes_are_refused_without_a_warning(tmp_path, recwarn):
    generator = random.Random(0)
    path = tmp_path / "noise.pt"
    for number in range(300):
        start = (b"", b"\x80", b"\x80\x02")[number % 3]  # some look like a pickle, or like one of another version
        path.write_bytes(start + generator.randbytes(generator.choice([1, 5, 50, 500])))
        assert refusal(path).startswith("is not a readable checkpoint (")
    assert list(recwarn) == []


class Code:
    """Unpickling it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self):
        return Path.mkdir, (self.folder,)


@pytest.mark.parametrize("pack", [torch_bytes, pickle.dumps], ids=["PyTorch file", "bare pickle"])
def test_code_in_a_file_is_refused_and_not_run(tmp_path, pack):
    path, folder = tmp_path / "code.pt", tmp_path / "made by the code"
    content = pack({"format": 1, "world_model": Code(folder)})
    path.write_bytes(content)
    message = refusal(path)
    assert message.startswith("is not a readable checkpoint (")
    assert "weights_only" not in message  # PyTorch's own text tells how to run the code
    assert not folder.exists()
    torch.load(io.BytesIO(content), weights_only=False) if pack is torch_bytes else pickle.loads(content)
    assert folder.exists()  # it was real code


@pytest.mark.parametrize(
    "content", [3, [1, 2], torch.ones(3), {"state_dict": {"weight": torch.ones(2)}}, {"format": 1}]
)
def test_another_pytorch_file_is_refused(tmp_path, content):
    path = tmp_path / "other.pt"
    torch.save(content, path)
    assert refusal(path) == "is a PyTorch file but not a checkpoint of torchrl_etdmpc."


def edited(saved: tuple, path: Path, **changes: Any) -> Path:
    """A copy of the file with other entries; ``None`` removes one."""
    content = read_agent_file(saved[0]) | changes
    torch.save({name: value for name, value in content.items() if value is not None}, path)
    return path


def test_another_format_is_refused(tmp_path, saved):
    path = edited(saved, tmp_path / "new.pt", format=FORMAT + 1)
    assert refusal(path) == f"has checkpoint format {FORMAT + 1}; this version reads format {FORMAT}."


def test_an_agent_file_that_lacks_entries_is_refused_with_their_names(tmp_path, saved):
    path = edited(saved, tmp_path / "part.pt", updater=None, counters=None)
    assert refusal(path) == "is not a whole checkpoint: it lacks counters, updater."


@pytest.mark.parametrize("name", ["missing.pt", "."])
def test_a_path_that_is_no_file_is_refused(tmp_path, name):
    path = tmp_path / name
    assert refusal(path) == "is not a file; pass a checkpoint such as RUN_DIR/checkpoints/last.pt."


def test_the_path_of_an_agent_file_may_begin_at_home(saved, monkeypatch):
    monkeypatch.setenv("HOME", str(saved[0].parent))
    assert read_agent_file("~/last.pt")["counters"] == COUNTERS


@pytest.mark.parametrize("sizes", [(24, 6), (OBSERVATION_DIM, 6), (24, ACTION_DIM)])
def test_an_environment_of_another_size_is_refused_with_the_task_that_fits(saved, sizes):
    message = refusal(saved[0], lambda path: load_agent(path, observation_dim=sizes[0], action_dim=sizes[1]))
    assert message == (
        f"was trained with observation size {OBSERVATION_DIM} and action size {ACTION_DIM}, the environment has "
        f"{sizes[0]} and {sizes[1]}; use the task it was trained on (pendulum-swingup)."
    )


def test_an_environment_of_the_same_size_is_accepted(saved):
    agent, _, _ = load_agent(saved[0], observation_dim=OBSERVATION_DIM, action_dim=ACTION_DIM)
    assert agent.world_model.observation_dim == OBSERVATION_DIM


@pytest.mark.parametrize("change", [{"mlp_dim": 32}, {"latent_dim": 20}])
def test_weights_that_do_not_fit_their_configuration_are_refused(tmp_path, saved, change, config):
    config = saved[2].to_dict()
    path = edited(saved, tmp_path / "odd.pt", config={**config, "model": {**config["model"], **change}})
    assert refusal(path, load_agent).startswith("does not fit its own configuration (")


def test_compilation_can_be_overridden_on_loading(tmp_path, saved, monkeypatch):
    path = edited(saved, tmp_path / "compiled.pt", config={**saved[2].to_dict(), "compile": "default"})
    calls = []
    monkeypatch.setattr(torch, "compile", lambda function, **options: calls.append(function) or function)
    _, config, _ = load_agent(path, compile_setting="off")
    assert config.compile == "off"
    assert calls == []
    _, config, _ = load_agent(path)
    assert config.compile == "default"
    assert calls != []


def test_an_agent_file_of_the_code_before_is_read(tmp_path, saved):
    # The same entries; its settings had no task of their own, a plain flag for the termination head, and a dtype.
    _, agent, config = saved
    settings = config.to_dict()
    for name in ("action_repeat", "episode_length", "terminates"):
        del settings[name]
    settings["model"]["termination"] = False
    settings["planner"]["scoring_dtype"] = settings["reanalyze"]["scoring_dtype"] = "float32"
    content = {
        "format": 2,
        "config": settings,
        "observation_dim": OBSERVATION_DIM,
        "action_dim": ACTION_DIM,
        "world_model": agent.world_model.state_dict(),
        "loss": agent.loss.state_dict(),
        "updater": agent.updater.state_dict(),
        "counters": COUNTERS,
    }
    assert set(content["updater"]) == {"optimizer", "skipped", "skipped_in_a_row"}
    path = tmp_path / "old.pt"
    torch.save(content, path)
    loaded, loaded_config, counters = load_agent(path)
    expected, actual = tensors(agent), tensors(loaded)
    assert [name for name in expected if not torch.equal(actual[name], expected[name])] == []
    assert counters == COUNTERS
    assert loaded_config.task_spec == config.task_spec
    assert loaded.world_model.termination_head is None
    observation, noise = torch.randn(2, OBSERVATION_DIM), agent.planner.draw_noise(2)
    plans = [one.planner.plan(observation, noise=noise) for one in (agent, loaded)]
    assert torch.equal(plans[0].mean, plans[1].mean)  # naming the weights' own dtype changes nothing


def test_an_agent_file_with_a_task_in_code_asks_for_it_on_the_command_line(tmp_path, saved):
    path = edited(saved, tmp_path / "user.pt", config={**saved[2].to_dict(), "task": "os:getcwd"})
    message = refusal(path, load_agent)
    assert "task 'os:getcwd' names code, which must be given on the command line: task=os:getcwd" in message


def test_a_setting_of_another_version_is_refused_with_the_file_s_name(tmp_path, saved):
    config = saved[2].to_dict()
    path = edited(saved, tmp_path / "newer.pt", config={**config, "planner": {**config["planner"], "newer": 1}})
    assert refusal(path, load_agent).startswith("holds an agent that cannot be rebuilt: unknown setting planner.newer;")


def test_what_a_task_of_one_s_own_was_is_stored_with_its_agent(tmp_path, saved, monkeypatch):
    pytest.importorskip("gymnasium")
    (tmp_path / "agents_own.py").write_text(
        "from torchrl.envs import ActionScaling, GymEnv, TransformedEnv\n"
        "def make(): return TransformedEnv(GymEnv('Pendulum-v1'), ActionScaling())\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    import_task("agents_own:make", terminates=True)
    config = TrainConfig.from_dict({**saved[2].to_dict(), "task": "agents_own:make", "episode_length": None})
    path = save_agent(tmp_path / "own.pt", build_agent(config, 3, 1), config, COUNTERS)
    trained, _, _ = load_agent(path)
    import_task("agents_own:make", episode_length=50, terminates=False)  # as a command that is told otherwise
    loaded, again, _ = load_agent(path)
    assert (again.task_spec.episode_length, again.task_spec.terminates) == (200, True)
    assert loaded.planner.discount == trained.planner.discount


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("config", [1], "is not a checkpoint: its config is of type list, not dict."),
        ("observation_dim", "5", "is not a checkpoint: its observation_dim is of type str, not int."),
        ("world_model", 3, "is not a checkpoint: its world_model is of type int, not Mapping."),
        ("loss", {"scale": 1.0}, "is not a checkpoint: scale is no tensor but of type float."),
        ("loss", {"scale": torch.tensor(math.nan)}, "cannot be used: scale holds numbers that are not finite."),
        ("loss", {"scale": torch.tensor(math.inf)}, "cannot be used: scale holds numbers that are not finite."),
        (
            "updater",
            {"averaged": {"policy.bias": torch.tensor(math.nan)}},
            "cannot be used: policy.bias holds numbers that are not finite.",
        ),
        ("updater", {"averaged": 3}, "does not fit its own configuration ("),
        ("config", {"preset": "cpu"}, "is not a whole checkpoint: its config lacks task."),
        ("config", {"task": "cup-catch"}, "is not a whole checkpoint: its config lacks planner."),
        ("world_model", {}, "does not fit its own configuration ("),
        ("updater", {}, "does not fit its own configuration ("),
        ("updater", {"optimizer": {"state": 3}}, "does not fit its own configuration ("),
    ],
)
def test_what_is_wrong_inside_a_file_is_named_before_it_is_used(tmp_path, saved, name, value, message):
    path = edited(saved, tmp_path / "odd.pt", **{name: value})
    assert refusal(path, load_agent).startswith(message)


def test_a_flipped_bit_is_noticed_or_changes_nothing(tmp_path, saved):
    data, generator, path = saved[0].read_bytes(), random.Random(0), tmp_path / "flipped.pt"
    before, noticed = read_agent_file(saved[0])["world_model"], 0
    for _ in range(100):
        flipped = bytearray(data)
        flipped[generator.randrange(len(data))] ^= 1 << generator.randrange(8)
        path.write_bytes(flipped)
        try:
            content = read_agent_file(path)
        except CheckpointError:
            noticed += 1
            continue
        assert content["counters"] == COUNTERS
        assert all(torch.equal(content["world_model"][key], before[key]) for key in content["world_model"])
    assert noticed > 50


@pytest.mark.parametrize("kind", ["a pipe", "a huge file"])
def test_what_cannot_be_an_agent_is_refused_before_it_is_read(tmp_path, kind):
    path = tmp_path / "last.pt"
    if kind == "a pipe":
        os.mkfifo(path)
    else:
        with path.open("wb") as file:
            file.truncate(2**43)  # takes no space
    assert refusal(path).startswith("is not a readable checkpoint (it ")


def test_the_best_agent_is_the_one_that_was_evaluated_best(tmp_path, saved, small_disk, leave_free):
    _, agent, config = saved
    step = [0]
    path = small_disk / "checkpoints" / "best.pt"
    best = BestAgent(AgentFile(agent, config, lambda: {"env_steps": step[0]}), path)
    for value, kept in ((3.0, 1), (2.0, 1), (5.0, 3), (5.0, 4), (math.nan, 4)):
        step[0] += 1
        best.note(value)
        assert load_agent(path)[2] == {"env_steps": kept}  # of two alike the later one
    leave_free(small_disk, 0)
    with pytest.warns(UserWarning, match=r"best\.pt cannot be written \(No space left on device\); it is tried again"):
        best.note(6.0)
    step[0] += 1
    leave_free(small_disk, None)
    best.write()
    assert load_agent(path)[2] == {"env_steps": 5}  # not what the agent has become
    state = best.state_dict()
    best.note(7.0)
    again = BestAgent(best.agent, tmp_path / "other" / "best.pt")
    again.load_state_dict(state)
    assert again.path.read_bytes() != path.read_bytes()
    assert load_agent(again.path)[2] == {"env_steps": 5}
    again.note(5.5)
    assert load_agent(again.path)[2] == {"env_steps": 5}
