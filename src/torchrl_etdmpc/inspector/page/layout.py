"""What is where on the page."""

from __future__ import annotations

from typing import Any

from torchrl_etdmpc.inspector import figures
from torchrl_etdmpc.inspector.inspection import Inspection, State
from torchrl_etdmpc.inspector.page.controls import controls, group
from torchrl_etdmpc.inspector.saved_page import WIDE

_GRAPH: Any = {"displayModeBar": False, "responsive": False}  # inspector.js fits them


def page_layout(inspection: Inspection, first: State, folder: str, seed: int) -> Any:
    """The controls, the plan and what is kept in the browser."""
    from dash import dcc, html

    about = inspection.about.get("checkpoint") or {}
    task = inspection.task.name if inspection.task is not None else "a model"
    head = html.Header(
        [
            html.H1(f"{task}: what the planner sees"),
            html.Span(str(about.get("name", "")), className="grow"),
            html.Button("light / dark", id="theme"),
        ],
        className="top",
    )
    stores = [dcc.Store(id=name) for name in ("trace-a", "trace-b", "job", "candidate-a", "candidate-b", "filmed")]
    poll = dcc.Interval(id="poll", interval=200, disabled=True)
    body = html.Div(
        [
            html.Aside(controls(inspection, first, folder, seed), className="controls"),
            html.Main(_main(), id="main", className="main"),
        ],
        className="body",
    )
    return html.Div([*stores, poll, head, body])


def _main() -> list[Any]:
    from dash import dcc, html

    status = html.Div(
        [
            html.Span(id="doing"),
            html.Progress(id="progress", max="1", value="0", className="hidden"),
            html.Button("cancel", id="cancel", className="hidden"),
        ],
        className="bar",
        role="status",
    )
    slider: dict[str, Any] = {"marks": None, "updatemode": "drag", "allow_direct_input": False}
    scrubbing = html.Div(
        [
            *(
                group(
                    name,
                    [
                        html.Span(name, id=f"{name}-name"),
                        html.Div(dcc.Slider(1, 1, 1, value=1, id=name, **slider), className="scrub"),
                    ],
                )
                for name in ("iteration", "depth")
            ),
            group(
                "components",
                [
                    "components",
                    dcc.RadioItems(
                        [
                            {"label": f" {one + 1}, {two + 1}", "value": f"{one}{two}"}
                            for one, two in ((0, 1), (0, 2), (1, 2))
                        ],
                        "01",
                        id="components",
                        inline=True,
                    ),
                ],
            ),
            html.Span("click a candidate for its return table", className="no-print"),
            html.Button("back to the chosen one", id="unclick"),
        ],
        className="bar",
    )
    panels = []
    for name, heading in figures.FIGURES.items():
        graphs = [
            html.Div(
                dcc.Graph(figure=figures.empty("no plan yet"), id=f"{name}-{side}", config=_GRAPH),
                className=f"side-{side}",
            )
            for side in "ab"
        ]
        wide = " wide" if name in WIDE else ""
        panels.append(html.Section([html.H2(heading), html.Div(graphs, className="sides")], className="panel" + wide))
    difference = html.Section(
        [
            html.H2("Differences"),
            html.Div(id="differences"),
            html.H2("Plan: second less first"),
            dcc.Graph(figure=figures.empty("no second plan"), id="difference", config=_GRAPH),  # pyright: ignore[reportArgumentType]
        ],
        className="panel wide only-two",
    )
    return [
        html.Div(id="error", className="error", role="alert"),
        html.Div(id="strip", className="strip"),
        status,
        html.Div(id="described-a"),
        html.Div(id="described-b"),
        scrubbing,
        html.Div([*panels, difference], className="panels"),
    ]
