from __future__ import annotations

import base64
import json
import re
import zlib

import numpy as np
import pytest
import torch

from torchrl_etdmpc.inspector import Trace, load_trace, trace_plan
from torchrl_etdmpc.inspector.inspection import Strip
from torchrl_etdmpc.inspector.saved_page import picture, setting_rows, write_page
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
    assert [len(side["figures"][name]) for name in ("latent_plane", "plan_gaussian")] == [2, 2]
    assert np.array_equal(load_trace(page.parent / "trace.npz")["scores"], trace["scores"])


def test_two_settings_stand_beside_each_other_with_their_differences(tmp_path):
    first, second = make(), make(score="adaptive", beta=2.0)
    page = write_page(tmp_path / "page", first, second)
    assert {row[:3] for row in setting_rows(first, second)} >= {("score", "mean", "adaptive"), ("beta", "0.0", "2.0")}
    assert "<td>score</td><td>mean</td><td>adaptive</td>" in page.read_text()
    assert len(content_of(page.parent)["sides"]) == 2
    assert np.array_equal(load_trace(page.parent / "second.npz")["scores"], second["scores"])
    write_page(tmp_path / "page", first)  # written again, with one setting
    assert not (page.parent / "second.npz").exists()


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


def test_other_files_are_not_written_over(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="holds other files; choose an empty or a new folder"):
        write_page(tmp_path, make())
    with pytest.raises(FileExistsError, match="holds other files"):
        write_page(tmp_path / "notes.txt", make())
