from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")

from torchrl_etdmpc.runs import write_film, write_mp4  # noqa: E402

# imageio-ffmpeg leaves its pipes to the garbage collector.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


def ramp(length: int, height: int, width: int) -> np.ndarray:
    """Grey frames that brighten with time, uint8, [T, H, W, 3]."""
    levels = np.linspace(20, 220, length).astype(np.uint8)
    return np.broadcast_to(levels[:, None, None, None], (length, height, width, 3))


def moving_bar(length: int) -> torch.Tensor:
    """Frames of 48 columns in which a white bar goes four columns to the right each time."""
    frames = torch.zeros(length, 32, 48, 3, dtype=torch.uint8)
    for number in range(length):
        frames[number, :, 4 * number : 4 * number + 4] = 255
    return frames


def decode(path: Path) -> tuple[dict, list[np.ndarray]]:
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return meta, [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


@pytest.mark.parametrize("kind", ["array", "tensor", "generator"])
def test_a_video_decodes_to_the_frames_that_were_written(tmp_path, kind):
    frames = ramp(12, 48, 64)
    source = {
        "array": lambda: frames,
        "tensor": lambda: torch.from_numpy(frames.copy()),
        "generator": lambda: (torch.from_numpy(frame.copy()) for frame in frames),
    }[kind]()
    path = write_mp4(source, tmp_path / "videos" / "episode.mp4", fps=25)
    meta, decoded = decode(path)
    assert meta["size"] == (64, 48)
    assert meta["fps"] == 25
    assert len(decoded) == 12
    for frame, original in zip(decoded, frames, strict=True):
        assert abs(frame.mean() - original.mean()) < 4
    assert [entry.name for entry in (tmp_path / "videos").iterdir()] == ["episode.mp4"]


def test_an_odd_size_loses_its_last_row_and_column(tmp_path):
    meta, decoded = decode(write_mp4(ramp(3, 33, 51), tmp_path / "odd.mp4", fps=10))
    assert meta["size"] == (50, 32)
    assert len(decoded) == 3


def test_a_gif_shows_some_of_the_frames_and_lasts_as_long_as_all(tmp_path):
    Image = pytest.importorskip("PIL.Image")
    shown = []
    with Image.open(write_film(moving_bar(12), tmp_path / "a.gif", fps=50)) as film:
        for place in range(film.n_frames):
            film.seek(place)
            shown.append((int(np.asarray(film.convert("RGB"))[0, :, 0].argmax()), film.info["duration"]))
        assert film.info["loop"] == 0  # for ever
    assert shown == [(0, 80), (16, 80), (32, 80)]  # ms


def test_a_slow_gif_shows_every_frame_for_its_time(tmp_path):
    Image = pytest.importorskip("PIL.Image")
    with Image.open(write_film(moving_bar(3), tmp_path / "a.gif", fps=5)) as film:
        assert (film.n_frames, film.info["duration"]) == (3, 200)


def test_a_gif_has_colours_that_come_later(tmp_path):
    Image = pytest.importorskip("PIL.Image")
    frames = np.zeros((40, 32, 32, 3), np.uint8)
    frames[20:, :, :16] = (250, 30, 120)
    with Image.open(write_film(frames, tmp_path / "a.gif", fps=10)) as film:
        film.seek(film.n_frames - 1)
        left, right = np.asarray(film.convert("RGB"))[0, [0, -1]].astype(int)
    assert abs(left - (250, 30, 120)).max() < 10 and abs(right).max() < 10


def test_an_existing_video_is_replaced(tmp_path):
    write_mp4(ramp(3, 32, 32), tmp_path / "a.mp4", fps=10)
    assert len(decode(write_mp4(ramp(5, 32, 32), tmp_path / "a.mp4", fps=10))[1]) == 5


def test_the_callers_frames_are_left_as_they_are(tmp_path):
    frames = torch.from_numpy(ramp(2, 33, 33).copy())
    before = frames.clone()
    write_mp4(frames, tmp_path / "a.mp4", fps=10)
    assert torch.equal(frames, before)


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (np.zeros((0, 8, 8, 3), np.uint8), "frames must hold at least one frame, got none; record an episode first."),
        (np.zeros((2, 8, 8, 3)), "frames must be uint8, got float64 in frame 0; scale to 0..255 and convert."),
        (
            torch.zeros(2, 3, 8, 8, dtype=torch.uint8),
            "frames must be [T, H, W, 3] with H and W at least 2, got frame 0 of shape [3, 8, 8]; "
            "put the colours last.",
        ),
        (
            np.zeros((2, 1, 8, 3), np.uint8),
            "frames must be [T, H, W, 3] with H and W at least 2, got frame 0 of shape [1, 8, 3]; "
            "put the colours last.",
        ),
        (
            [np.zeros((8, 8, 3), np.uint8), np.zeros((8, 6, 3), np.uint8)],
            "frames must all have the size of the first, [8, 8, 3], got [8, 6, 3] in frame 1; render them at one size.",
        ),
    ],
)
def test_wrong_frames_are_refused_in_one_line_and_leave_nothing(tmp_path, frames, message, name):
    with pytest.raises(ValueError) as caught:
        write_film(frames, tmp_path / name, fps=10)
    assert str(caught.value) == message
    assert list(tmp_path.iterdir()) == []


def test_a_renderer_that_fails_midway_leaves_the_old_video(tmp_path):
    def frames():
        yield from ramp(2, 32, 32)
        raise RuntimeError("no display")

    old = write_mp4(ramp(3, 32, 32), tmp_path / "a.mp4", fps=10).read_bytes()
    with pytest.raises(RuntimeError, match="no display"):
        write_mp4(frames(), tmp_path / "a.mp4", fps=10)
    assert (tmp_path / "a.mp4").read_bytes() == old
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
@pytest.mark.parametrize("fps", [0, -1, float("nan")])
def test_the_frame_rate_must_be_positive(tmp_path, fps, name):
    with pytest.raises(ValueError, match=rf"^fps must be above 0, got {fps}; 30 is usual\.$"):
        write_film(ramp(2, 32, 32), tmp_path / name, fps=fps)


def test_the_file_must_be_an_mp4(tmp_path):
    with pytest.raises(ValueError, match=r"^path must end in \.mp4, got .*a\.gif; rename it\.$"):
        write_mp4(ramp(2, 32, 32), tmp_path / "a.gif", fps=10)


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_a_path_that_cannot_be_written_is_one_clear_line(tmp_path, name):
    (tmp_path / "file").write_text("")
    (tmp_path / name).mkdir()  # which is found when the film is there
    for path in (tmp_path / "file" / name, tmp_path / name):
        with pytest.raises(OSError, match=rf"{name} cannot be written \(.*\); choose another path\.$"):
            write_film(ramp(2, 32, 32), path, fps=10)
    assert {path.name for path in tmp_path.iterdir()} == {"file", name}


def test_a_folder_that_takes_no_files_is_the_reason_and_not_ffmpeg_s_end():
    if not Path("/proc").is_dir():
        pytest.skip("needs a folder that takes no files")
    with pytest.raises(OSError, match=r"^path=/proc/a\.mp4 cannot be written \(No such file or directory\); choose an"):
        write_mp4(ramp(2, 32, 32), "/proc/a.mp4", fps=10)


def test_an_encoder_that_fails_is_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr(imageio_ffmpeg, "count_frames_and_secs", lambda path: (1, 0.1))
    with pytest.raises(OSError, match=r"^ffmpeg wrote 1 of 2 frames; see its message above"):
        write_mp4(ramp(2, 32, 32), tmp_path / "a.mp4", fps=10)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name != "posix", reason="needs a program that fails")
@pytest.mark.parametrize("length", [1, 50])
def test_an_ffmpeg_that_dies_is_one_clear_line(tmp_path, monkeypatch, length):
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    with pytest.raises(OSError, match=r"^ffmpeg (stopped before the last|wrote 0 of \d+) frames?[^\n]*disk space\.$"):
        write_mp4(ramp(length, 256, 256), tmp_path / "a.mp4", fps=10)
    assert [path.name for path in tmp_path.iterdir()] == ["ffmpeg"]


def test_a_missing_encoder_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"needs imageio-ffmpeg, .*; run `pip install imageio-ffmpeg`\.$"):
        write_mp4(ramp(2, 32, 32), tmp_path / "a.mp4", fps=10)
    assert list(tmp_path.iterdir()) == []
