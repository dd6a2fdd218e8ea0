"""The page in a browser: a dash app on an inspection, for this machine alone unless told otherwise."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torchrl_etdmpc.inspector import figures
from torchrl_etdmpc.inspector.inspection import Inspection, Job, State
from torchrl_etdmpc.inspector.saved_page import WIDE, facts_of, frames_of, picture, setting_rows, write_page
from torchrl_etdmpc.inspector.settings import PlannerSetting, plain_settings
from torchrl_etdmpc.inspector.trace import Trace

__all__ = ["make_page", "serve"]

LOOPBACK = ("127.0.0.1", "localhost", "::1")
_PATIENCE = 0.4  # seconds after which a plan shows its progress
_GRAPH: Any = {"displayModeBar": False, "responsive": True}
_AS_GIVEN = "as given"  # a score of one's own


def make_page(
    inspection: Inspection, *, state: State | None = None, allow_remote: bool = False, folder: str | Path = "page"
) -> Any:
    """A dash app.

    Args:
        inspection (Inspection): the agent.

    Keyword Args:
        state (State, optional): that is planned first. Default: the first decision of episode 0.
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
        raise ImportError("the page needs dash and plotly; run: pip install 'torchrl-etdmpc[inspect]'") from error
    app = dash.Dash(
        "torchrl_etdmpc",
        title="Planner inspector",
        update_title=None,  # pyright: ignore[reportArgumentType]
        assets_folder=str(Path(__file__).parent / "assets"),
        serve_locally=True,
        compress=False,
        enable_mcp=False,
        add_log_handler=False,
    )
    if not allow_remote:
        _answer_this_machine_only(app.server)
    first = State(episode=0, step=0) if state is None else state
    app.layout = _layout(inspection, first, str(folder))
    jobs: dict[int, Job] = {}
    _connect_plans(app, inspection, jobs)
    _connect_figures(app, inspection)
    _connect_state(app, inspection)
    _connect_saving(app, inspection)
    return app


def serve(
    app: Any,
    *,
    host: str = "127.0.0.1",
    port: int = 8050,
    allow_remote: bool = False,
    ready: Callable[[str, Callable[[], None]], None] | None = None,
) -> None:
    """Serves a page until it is stopped.

    Args:
        app (dash.Dash): of :func:`make_page`.

    Keyword Args:
        host (str): address to listen on. Default: ``"127.0.0.1"``.
        port (int): 0 takes a free one. Default: 8050.
        allow_remote (bool): whether ``host`` may be another address than this machine's own.
        ready (callable, optional): called with the page's address and a function that stops serving.

    Raises:
        ValueError: if ``host`` can be reached from other machines and that is not allowed.
        OSError: if the port is in use.
    """
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log_request(self, code: Any = "-", size: Any = "-") -> None:
            pass

    if host not in LOOPBACK and not allow_remote:
        raise ValueError(
            f"host must be this machine's own address, 127.0.0.1, got {host!r}: anybody who reaches the page can make "
            "this machine plan and write files; add allow_remote=true if that is meant."
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((host, port))
            listening.listen()
        except OSError as error:
            raise OSError(
                f"port={port} cannot be used ({error.strerror}); choose another one, e.g. port={port + 1}."
            ) from error
        number = listening.getsockname()[1]
        server = make_server(host, number, app.server, threaded=True, request_handler=Quiet, fd=listening.fileno())
        try:
            if ready is not None:
                ready(f"http://{f'[{host}]' if ':' in host else host}:{number}/", _stopper(server))
            server.serve_forever()
        finally:
            server.server_close()


def _stopper(server: Any) -> Callable[[], None]:
    return lambda: threading.Thread(target=server.shutdown).start()


def _answer_this_machine_only(server: Any) -> None:
    """Refuses requests by another name: a site that points its own name at this machine is not to use the page."""
    from flask import abort, request

    @server.before_request
    def check() -> None:
        name = (
            request.host.rsplit(":", 1)[0].strip("[]") if not request.host.endswith("]") else request.host.strip("[]")
        )
        if name not in LOOPBACK:
            abort(403)


def slider_range(setting: PlannerSetting, value: float) -> tuple[float, float, float]:
    """Least, most and step of a setting's slider, from its value and its default.

    >>> slider_range(PlannerSetting("horizon", "whole", (), False, 6), 3)
    (0, 12, 1)
    """
    default = setting.default if isinstance(setting.default, int | float) else 0
    most = max(abs(value), abs(default))
    if setting.kind == "whole":
        return 0, int(max(2 * most, 4)), 1
    if most == 0:
        return 0.0, 20.0, 0.1
    if 0.5 < most <= 1:
        return 0.0, 1.0, 0.005
    return (0.0 if value >= 0 else -2 * most), 2 * most, most / 50


def _layout(inspection: Inspection, first: State, folder: str) -> Any:
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
    stores = [dcc.Store(id=name) for name in ("trace-a", "trace-b", "job", "candidate")]
    poll = dcc.Interval(id="poll", interval=200, disabled=True)
    body = html.Div(
        [
            html.Aside(_controls(inspection, first, folder), className="controls"),
            html.Main(_main(), id="main", className="main"),
        ],
        className="body",
    )
    return html.Div([*stores, poll, head, body])


def _controls(inspection: Inspection, first: State, folder: str) -> list[Any]:
    from dash import dcc, html

    sources = [{"label": " episode", "value": "episode"}]
    if inspection.replay is not None:
        sources.append({"label": f" replay ({inspection.rows:,} rows)", "value": "replay"})
    most = inspection.steps or (inspection.task.decision_steps_per_episode if inspection.task else 1)
    state = [
        html.H2("State"),
        dcc.RadioItems(sources, "replay" if first.replay else "episode", id="source", inline=True),
        _named(
            "episode (seed)", dcc.Input(id="episode", type="number", min=0, step=1, value=first.episode, debounce=True)
        ),
        _named(
            "step",
            dcc.Slider(
                0,
                inspection.rows - 1 if first.replay else most - 1,
                1,
                value=first.step,
                id="step",
                marks=None,
                updatemode="mouseup",
                allow_direct_input=False,
            ),
            "step-name",
        ),
        _named("seed of the noise", dcc.Input(id="seed", type="number", min=0, step=1, value=0, debounce=True)),
    ]
    values = plain_settings(inspection.planner)
    settings = [html.H2("Planner"), html.Button("as it was trained", id="reset"), html.Div(id="unused")]
    settings += [_control(setting, values[name]) for name, setting in inspection.settings.items()]
    second = [
        html.H2("Second setting"),
        html.Button("hold this one", id="hold"),
        html.Button("let go", id="release"),
        html.P("The held plan stays beside whatever is chosen next."),
        html.H2("Save"),
        _named("folder", dcc.Input(id="folder", type="text", value=folder, debounce=True)),
        html.Button("save the page", id="save"),
        html.Div(id="saved", role="status"),
    ]
    return [*state, *settings, *second]


def _named(name: str, control: Any, identity: Any = None) -> Any:
    from dash import html

    label = html.Div(html.Span(name, **({"id": identity} if identity else {})), className="name")
    return html.Div([label, control], className="setting")


def _control(setting: PlannerSetting, value: Any) -> Any:
    """A slider, a choice or a switch; text for what can only be seen."""
    from dash import dcc, html

    identity = {"type": "setting", "name": setting.name}
    if setting.kind == "choice":
        options = [None, *setting.choices] if setting.optional else list(setting.choices)
        if value not in options:
            options.insert(0, _AS_GIVEN)
            value = _AS_GIVEN
        shown = [{"label": f" {_text(option)}", "value": _text(option)} for option in options]
        control = dcc.RadioItems(shown, _text(value), id=identity, inline=True)
    elif setting.kind == "switch":
        control = dcc.RadioItems(
            [{"label": f" {_text(on)}", "value": _text(on)} for on in (True, False)],
            _text(value),
            id=identity,
            inline=True,
        )
    elif setting.kind in ("whole", "number") and not setting.optional:
        low, high, step = slider_range(setting, value)
        control = dcc.Slider(
            low, high, step, value=value, id=identity, marks=None, updatemode="mouseup", allow_direct_input=False
        )
    elif setting.kind in ("whole", "number"):
        control = dcc.Input(id=identity, type="number", value=value, placeholder="not set", debounce=True)
    else:
        return _named(setting.name, html.Code(str(value)), {"type": "name", "name": setting.name})
    return _named(setting.name, control, {"type": "name", "name": setting.name})


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else "not set" if value is None else str(value)


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
            html.Label(
                [
                    html.Span("iteration", id="iteration-name"),
                    html.Div(dcc.Slider(1, 1, 1, value=1, id="iteration", **slider), className="scrub"),
                ]
            ),
            html.Label(
                [
                    html.Span("depth", id="depth-name"),
                    html.Div(dcc.Slider(1, 1, 1, value=1, id="depth", **slider), className="scrub"),
                ]
            ),
            html.Div(
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
                ]
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


def _changes(inspection: Inspection, names: list[str], values: list[Any]) -> dict[str, Any]:
    """The settings as the planner takes them, from what their controls show."""
    changes: dict[str, Any] = {}
    for name, value in zip(names, values, strict=True):
        setting = inspection.settings[name]
        if setting.kind == "choice":
            if value == _AS_GIVEN:
                continue
            kinds = {_text(choice): choice for choice in (*setting.choices, None)}
            changes[name] = kinds[value]
        elif setting.kind == "switch":
            changes[name] = value == "true"
        elif value is None:
            if not setting.optional:
                raise ValueError(f"{name} must be a number, and is empty.")
            changes[name] = None
        else:
            changes[name] = int(value) if setting.kind == "whole" else float(value)
    return changes


def _connect_plans(app: Any, inspection: Inspection, jobs: dict[int, Job]) -> None:
    from dash import ALL, Input, Output, State, ctx, no_update

    @app.callback(
        Output("trace-a", "data"),
        Output("job", "data"),
        Output("poll", "disabled"),
        Output("doing", "children"),
        Output("progress", "value"),
        Output("progress", "className"),
        Output("cancel", "className"),
        Output("error", "children"),
        Input("source", "value"),
        Input("episode", "value"),
        Input("step", "value"),
        Input("seed", "value"),
        Input({"type": "setting", "name": ALL}, "value"),
        Input("poll", "n_intervals"),
        Input("cancel", "n_clicks"),
        State("job", "data"),
        State("trace-b", "data"),
    )
    def plan(
        source: str,
        episode: Any,
        step: Any,
        seed: Any,
        values: list[Any],
        _: Any,
        __: Any,
        number: int | None,
        held: Any,
    ) -> tuple[Any, ...]:
        if ctx.triggered_id == "cancel" and number in jobs:
            jobs[number].stop.set()
        if ctx.triggered_id not in ("poll", "cancel"):
            names = [entry["id"]["name"] for entry in ctx.inputs_list[4]]
            try:
                if None in (episode, step, seed):
                    raise ValueError("episode, step and seed must be whole numbers from 0 on.")
                state = _state_of(source, episode, step)
                changes = _changes(inspection, names, values)
            except ValueError as error:
                return no_update, no_update, True, "", "0", "hidden", "hidden", str(error)
            job = inspection.start(state, changes, like=held, seed=int(seed))
            number = max(jobs, default=0) + 1
            jobs[number] = job
            jobs.pop(number - 8, None)
            job.wait(_PATIENCE)
        if number not in jobs:
            return no_update, no_update, True, "", "0", "hidden", "hidden", no_update
        job = jobs[number]
        if not job.wait(0):
            part = str(job.done / job.of) if job.of else "0"
            count = f"{job.done} of {job.of}" if job.of else ""
            return no_update, number, False, f"{job.what} {count}", part, "", "", ""
        assert job.future is not None
        if job.future.cancelled() or job.future.exception() is not None:
            error = "" if job.future.cancelled() else " ".join(str(job.future.exception()).split())
            return no_update, number, True, "", "0", "hidden", "hidden", error
        return job.future.result(), number, True, "", "1", "hidden", "hidden", ""

    @app.callback(
        Output({"type": "setting", "name": ALL}, "value"),
        Input("reset", "n_clicks"),
        State({"type": "setting", "name": ALL}, "value"),
        prevent_initial_call=True,
    )
    def reset(_: Any, values: list[Any]) -> list[Any]:
        given = plain_settings(inspection.planner)
        names = [entry["id"]["name"] for entry in ctx.states_list[0]]
        return [_shown(inspection, name, given[name]) for name in names]

    @app.callback(
        Output({"type": "name", "name": ALL}, "className"),
        Output({"type": "name", "name": ALL}, "children"),
        Input({"type": "setting", "name": ALL}, "value"),
        State({"type": "name", "name": ALL}, "id"),
    )
    def mark(values: list[Any], labels: list[Any]) -> tuple[list[str], list[str]]:
        given = plain_settings(inspection.planner)
        names = [entry["id"]["name"] for entry in ctx.inputs_list[0]]
        now = dict(zip(names, values, strict=True))
        changed = {name for name, value in now.items() if value != _shown(inspection, name, given[name])}
        numbers = {name for name in names if inspection.settings[name].kind in ("whole", "number")}
        classes = ["changed" if label["name"] in changed else "" for label in labels]
        texts = [
            f"{label['name']} {_text(now[label['name']])}" if label["name"] in numbers else label["name"]
            for label in labels
        ]
        return classes, texts

    @app.callback(
        Output("step-name", "children"),
        Output("iteration-name", "children"),
        Output("depth-name", "children"),
        Input("step", "value"),
        Input("iteration", "value"),
        Input("depth", "value"),
    )
    def count(step: Any, iteration: Any, depth: Any) -> tuple[str, str, str]:
        return f"step {step}", f"iteration {iteration}", f"depth {depth}"

    @app.callback(
        Output("trace-b", "data"),
        Output("main", "className"),
        Input("hold", "n_clicks"),
        Input("release", "n_clicks"),
        State("trace-a", "data"),
        prevent_initial_call=True,
    )
    def hold(_: Any, __: Any, shown: int | None) -> tuple[Any, str]:
        return (shown, "main two") if ctx.triggered_id == "hold" and shown is not None else (None, "main")


def _shown(inspection: Inspection, name: str, value: Any) -> Any:
    """A setting's value as its control has it."""
    setting = inspection.settings[name]
    if setting.kind == "choice":
        return _text(value) if value is None or value in setting.choices else _AS_GIVEN
    return _text(value) if setting.kind == "switch" else value


def _state_of(source: str, episode: Any, step: Any) -> State:
    return State(episode=int(episode), step=int(step), replay=source == "replay")


def _connect_figures(app: Any, inspection: Inspection) -> None:
    from dash import Input, Output, State, no_update

    moving = ("latent_plane", "return_table", "disagreement", "plan_gaussian", "mixture_weights")
    still = [name for name in figures.FIGURES if name not in moving]

    # In the browser, so that a click costs one way to this process and not two.
    app.clientside_callback(
        """function (one, two, clickA, clickB, unclick) {
            const context = dash_clientside.callback_context;
            const cause = context.triggered.length ? context.triggered[0].prop_id : "";
            for (const [side, click] of [["a", clickA], ["b", clickB]]) {
                if (cause === `latent_plane-${side}.clickData`) {
                    const found = click && click.points[0].customdata;
                    return found === undefined || found === null ? dash_clientside.no_update
                        : {side: side, candidate: found};
                }
            }
            return null;
        }""",
        Output("candidate", "data"),
        Input("trace-a", "data"),
        Input("trace-b", "data"),
        Input("latent_plane-a", "clickData"),
        Input("latent_plane-b", "clickData"),
        Input("unclick", "n_clicks"),
        prevent_initial_call=True,
    )

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

    for side in "ab":
        # One callback a figure, each with what it depends on: a click or a scrubber draws no more than it changes.
        chosen = (Input(f"trace-{side}", "data"), Input("iteration", "value"), Input("candidate", "data"))

        @app.callback(
            Output(f"latent_plane-{side}", "figure"),
            *chosen,
            Input("depth", "value"),
            Input("components", "value"),
            prevent_initial_call=True,
        )
        def plane(number: Any, iteration: int, clicked: Any, depth: int, components: str, side: str = side) -> Any:
            trace, at, candidate = _looked_at(inspection, number, iteration, clicked, side)
            if trace is None:
                return no_update
            candidate = None if trace.get("points") is None else candidate
            axes = int(components[0]), int(components[1])
            depth = min(depth, trace.horizon)
            return figures.plain_latent_plane(trace, at, depth=depth, components=axes, candidate=candidate)

        for name in ("return_table", "disagreement"):

            @app.callback(Output(f"{name}-{side}", "figure"), *chosen, prevent_initial_call=True)
            def of_candidate(number: Any, iteration: int, clicked: Any, side: str = side, name: str = name) -> Any:
                trace, at, candidate = _looked_at(inspection, number, iteration, clicked, side)
                return no_update if trace is None else getattr(figures, name)(trace, at, candidate)

        @app.callback(Output(f"plan_gaussian-{side}", "figure"), *chosen[:2], prevent_initial_call=True)
        def gaussian(number: Any, iteration: int, side: str = side) -> Any:
            trace, at, _ = _looked_at(inspection, number, iteration, None, side)
            return no_update if trace is None else figures.plan_gaussian(trace, at)

        @app.callback(Output(f"mixture_weights-{side}", "figure"), chosen[0], chosen[2], prevent_initial_call=True)
        def weights(number: Any, clicked: Any, side: str = side) -> Any:
            trace, _, candidate = _looked_at(inspection, number, 1, clicked, side)
            return no_update if trace is None else figures.mixture_weights(trace, candidate)

        @app.callback(
            *[Output(f"{name}-{side}", "figure") for name in still],
            Output(f"described-{side}", "children"),
            Input(f"trace-{side}", "data"),
            State("trace-b", "data"),
            prevent_initial_call=True,
        )
        def stand(number: int | None, held: int | None, side: str = side) -> tuple[Any, ...]:
            trace = inspection.traces.get(number) if number is not None else None
            if trace is None:
                return *[no_update] * len(still), []
            made = [getattr(figures, name)(trace) for name in still]
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
        return figures.compare_plans(first, second), _difference_table(setting_rows(first, second))


def _looked_at(
    inspection: Inspection, number: int | None, iteration: int, clicked: Any, side: str
) -> tuple[Trace | None, int, int | None]:
    """A side's trace if it is there, the iteration from 0, and the candidate that was clicked there."""
    trace = None if number is None else inspection.traces.get(number)
    if trace is None:
        return None, 0, None
    candidate = clicked["candidate"] if clicked and clicked["side"] == side else None
    if candidate is not None and candidate >= trace["scores"].shape[1]:
        candidate = None
    return trace, min(iteration, trace.iterations) - 1, candidate


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


def _connect_state(app: Any, inspection: Inspection) -> None:
    from dash import ALL, Input, Output, State, ctx, html, no_update

    @app.callback(
        Output("strip", "children"),
        Output("step", "max"),
        Input("trace-a", "data"),
        State("source", "value"),
        State("episode", "value"),
        State("step", "value"),
        prevent_initial_call=True,
    )
    def film(_: Any, source: str, episode: Any, step: Any) -> tuple[Any, Any]:
        if source == "replay":
            return [], inspection.rows - 1
        strip, length = inspection.strip(int(episode)), inspection.length(int(episode))
        if strip is None or length is None:
            return no_update, no_update
        nearest = min(strip.steps, key=lambda at: abs(at - step))
        pictures = [
            html.Button(
                [html.Img(src=picture(frame), alt=f"step {at}"), str(at)],
                id={"type": "frame", "step": at},
                className="here" if at == nearest else "",
            )
            for at, frame in zip(strip.steps, strip.frames, strict=False)
        ]
        return pictures, length - 1

    @app.callback(
        Output("step", "value"),
        Input({"type": "frame", "step": ALL}, "n_clicks"),
        prevent_initial_call=True,
    )
    def choose(clicks: list[Any]) -> Any:
        return ctx.triggered_id["step"] if any(clicks) and ctx.triggered_id else no_update


def _connect_saving(app: Any, inspection: Inspection) -> None:
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


def page_settings(inspection: Inspection) -> Mapping[str, PlannerSetting]:
    """What the page has a control for."""
    return {name: setting for name, setting in inspection.settings.items() if setting.kind != "other"}
