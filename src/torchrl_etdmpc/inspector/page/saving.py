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
        prevent_initial_call=True,
    )
    def save(_: Any, folder: str | None, one: Any, two: Any) -> str:
        if one not in inspection.traces:
            return "There is nothing to save yet."
        trace = inspection.traces[one]
        state = trace.manifest["state"]
        strip = inspection.strip(state["seed"]) if state["from"] == "episode" else None
        try:
            page = write_page(folder or "page", trace, inspection.traces.get(two), strip=strip, step=state.get("step"))
        except OSError as error:
            return " ".join(str(error).split())
        return f"saved: {page}"
