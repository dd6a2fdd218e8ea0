"""Planning anew: what state and settings ask for, how far it is, and the plan that is held beside it."""

from __future__ import annotations

from typing import Any

from torchrl_etdmpc.inspector.inspection import Inspection, Job
from torchrl_etdmpc.inspector.inspection import State as Chosen
from torchrl_etdmpc.inspector.page.controls import changed_settings, shown, text_of
from torchrl_etdmpc.inspector.settings import plain_settings

_PATIENCE = 0.8  # seconds after which a plan shows its progress: what is quicker comes without asking again


def connect_plans(app: Any, inspection: Inspection) -> None:
    """Plans what the controls ask for, and holds a plan."""
    from dash import ALL, ClientsideFunction, Input, Output, State, ctx, no_update

    jobs: dict[int, Job] = {}

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
                if not all(isinstance(given, int) and 0 <= given < 2**31 for given in (episode, step, seed)):
                    raise ValueError("episode, step and seed must be whole numbers in [0, 2**31 - 1].")
                state = Chosen(episode, step, replay=source == "replay")
                changes = changed_settings(inspection, names, values)
            except ValueError as error:
                if number in jobs:
                    jobs[number].stop.set()  # nobody will look at what it comes to
                return no_update, no_update, True, "", "0", "hidden", "hidden", str(error)
            job = inspection.start(state, changes, like=held, seed=seed)
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
        failure = job.future.exception()
        if failure is not None:
            return no_update, number, True, "", "0", "hidden", "hidden", " ".join(str(failure).split())
        made = job.future.result()
        if held in inspection.traces and held not in (job.like, made) and job.request is not None:
            state, changes, seed = job.request  # another plan was held meanwhile: again, in its components
            jobs[number] = inspection.start(state, changes, like=held, seed=seed)
            return no_update, number, False, "planning", "0", "", "", ""
        return made, number, True, "", "1", "hidden", "hidden", ""

    @app.callback(
        Output({"type": "setting", "name": ALL}, "value"),
        Input("reset", "n_clicks"),
        State({"type": "setting", "name": ALL}, "value"),
        prevent_initial_call=True,
    )
    def reset(_: Any, values: list[Any]) -> list[Any]:
        given = plain_settings(inspection.planner)
        names = [entry["id"]["name"] for entry in ctx.states_list[0]]
        return [shown(inspection, name, given[name]) for name in names]

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
        changed = {name for name, value in now.items() if value != shown(inspection, name, given[name])}
        numbers = {name for name in names if inspection.settings[name].kind in ("whole", "number")}
        classes = ["changed" if label["name"] in changed else "" for label in labels]
        texts = [
            f"{label['name']} {text_of(now[label['name']])}" if label["name"] in numbers else label["name"]
            for label in labels
        ]
        return classes, texts

    app.clientside_callback(
        ClientsideFunction("inspector", "counts"),
        Output("step-name", "children"),
        Output("iteration-name", "children"),
        Output("depth-name", "children"),
        Input("step", "value"),
        Input("iteration", "value"),
        Input("depth", "value"),
    )

    app.clientside_callback(
        ClientsideFunction("inspector", "fit"), Input("main", "className"), prevent_initial_call=True
    )

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
