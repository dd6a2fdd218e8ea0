from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.modules import CEMPlanner

from torchrl_etdmpc.inspector import Trace, load_trace, trace_plan, trace_torchrl_planner
from torchrl_etdmpc.inspector.inspection import Strip
from torchrl_etdmpc.inspector.saved_page import facts_of, picture, setting_rows, write_page
from torchrl_etdmpc.modules import ActionValueWorldModel, WorldModel
from torchrl_etdmpc.planners import EnsembleMPPIPlanner, LatentEnv
from torchrl_etdmpc.testing import LineWorld

pytest.importorskip("plotly")


def make(**settings) -> Trace:
    budget = {"horizon": 3, "num_samples": 16, "num_elites": 4, "num_proposals": 2, "iterations": 2}
    planner = EnsembleMPPIPlanner(LatentEnv(LineWorld(num_dynamics=2)), **budget | settings)
    return trace_plan(planner, torch.tensor([0.5]), task="<line>", notes=["no frames & no simulator"])


def content_of(folder) -> dict:
    text = (folder / "data.js").read_text()
    return json.loads(text.removeprefix("window.INSPECTION = ").removesuffix(";\n"))


def test_a_page_is_a_folder_that_asks_for_nothing_elsewhere(tmp_path):
    trace = make()
    page = write_page(tmp_path / "page", trace)
    html = page.read_text()
    named = re.findall(r'(?:src|href)="([^"]*)"', html)
    assert [name for name in named if not name.startswith("data:") and not (page.parent / name).is_file()] == []
    assert "http" not in re.sub(r"http-equiv", "", html)
    assert "&lt;line&gt;" in html and "no frames &amp; no simulator" in html
    content = content_of(page.parent)
    (side,) = content["sides"]
    assert content["iterations"] == 2
    returns = np.frombuffer(base64.b64decode(side["returns"]["data"]), "<f4").reshape(side["returns"]["shape"])
    assert np.array_equal(returns, trace["returns"])
    assert np.allclose(side["scores"], trace["scores"])
    for name in ("latent_plane", "disagreement", "plan_gaussian"):  # one of each iteration
        assert isinstance(side["figures"][name], list) and len(side["figures"][name]) == 2, name
    assert np.array_equal(load_trace(page.parent / "trace.npz")["scores"], trace["scores"])


def test_two_settings_stand_beside_each_other_with_their_differences(tmp_path):
    first, second = make(), make(score="adaptive", beta=2.0)
    page = write_page(tmp_path / "page", first, second)
    assert {row[:3] for row in setting_rows(first, second)} >= {("score", "mean", "adaptive"), ("beta", "0.0", "2.0")}
    assert "<td>score</td><td>mean</td><td>adaptive</td>" in page.read_text()
    for which, letter in (("first", "a"), ("second", "b")):
        assert f'<h2>{which} setting</h2><ul class="facts" id="facts-{letter}">' in page.read_text()
    assert len(content_of(page.parent)["sides"]) == 2
    assert np.array_equal(load_trace(page.parent / "second.npz")["scores"], second["scores"])
    write_page(tmp_path / "page", first)  # written again, with one setting
    assert not (page.parent / "second.npz").exists()
    write_page(tmp_path / "page", first, make(iterations=3))
    assert content_of(page.parent)["iterations"] == 3
    without = replace(first, arrays={name: array for name, array in first.arrays.items() if name != "policy_scores"})
    assert ("of the policy", "None", facts_of(first)["of the policy"]) in setting_rows(without, first)


def test_frames_are_pictures_in_the_page(tmp_path):
    frame = np.arange(5 * 4 * 3, dtype=np.uint8).reshape(5, 4, 3)
    content = base64.b64decode(picture(frame).removeprefix("data:image/png;base64,"))
    assert content[:8] == b"\x89PNG\r\n\x1a\n" and content[16:24] == bytes([0, 0, 0, 4, 0, 0, 0, 5])
    start = content.index(b"IDAT") + 4
    rows = np.frombuffer(zlib.decompress(content[start:-16]), np.uint8).reshape(5, 13)
    assert np.array_equal(rows[:, 1:].reshape(5, 4, 3), frame)
    page = write_page(tmp_path / "page", make(), strip=Strip([0, 7], [frame, frame]), step=7)
    assert page.read_text().count(picture(frame)) == 2
    assert 'class="here"><img alt="step 7"' in page.read_text()


def test_what_a_simulator_paid_stands_alone_where_no_reward_was_predicted(tmp_path):
    """Of TorchRL's planners, whose models are environments."""
    arrays = {name: array for name, array in make().arrays.items() if not name.startswith("chosen_rewards")}
    frames = np.zeros((3, 4, 4, 3), np.uint8)
    real = {"frames": frames, "real_rewards": np.array([0.25, 0.5], np.float32)}
    page = write_page(tmp_path / "page", replace(make(), arrays=arrays | real)).read_text()
    assert re.findall('<figure><img alt="([^"]*)"', page) == ["now", "step 1: 0.25", "step 2: 0.50"]
    both = write_page(tmp_path / "both", replace(make(), arrays=make().arrays | real)).read_text()
    assert re.search(r"step 2: 0.50, predicted -?\d", both)


def test_the_frame_nearest_to_the_state_is_marked(tmp_path):
    frame = np.zeros((4, 4, 3), np.uint8)
    page = write_page(tmp_path / "page", make(), strip=Strip([0, 7, 14], [frame] * 3), step=9)
    assert re.findall(r'class="here"><img alt="([^"]*)"', page.read_text()) == ["step 7"]


def test_a_page_that_was_cut_off_is_written_anew(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "page").mkdir()  # an empty folder will do
    (write_page("~/page", make())).unlink()
    assert write_page(tmp_path / "page", make()).is_file()


def test_the_facts_of_a_page_are_the_numbers_of_its_trace(tmp_path):
    model = WorldModel(3, 8, latent_dim=16, mlp_dim=16, num_dynamics=2)
    planner = EnsembleMPPIPlanner(LatentEnv(model), horizon=3, num_samples=16, num_elites=4, num_proposals=2)
    trace = trace_plan(planner, torch.zeros(3))
    arrays = {
        **trace.arrays,
        "value": np.array(5.0),
        "policy_scores": np.array([1.0, 4.0]),
        "action": np.arange(8) / 4,
        "chosen": np.array(3),
        "proposals": np.ones(16, bool),
        "explained": np.array([0.5, 0.25, 0.05]),
    }
    about = {**trace.manifest, "state": {"from": "replay", "row": 7}, "checkpoint": {"name": "<last> & best"}}
    changed = replace(trace, arrays=arrays, manifest=about)
    facts = facts_of(changed)
    assert {name: facts[name] for name in facts if name != "took"} == {
        "state": "replay row 7",
        "score of the plan": "5.000",
        "of the policy": "2.500",
        "gain": "2.500",
        "chosen": "candidate 3 (a proposal of the policy)",
        "first action": "0.00, 0.25, 0.50, 0.75, 1.00, 1.25, ...",
        "variance shown": "80% by 3 components",
    }
    for chosen, told in ((-1, "mean of the elites"), (0, "candidate 0")):
        other = {"chosen": np.array(chosen), "proposals": np.zeros(16, bool)}
        assert facts_of(replace(changed, arrays=arrays | other))["chosen"] == told
    assert "&lt;last&gt; &amp; best" in write_page(tmp_path / "page", changed).read_text()


def action_values(**settings) -> Trace:
    torch.manual_seed(0)
    model = ActionValueWorldModel(3, 1, latent_dim=16, mlp_dim=16, num_dynamics=1, num_values=5)
    budget = {"horizon": 3, "num_samples": 16, "num_elites": 4, "num_proposals": 2, "iterations": 2}
    planner = EnsembleMPPIPlanner(LatentEnv(model), score="final", **budget | settings)
    return trace_plan(planner, torch.zeros(3))


def test_a_gain_by_other_value_heads_than_the_policy_s_says_so():
    gain = facts_of(action_values())["gain"]
    assert gain.endswith(" (the plan by 2 value heads, the policy by all 5)")
    assert re.fullmatch(r"-?\d+\.\d{3}", facts_of(make())["gain"])


def clicked(folder, candidate: int) -> tuple[list[str] | None, dict]:
    """Columns of the table before a click, and the table after it: the script on a stand-in of the browser."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node: apt-get install nodejs")
    script = """
        const fs = require('fs'), drawn = {};
        let click;
        const part = id => ({id, addEventListener() {}, on: (_, call) => { click = call; }});
        Object.assign(globalThis, {window: globalThis, document: {getElementById: part}, moveRing() {},
            Plotly: {react: (div, data) => { drawn[div.id] = data; return {then: call => call()}; }}});
        for (const name of ['data.js', 'saved_page.js']) {
            require('vm').runInThisContext(fs.readFileSync(process.argv[1] + '/' + name, 'utf8'));
        }
        const before = drawn['return_table-a'][0];
        click({points: [{customdata: Number(process.argv[2])}]});
        console.log(JSON.stringify([before ? before.x : null, drawn['return_table-a'][0]]));
    """
    run = subprocess.run([node, "-e", script, str(folder), str(candidate)], capture_output=True, text=True, check=False)
    assert run.stderr == ""
    return json.loads(run.stdout)


def test_a_clicked_candidate_has_the_columns_of_its_own_heads(tmp_path):
    """A candidate of an action-value critic has two heads, its choice five."""
    trace = action_values(eval_first_action="mean")
    before, table = clicked(write_page(tmp_path / "page", trace).parent, 6)
    assert before == ["1.1", "1.2", "1.3", "1.4", "1.5"]
    assert table["x"] == ["1.1", "1.2"]
    np.testing.assert_allclose(table["z"], trace["returns"][-1, 6].reshape(1, 2), rtol=1e-6)


def test_a_candidate_has_its_table_also_where_the_chosen_sequence_has_none(tmp_path):
    env = LatentEnv(LineWorld())
    planner = CEMPlanner(env, planning_horizon=3, optim_steps=2, num_candidates=16, top_k=4)
    state = env.reset(TensorDict({"observation": torch.tensor([0.5])}, []))
    trace = trace_torchrl_planner(planner, state)
    before, table = clicked(write_page(tmp_path / "page", trace).parent, 5)
    assert before is None
    assert (table["x"], table["y"]) == (["1.1"], ["3"])
    np.testing.assert_allclose(table["z"], trace["returns"][-1, 5].reshape(1, 1), rtol=1e-6)


def test_a_plan_that_fell_back_has_a_page(tmp_path):
    model = WorldModel(3, 1, latent_dim=16, mlp_dim=16)
    for parameter in model.parameters():
        torch.nn.init.constant_(parameter, torch.nan)
    planner = EnsembleMPPIPlanner(LatentEnv(model), horizon=3, num_samples=16, num_elites=4, num_proposals=2)
    trace = trace_plan(planner, torch.zeros(3))
    page = write_page(tmp_path / "page", trace, trace)
    assert "the policy: no candidate had a finite score" in page.read_text()
    assert "NaN" not in (page.parent / "data.js").read_text()


@pytest.mark.parametrize("files", [["notes.txt"], ["index.html", "data.js"]])  # the latter are those of a website
def test_other_files_are_not_written_over(tmp_path, files):
    for name in files:
        (tmp_path / name).write_text("mine")
    for path in (tmp_path, tmp_path / files[0]):
        with pytest.raises(FileExistsError, match="holds other files; choose an empty or a new folder"):
            write_page(path, make())
    assert all((tmp_path / name).read_text() == "mine" for name in files)
