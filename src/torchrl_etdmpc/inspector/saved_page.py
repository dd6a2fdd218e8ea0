"""A trace, or two of them, as a folder of files that any browser opens: without a server and without a network."""

from __future__ import annotations

import base64
import html
import itertools
import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_etdmpc.inspector import figures
from torchrl_etdmpc.inspector.inspection import Strip
from torchrl_etdmpc.inspector.trace import Trace
from torchrl_etdmpc.runs.files import write_whole

__all__ = ["facts_of", "frames_of", "free_folder", "setting_rows", "write_page"]

MOVING = ("latent_plane", "return_table", "disagreement", "plan_gaussian")  # with the iteration
WIDE = ("latent_plane",)
ASSETS = Path(__file__).parent / "assets"
_SCRIPT = Path(__file__).parent / "saved" / "saved_page.js"
_MARK = "window.INSPECTION"
_POLICY = "default-src 'none'; script-src 'self' file:; style-src 'self' file: 'unsafe-inline'; img-src data:"


def write_page(
    folder: str | Path, trace: Trace, other: Trace | None = None, *, strip: Strip | None = None, step: int | None = None
) -> Path:
    """Writes ``index.html`` with all that it needs, and the traces as files beside it.

    Args:
        folder (str or Path): made if missing; files of a page that is there are replaced.
        trace (Trace): what is shown.
        other (Trace, optional): of a second setting, shown beside it.

    Keyword Args:
        strip (Strip, optional): the episode in pictures.
        step (int, optional): the state's place in it.

    Returns:
        Path: of ``index.html``.

    Raises:
        ImportError: if plotly is missing.
        FileExistsError: if ``folder`` holds other files.
    """
    script = plotly_script()
    folder = free_folder(folder)
    page = folder / "index.html"
    folder.mkdir(parents=True, exist_ok=True)
    sides = [trace] if other is None else [trace, other]
    content: dict[str, Any] = {
        "iterations": max(side.iterations for side in sides),
        "moving": MOVING,
        "sides": [_side(side) for side in sides],
    }
    if other is not None:
        content["difference"] = _plain(figures.plain(figures.compare_plans)(trace, other))
    write_whole(folder / "data.js", f"{_MARK} = {json.dumps(content)};\n")  # first: by it the folder is known again
    write_whole(folder / "plotly.min.js", script)
    for source in (ASSETS / "inspector.css", ASSETS / "inspector.js", _SCRIPT):
        write_whole(folder / source.name, source.read_text(encoding="utf-8"))
    trace.save(folder / "trace.npz")
    if other is None:
        (folder / "second.npz").unlink(missing_ok=True)
    else:
        other.save(folder / "second.npz")
    write_whole(page, _html(sides, content["iterations"], strip, step))
    return page


def free_folder(folder: str | Path) -> Path:
    """Where a page may be written: a new or an empty folder, or one of a page that is replaced.

    Raises:
        FileExistsError: if ``folder`` holds other files.
    """
    folder = Path(folder).expanduser()
    data = folder / "data.js"
    if folder.exists() and not (folder.is_dir() and (_has_mark(data) or not any(folder.iterdir()))):
        raise FileExistsError(f"save={folder} holds other files; choose an empty or a new folder.")
    return folder


def _has_mark(data: Path) -> bool:
    if not data.is_file():
        return False
    with open(data, "rb") as file:
        return file.read(len(_MARK)) == _MARK.encode()


def plotly_script() -> str:
    """plotly.js, as plotly brings it.

    Raises:
        ImportError: if plotly is missing.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise ImportError("the page needs dash and plotly; in the checkout: pip install -e '.[inspect]'") from error
    return get_plotlyjs()


def facts_of(trace: Trace) -> dict[str, str]:
    """What a trace says in numbers, by name.

    Args:
        trace (Trace): any.
    """
    about, facts = trace.manifest, {}
    state = about.get("state", {})
    if state.get("from") == "episode":
        facts["state"] = f"episode {state.get('seed')}, step {state.get('step')}"
    elif state.get("from") == "replay":
        facts["state"] = f"replay row {state.get('row')}"
    facts["score of the plan"] = f"{float(trace['value']):.3f}"
    if trace.get("policy_scores") is not None:
        facts["of the policy"] = f"{trace['policy_scores'].mean():.3f}"
        facts["gain"] = f"{float(trace['value']) - trace['policy_scores'].mean():.3f}"
        heads = [table.shape[-1] for name in ("returns", "policy_returns") if (table := trace.get(name)) is not None]
        if len(set(heads)) == 2:
            facts["gain"] += f" (the plan by {heads[0]} value heads, the policy by all {heads[1]})"
    chosen = int(trace["chosen"])
    facts["chosen"] = "mean of the elites" if chosen < 0 else f"candidate {chosen}"
    if chosen >= 0 and trace["proposals"][chosen]:
        facts["chosen"] += " (a proposal of the policy)"
    if about.get("fallback"):
        facts["chosen"] = "the policy: no candidate had a finite score"
    facts["first action"] = _numbers(trace["action"])
    if trace.get("explained") is not None:
        facts["variance shown"] = f"{trace['explained'].sum():.0%} by {len(trace['explained'])} components"
    facts["took"] = f"{about.get('seconds', 0):.2f} s"
    return facts


def frames_of(trace: Trace) -> list[tuple[str, str]]:
    """Pictures of the chosen sequence in the simulator: a data address and what is under it, each."""
    frames, rewards = trace.get("frames"), trace.get("real_rewards")
    if frames is None or rewards is None:
        return []
    imagined = trace.get("chosen_rewards")
    predicted = [] if imagined is None else [f", predicted {value:.2f}" for value in imagined.mean(1)]
    told = itertools.zip_longest(rewards, predicted[: len(rewards)], fillvalue="")
    texts = ["now", *(f"step {step}: {real:.2f}{guess}" for step, (real, guess) in enumerate(told, 1))]
    return [(picture(frame), text) for frame, text in zip(frames, texts, strict=False)]


def setting_rows(trace: Trace, other: Trace) -> list[tuple[str, str, str]]:
    """Settings and facts in which two traces differ: name, first, second."""
    rows = []
    for one, two in ((trace.settings, other.settings), (facts_of(trace), facts_of(other))):
        names = [*one, *(name for name in two if name not in one)]
        rows += [(name, str(one.get(name)), str(two.get(name))) for name in names if one.get(name) != two.get(name)]
    return rows


def picture(frame: np.ndarray) -> str:
    """A frame, uint8 ``[height, width, 3]``, as the address of a PNG that holds its own data."""
    height, width = frame.shape[:2]
    rows = b"".join(b"\0" + row.tobytes() for row in np.ascontiguousarray(frame))
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = [(b"IHDR", header), (b"IDAT", zlib.compress(rows, 6)), (b"IEND", b"")]
    content = b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts
    )
    return "data:image/png;base64," + base64.b64encode(content).decode()


def _numbers(values: np.ndarray) -> str:
    shown = ", ".join(f"{value:.2f}" for value in values[:6])
    return shown + (", ..." if len(values) > 6 else "")


def _plain(drawing: figures.Drawing) -> Any:
    """A drawing without arrays and numbers that JSON does not have."""
    from plotly.io.json import to_json_plotly

    return json.loads(str(to_json_plotly(drawing)))


def _side(trace: Trace) -> dict[str, Any]:
    """Everything that the script draws of one trace."""
    made: dict[str, Any] = {}
    for name in figures.FIGURES:
        draw = figures.plain(getattr(figures, name))
        if name in MOVING and name != "return_table":
            made[name] = [_plain(draw(trace, iteration)) for iteration in range(trace.iterations)]
        else:
            made[name] = _plain(draw(trace))
    side: dict[str, Any] = {"figures": made}
    scores = trace["scores"]
    side["scores"] = [[float(score) if np.isfinite(score) else None for score in row] for row in scores]
    returns = trace.get("returns")
    if returns is not None:
        data = base64.b64encode(np.ascontiguousarray(returns, dtype="<f4").tobytes()).decode()
        # A candidate's table, to be filled: that of the chosen sequence may have other heads, or not be there.
        table = _plain(figures.plain(figures.return_table)(trace, candidate=0))
        side["returns"] = {"shape": list(returns.shape), "data": data, "table": table}
    return side


def _html(sides: list[Trace], iterations: int, strip: Strip | None, step: int | None) -> str:
    about = sides[0].manifest
    title = html.escape(f"{about.get('task') or 'a model'}: what the planner sees")
    saved = html.escape(str((about.get("checkpoint") or {}).get("name", "")))
    panels = []
    for name, heading in figures.FIGURES.items():
        graphs = "".join(f'<div id="{name}-{letter}" class="side-{letter}"></div>' for letter in "ab"[: len(sides)])
        wide = " wide" if name in WIDE else ""
        panels.append(f'<section class="panel{wide}"><h2>{heading}</h2><div class="sides">{graphs}</div></section>')
    difference = ""
    if len(sides) == 2:
        rows = "".join(
            f"<tr><td>{html.escape(name)}</td><td>{html.escape(one)}</td><td>{html.escape(two)}</td></tr>"
            for name, one, two in setting_rows(*sides)
        )
        difference = (
            '<section class="panel wide"><h2>Differences</h2><table id="differences"><tr><th></th><th>first</th>'
            f'<th>second</th></tr>{rows}</table><h2>Plan: second less first</h2><div id="difference"></div></section>'
        )
    pictures = ""
    if strip is not None and strip.frames:
        here = None if step is None else min(strip.steps, key=lambda at: abs(at - step))
        inside = "".join(
            f'<figure class="{"here" if at == here else ""}"><img alt="step {at}" src="{picture(frame)}">{at}</figure>'
            for at, frame in zip(strip.steps, strip.frames, strict=True)
        )
        pictures = f'<h2>Episode</h2><div class="strip">{inside}</div>'
    described = "".join(_described(trace, letter, len(sides)) for trace, letter in zip(sides, "ab", strict=False))
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<title>{title}</title>
<link rel="icon" href="data:,">
<link rel="stylesheet" href="inspector.css">
<script src="inspector.js"></script>
<script src="plotly.min.js"></script>
<script src="data.js"></script>
</head>
<body>
<header class="top"><h1>{title}</h1><span class="grow">{saved}</span><button id="theme">light / dark</button></header>
<div class="body saved"><main class="main{" two" if len(sides) == 2 else ""}">
{pictures}
{described}
<div class="bar"><label>iteration <input id="iteration" class="scrub" type="range" min="1" max="{iterations}" step="1"
value="{iterations}"></label><output id="iteration-value"></output>
<span class="no-print">click a candidate for its return table</span></div>
<div class="panels">{"".join(panels)}{difference}</div>
</main></div>
<script src="saved_page.js"></script>
</body>
</html>
"""


def _described(trace: Trace, letter: str, sides: int) -> str:
    facts = "".join(
        f"<li>{html.escape(name)} <b>{html.escape(text)}</b></li>" for name, text in facts_of(trace).items()
    )
    notes = "".join(f'<p class="note">{html.escape(note)}</p>' for note in trace.manifest.get("notes", []))
    frames = "".join(f'<figure><img alt="{text}" src="{address}">{text}</figure>' for address, text in frames_of(trace))
    which = f"<h2>{'first' if letter == 'a' else 'second'} setting</h2>" if sides == 2 else ""
    return f'{which}<ul class="facts" id="facts-{letter}">{facts}</ul>{notes}<div class="strip">{frames}</div>'
