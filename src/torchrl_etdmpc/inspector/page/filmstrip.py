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
        State("source", "value"),
        State("episode", "value"),
        State("filmed", "data"),
        prevent_initial_call=True,
    )
    def film(_: Any, source: str, episode: Any, filmed: str | None) -> tuple[Any, ...]:
        if source == filmed == "replay" or episode == filmed:  # the pictures are there
            return (no_update,) * 3
        if source == "replay":
            return [], inspection.rows - 1, source
        strip, length = inspection.strip(int(episode)), inspection.length(int(episode))
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
        prevent_initial_call=True,
    )
    def choose(clicks: list[Any]) -> Any:
        return ctx.triggered_id["step"] if any(clicks) and ctx.triggered_id else no_update
