"""The app: a layout and what its parts do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl_etdmpc.inspector.inspection import Inspection, State
from torchrl_etdmpc.inspector.page.filmstrip import connect_filmstrip
from torchrl_etdmpc.inspector.page.layout import page_layout
from torchrl_etdmpc.inspector.page.looking import connect_figures
from torchrl_etdmpc.inspector.page.planning import connect_plans
from torchrl_etdmpc.inspector.page.saving import connect_saving
from torchrl_etdmpc.inspector.page.server import answer_this_machine_only
from torchrl_etdmpc.inspector.saved_page import ASSETS


def make_page(
    inspection: Inspection,
    *,
    state: State | None = None,
    seed: int = 0,
    allow_remote: bool = False,
    folder: str | Path = "page",
) -> Any:
    """A dash app.

    Args:
        inspection (Inspection): the agent.

    Keyword Args:
        state (State, optional): that is planned first. Default: the first decision of episode 0.
        seed (int): of the noise of the first plan. Default: 0.
        allow_remote (bool): whether requests that name another host than this machine are answered.
        folder (str or Path): where pages are saved, unless the page is told otherwise. Default: ``"page"``.

    Returns:
        dash.Dash: serve its ``server`` with :func:`serve`.

    Raises:
        ImportError: if dash is missing.
    """
    try:
        import dash
    except ImportError as error:
        raise ImportError("the page needs dash and plotly; in the checkout: pip install -e '.[inspect]'") from error
    app = dash.Dash(
        "torchrl_etdmpc",
        title="Planner inspector",
        update_title=None,  # pyright: ignore[reportArgumentType]
        assets_folder=str(ASSETS),
        serve_locally=True,
        compress=False,
        enable_mcp=False,
        add_log_handler=False,
    )
    if not allow_remote:
        answer_this_machine_only(app.server)
    app.layout = page_layout(inspection, State(episode=0, step=0) if state is None else state, str(folder), seed)
    for connect in (connect_plans, connect_figures, connect_filmstrip, connect_saving):
        connect(app, inspection)
    return app
