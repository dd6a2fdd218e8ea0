"""The episode in pictures."""

from __future__ import annotations

from typing import Any

from torchrl_etdmpc.inspector.inspection import Inspection
from torchrl_etdmpc.inspector.saved_page import picture


def connect_filmstrip(app: Any, inspection: Inspection) -> None:
    """Shows the episode of the plan; a picture chooses its decision."""
    from dash import ALL, ClientsideFunction, Input, Output, State, ctx, html, no_update

    @app.callback(
        Output("strip", "children"),
        Output("step", "max"),
        Output("filmed", "data"),
        Input("trace-a", "data"),
        State("filmed", "data"),
        prevent_initial_call=True,
    )
    def film(number: int | None, filmed: Any) -> tuple[Any, ...]:
        trace = None if number is None else inspection.traces.get(number)
        if trace is None:
            return (no_update,) * 3
        episode = trace.manifest["state"].get("seed", "replay")
        if episode == filmed:  # the pictures are there
            return (no_update,) * 3
        if episode == "replay":
            return [], inspection.rows - 1, episode
        strip, length = inspection.strip(episode), inspection.length(episode)
        if strip is None or length is None:
            return (no_update,) * 3
        pictures = [
            html.Button([html.Img(src=picture(frame), alt=f"step {at}"), str(at)], id={"type": "frame", "step": at})
            for at, frame in zip(strip.steps, strip.frames, strict=False)
        ]
        return pictures, length - 1, episode

    app.clientside_callback(
        ClientsideFunction("inspector", "here"),
        Output({"type": "frame", "step": ALL}, "className"),
        Input("step", "value"),
        Input({"type": "frame", "step": ALL}, "id"),
    )

    @app.callback(
        Output("step", "value"),
        Input({"type": "frame", "step": ALL}, "n_clicks"),
        Input("source", "value"),
        Input("episode", "value"),
        State("step", "value"),
        prevent_initial_call=True,
    )
    def choose(clicks: list[Any], source: str, episode: Any, step: int) -> Any:
        if ctx.triggered_id in ("source", "episode"):
            last = _last(inspection, source, episode)
            return last if last < step else no_update
        return ctx.triggered_id["step"] if any(clicks) and ctx.triggered_id else no_update


def _last(inspection: Inspection, source: str, episode: int | None) -> int:
    """The last step, as far as it is known before the episode is played."""
    if source == "replay":
        return inspection.rows - 1
    length = None if episode is None else inspection.length(int(episode))
    return (length or inspection.decisions) - 1
