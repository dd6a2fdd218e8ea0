"""Looking at a plan: its figures follow the scrubbers and the candidate that was clicked."""

from __future__ import annotations

from typing import Any

from torchrl_etdmpc.inspector import figures
from torchrl_etdmpc.inspector.inspection import Inspection
from torchrl_etdmpc.inspector.saved_page import MOVING, facts_of, frames_of, setting_rows
from torchrl_etdmpc.inspector.trace import Trace

_ANSWERED = (*MOVING, "mixture_weights")  # which follows the candidate alone
_STANDS = [name for name in figures.FIGURES if name not in _ANSWERED]


def connect_figures(app: Any, inspection: Inspection) -> None:
    """Draws what changed; what the browser knows it does alone."""
    _connect_clicks(app)
    _connect_scrubbers(app, inspection)
    _connect_moving(app, inspection)
    _connect_standing(app, inspection)


def _connect_clicks(app: Any) -> None:
    from dash import ClientsideFunction, Input, Output, State

    app.clientside_callback(
        ClientsideFunction("inspector", "clicked"),
        Output("candidate-a", "data"),
        Output("candidate-b", "data"),
        Input("trace-a", "data"),
        Input("trace-b", "data"),
        Input("latent_plane-a", "clickData"),
        Input("latent_plane-b", "clickData"),
        Input("unclick", "n_clicks"),
        State("candidate-a", "data"),
        State("candidate-b", "data"),
        prevent_initial_call=True,
    )
    for side in "ab":
        app.clientside_callback(
            ClientsideFunction("inspector", "ring"),
            Input(f"candidate-{side}", "data"),
            State(f"latent_plane-{side}", "id"),
            prevent_initial_call=True,
        )


def _connect_scrubbers(app: Any, inspection: Inspection) -> None:
    from dash import Input, Output, State, no_update

    @app.callback(
        Output("iteration", "max"),
        Output("iteration", "value"),
        Output("depth", "max"),
        Output("depth", "value"),
        Input("trace-a", "data"),
        Input("trace-b", "data"),
        State("iteration", "value"),
        State("iteration", "max"),
        State("depth", "value"),
        State("depth", "max"),
        prevent_initial_call=True,
    )
    def follow(one: int | None, two: int | None, *now: Any) -> tuple[Any, ...]:
        traces = [inspection.traces[number] for number in (one, two) if number in inspection.traces]
        if not traces:
            return (no_update,) * 4
        iterations, horizon = (max(getattr(trace, name) for trace in traces) for name in ("iterations", "horizon"))
        iteration, most_iterations, depth, most_depth = now
        return (
            iterations,
            _followed(iteration, most_iterations, iterations),
            horizon,
            _followed(depth, most_depth, horizon),
        )


def _connect_moving(app: Any, inspection: Inspection) -> None:
    """Each figure on what it shows, and no more: a callback whose answer depends on what called it would lose answers,
    as dash drops the first one when it is called again meanwhile.
    """
    from dash import Input, Output, State, no_update

    for side in "ab":
        trace, candidate = Input(f"trace-{side}", "data"), Input(f"candidate-{side}", "data")
        iteration, depth, components = (Input(name, "value") for name in ("iteration", "depth", "components"))
        outputs = {name: Output(f"{name}-{side}", "figure") for name in _ANSWERED}

        # The browser moves the ring around a candidate, so that a click does not draw the plane anew.
        @app.callback(
            outputs["latent_plane"],
            *(trace, iteration, depth, components),
            State(f"candidate-{side}", "data"),
            prevent_initial_call=True,
        )
        def plane(number: Any, iteration: int, depth: int, components: str, clicked: int | None) -> Any:
            trace, at, candidate = _looked_at(inspection, number, iteration, clicked)
            if trace is None:
                return no_update
            options: dict[str, Any] = {"components": (int(components[0]), int(components[1])), "candidate": candidate}
            return figures.plain(figures.latent_plane)(trace, at, depth=min(depth, trace.horizon), **options)

        @app.callback(
            outputs["return_table"],
            outputs["disagreement"],
            *(trace, iteration, candidate),
            prevent_initial_call=True,
        )
        def heads(number: Any, iteration: int, clicked: int | None) -> tuple[Any, Any]:
            trace, at, candidate = _looked_at(inspection, number, iteration, clicked)
            if trace is None:
                return no_update, no_update
            table, spread = figures.plain(figures.return_table), figures.plain(figures.disagreement)
            return table(trace, at, candidate), spread(trace, at, candidate)

        @app.callback(outputs["plan_gaussian"], trace, iteration, prevent_initial_call=True)
        def gaussian(number: Any, iteration: int) -> Any:
            trace, at, _ = _looked_at(inspection, number, iteration, None)
            return no_update if trace is None else figures.plain(figures.plan_gaussian)(trace, at)

        @app.callback(outputs["mixture_weights"], trace, candidate, prevent_initial_call=True)
        def weights(number: Any, clicked: int | None) -> Any:
            trace, _, candidate = _looked_at(inspection, number, 1, clicked)
            return no_update if trace is None else figures.plain(figures.mixture_weights)(trace, candidate)


def _looked_at(
    inspection: Inspection, number: int | None, iteration: int, clicked: int | None
) -> tuple[Trace | None, int, int | None]:
    """A trace if it is there, the iteration from 0, and the candidate that was clicked."""
    trace = None if number is None else inspection.traces.get(number)
    if trace is None:
        return None, 0, None
    candidate = clicked if clicked is not None and clicked < trace["scores"].shape[1] else None
    if trace.get("points") is None or trace.get("returns") is None:
        candidate = None
    return trace, min(iteration, trace.iterations) - 1, candidate


def _connect_standing(app: Any, inspection: Inspection) -> None:
    from dash import Input, Output, no_update

    for side in "ab":

        @app.callback(
            *[Output(f"{name}-{side}", "figure") for name in _STANDS],
            Output(f"described-{side}", "children"),
            Input(f"trace-{side}", "data"),
            prevent_initial_call=True,
        )
        def stand(number: int | None, side: str = side) -> tuple[Any, ...]:
            trace = inspection.traces.get(number) if number is not None else None
            if trace is None:
                return *[no_update] * len(_STANDS), []
            made = [figures.plain(getattr(figures, name))(trace) for name in _STANDS]
            return *made, _described(trace, side)

    @app.callback(
        Output("difference", "figure"),
        Output("differences", "children"),
        Input("trace-a", "data"),
        Input("trace-b", "data"),
        prevent_initial_call=True,
    )
    def differ(one: int | None, two: int | None) -> tuple[Any, Any]:
        if one not in inspection.traces or two not in inspection.traces:
            return no_update, []
        assert one is not None and two is not None
        first, second = inspection.traces[one], inspection.traces[two]
        return figures.plain(figures.compare_plans)(first, second), _difference_table(setting_rows(first, second))


def _followed(value: int, most: int, now: int) -> Any:
    """Where a scrubber goes when its end moves: what stood at the end stays there, all else stays where it is."""
    from dash import no_update

    target = now if value >= most else min(value, now)
    return no_update if target == value else target


def _described(trace: Trace, side: str) -> list[Any]:
    from dash import html

    facts = [html.Li([f"{name} ", html.B(text)]) for name, text in facts_of(trace).items()]
    notes = [html.P(note, className="note") for note in trace.manifest.get("notes", [])]
    frames = [html.Figure([html.Img(src=address, alt=text), text]) for address, text in frames_of(trace)]
    which = html.H2("shown setting" if side == "a" else "held setting")
    return [which, html.Ul(facts, className="facts"), *notes, html.Div(frames, className="strip")]


def _difference_table(rows: list[tuple[str, str, str]]) -> Any:
    from dash import html

    head = html.Tr([html.Th(""), html.Th("shown (first)"), html.Th("held (second)")])
    return html.Table([head, *[html.Tr([html.Td(text) for text in row]) for row in rows]])
