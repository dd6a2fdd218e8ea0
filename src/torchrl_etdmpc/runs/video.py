"""Frames to a film: mp4 with the ffmpeg that imageio-ffmpeg brings, or GIF with Pillow."""

from __future__ import annotations

import os
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_etdmpc.runs.files import replacing

_GIF_FPS, _GIF_COLOURS = 12.5, 64  # a GIF takes a multiple of 10 ms per picture, and grows with both
_PALETTE_FRAMES = 16


def write_film(frames: Iterable[torch.Tensor | np.ndarray], path: str | os.PathLike[str], fps: float) -> Path:
    """Writes an ``.mp4`` or, for pages that show no video, a ``.gif`` of about 12.5 pictures per second.

    Args:
        frames (iterable): as :func:`write_mp4` takes them.
        path (str or Path): the file; its directory is made; an existing file is replaced.
        fps (float): frames per second, above 0.

    Returns:
        Path: the file.

    Raises:
        ImportError: if imageio-ffmpeg, or for a GIF Pillow, is not installed.
        ValueError: another suffix, or what :func:`write_mp4` refuses.
        OSError: if ``path`` cannot be written.

    >>> import tempfile
    >>> frames = torch.zeros(50, 32, 48, 3, dtype=torch.uint8)
    >>> write_film(frames, Path(tempfile.mkdtemp()) / "episode.gif", fps=25).name
    'episode.gif'
    """
    path = Path(path).expanduser()
    if path.suffix != ".gif":
        return write_mp4(frames, path, fps)
    if not fps > 0:
        raise ValueError(f"fps must be above 0, got {fps}; 30 is usual.")
    Image = film_writer(path)
    kept, shape, every = [], None, max(round(fps / _GIF_FPS), 1)
    for index, frame in enumerate(frames):
        array = _check_frame(frame, index, shape)
        shape = array.shape
        if index % every == 0:
            kept.append(Image.fromarray(np.ascontiguousarray(array)))
    if not kept:
        raise ValueError("frames must hold at least one frame, got none; record an episode first.")
    some = kept[:: -(-len(kept) // _PALETTE_FRAMES)]  # one palette for all: what moves does not flicker
    palette = Image.fromarray(np.concatenate([np.asarray(picture) for picture in some])).quantize(_GIF_COLOURS)
    pictures = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in kept]
    milliseconds = 10 * round(100 * every / fps)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            pictures[0].save(
                partial, "GIF", save_all=True, append_images=pictures[1:], duration=max(milliseconds, 20), loop=0
            )
    except OSError as error:
        raise OSError(f"path={path} cannot be written ({error.strerror}); choose another path.") from error
    return path


def film_writer(path: str | os.PathLike[str]) -> Any:
    """The library that writes a film of this name.

    Raises:
        ImportError: if it is not installed.

    >>> film_writer("episode.gif").__name__
    'PIL.Image'
    """
    if Path(path).suffix == ".gif":
        try:
            from PIL import Image
        except ImportError as error:
            raise ImportError("a GIF needs Pillow, which is not installed; run `pip install pillow`.") from error
        return Image
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise ImportError(
            "write_mp4 needs imageio-ffmpeg, which is not installed; run `pip install imageio-ffmpeg`."
        ) from error
    return imageio_ffmpeg


def write_mp4(
    frames: torch.Tensor | np.ndarray | Iterable[torch.Tensor | np.ndarray], path: str | os.PathLike[str], fps: float
) -> Path:
    """Writes an H.264 video that browsers play.

    An odd height or width loses its last row or column, because the format needs even ones. The file is there whole or
    not at all.

    Args:
        frames (Tensor or ndarray or iterable): uint8 RGB, ``[T, H, W, 3]``, or an iterable of ``[H, W, 3]`` frames (one
            at a time in memory).
        path (str or Path): the file, ending in ``.mp4``; its directory is made; an existing file is replaced.
        fps (float): frames per second, above 0. For real time: 1 / (seconds between two frames).

    Returns:
        Path: the file.

    Raises:
        ImportError: if imageio-ffmpeg is not installed.
        ValueError: no frames, frames of another shape or dtype, ``fps`` not above 0, or another suffix.
        OSError: if ``path`` cannot be written, or ffmpeg failed.

    >>> import tempfile
    >>> frames = torch.zeros(5, 32, 48, 3, dtype=torch.uint8)
    >>> write_mp4(frames, Path(tempfile.mkdtemp()) / "episode.mp4", fps=25).name
    'episode.mp4'
    """
    path = Path(path).expanduser()
    if path.suffix != ".mp4":
        raise ValueError(f"path must end in .mp4, got {path}; rename it.")
    if not fps > 0:
        raise ValueError(f"fps must be above 0, got {fps}; 30 is usual.")
    imageio_ffmpeg = film_writer(path)
    iterator = iter(frames)
    first = next(iterator, None)
    if first is None:
        raise ValueError("frames must hold at least one frame, got none; record an episode first.")
    first = _check_frame(first, 0, None)
    height, width = first.shape[0] // 2 * 2, first.shape[1] // 2 * 2
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            partial.touch()  # ffmpeg's own error would not name the reason
            # Even sizes need no further alignment; a larger block would make ffmpeg rescale the picture.
            writer = imageio_ffmpeg.write_frames(str(partial), (width, height), fps=fps, macro_block_size=2)  # pyright: ignore[reportArgumentType]
            count = _send_all(writer, chain([first], iterator), height, width)
            _check_video(imageio_ffmpeg, partial, count)
    except OSError as error:
        if error.errno is None:  # ours, of ffmpeg
            raise
        raise OSError(f"path={path} cannot be written ({error.strerror}); choose another path.") from error
    return path


def _send_all(writer: Any, frames: Iterable[Any], height: int, width: int) -> int:
    shape, count = None, 0
    try:
        writer.send(None)
        for frame in frames:
            array = _check_frame(frame, count, shape)
            shape = array.shape
            _send(writer, array[:height, :width])
            count += 1
    finally:
        writer.close()
    return count


def _check_frame(frame: Any, index: int, shape: tuple[int, ...] | None) -> np.ndarray:
    array = frame.detach().cpu().numpy() if isinstance(frame, torch.Tensor) else np.asarray(frame)
    if array.dtype != np.uint8:
        raise ValueError(f"frames must be uint8, got {array.dtype} in frame {index}; scale to 0..255 and convert.")
    if array.ndim != 3 or array.shape[-1] != 3 or min(array.shape) < 2:
        raise ValueError(
            f"frames must be [T, H, W, 3] with H and W at least 2, got frame {index} of shape {list(array.shape)}; "
            "put the colours last."
        )
    if shape is not None and array.shape != shape:
        raise ValueError(
            f"frames must all have the size of the first, {list(shape)}, got {list(array.shape)} in frame {index}; "
            "render them at one size."
        )
    return array


def _send(writer: Any, frame: np.ndarray) -> None:
    try:
        writer.send(np.ascontiguousarray(frame))
    except OSError as error:
        raise OSError("ffmpeg stopped before the last frame; see its message above and the free disk space.") from error


def _check_video(imageio_ffmpeg: Any, path: Path, count: int) -> None:
    # The writer does not look at ffmpeg's exit status: a full disk would pass for success.
    try:
        written, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except RuntimeError:
        written = 0
    if written != count:
        raise OSError(f"ffmpeg wrote {written} of {count} frames; see its message above and the free disk space.")
