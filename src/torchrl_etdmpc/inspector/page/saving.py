"""Saving what is shown."""

from __future__ import annotations

from typing import Any

from torchrl_etdmpc.inspector.inspection import Inspection
from torchrl_etdmpc.inspector.saved_page import write_page


def connect_saving(app: Any, inspection: Inspection) -> None:
    """Saves what is shown as a page of files."""
    from dash import Input, Output, State

    @app.callback(
        Output("saved", "children"),
        Input("save", "n_clicks"),
        State("folder", "value"),
        State("trace-a", "data"),
        State("trace-b", "data"),
        State("source", "value"),
        State("episode", "value"),
        State("step", "value"),
        prevent_initial_call=True,
    )
    def save(_: Any, folder: str | None, one: Any, two: Any, source: str, episode: Any, step: Any) -> str:
        if one not in inspection.traces:
            return "There is nothing to save yet."
        strip = None if source == "replay" else inspection.strip(int(episode))
        try:
            page = write_page(
                folder or "page", inspection.traces[one], inspection.traces.get(two), strip=strip, step=step
            )
        except OSError as error:
            return " ".join(str(error).split())
        return f"saved: {page}"
