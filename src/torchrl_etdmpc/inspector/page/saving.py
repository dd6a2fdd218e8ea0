"""Saving what is shown."""

from __future__ import annotations

from typing import Any

from torchrl_etdmpc.inspector.inspection import KEPT, Inspection
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
        if one is None:
            return "There is nothing to save yet."
        for number in (one, two):
            if number is not None and number not in inspection.traces:
                which = "This plan" if number == one else "The held plan"
                return f"{which} is no longer kept, as the last {KEPT} are; plan it again."
        trace = inspection.traces[one]
        state = trace.manifest["state"]
        strip = inspection.strip(state["seed"]) if state["from"] == "episode" else None
        try:
            page = write_page(folder or "page", trace, inspection.traces.get(two), strip=strip, step=state.get("step"))
        except OSError as error:
            return " ".join(str(error).split())
        return f"saved: {page}"
