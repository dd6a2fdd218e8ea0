"""The controls: of the state, and one for every setting of the planner, made from its signature."""

from __future__ import annotations

from typing import Any

from torchrl_etdmpc.inspector.inspection import Inspection, State
from torchrl_etdmpc.inspector.settings import PlannerSetting, plain_settings

_AS_GIVEN = "as given"  # a score of one's own


def slider_range(setting: PlannerSetting, value: float) -> tuple[float, float, float]:
    """Least, most and step of a setting's slider, from its value and its default.

    >>> slider_range(PlannerSetting("horizon", "whole", (), False, 6), 3)
    (0, 12, 1)
    """
    default = setting.default if isinstance(setting.default, int | float) else 0
    most = 2 * max(abs(value), abs(default))
    if setting.kind == "whole":
        most = int(max(most, 4))
        return (0 if value >= 0 else -most), most, 1
    if 1 < most <= 2 and value >= 0 and default > 0:  # a share
        return 0.0, 1.0, 0.005
    if default == 0:  # of which nothing says how much is a lot
        most = max(most, 20.0)
    return (0.0 if value >= 0 else -most), most, most / (100 if default else 200)


def controls(inspection: Inspection, first: State, folder: str, seed: int) -> list[Any]:
    """Everything beside the plan: the state, the planner's settings, holding and saving."""
    from dash import dcc, html

    sources = [{"label": " episode", "value": "episode"}]
    if inspection.replay is not None:
        sources.append({"label": f" replay ({inspection.rows:,} rows)", "value": "replay"})
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
                (inspection.rows if first.replay else inspection.decisions) - 1,
                1,
                value=first.step,
                id="step",
                marks=None,
                updatemode="mouseup",
                allow_direct_input=False,
            ),
            "step-name",
        ),
        _named("seed of the noise", dcc.Input(id="seed", type="number", min=0, step=1, value=seed, debounce=True)),
    ]
    values = plain_settings(inspection.planner)
    settings = [html.H2("Planner"), html.Button("as at the start", id="reset")]
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
    return group(name, [label, control], className="setting")


def group(name: str, content: list[Any], **options: Any) -> Any:
    """What screen readers know by one name."""
    from dash import html

    label: dict[str, Any] = {"aria-label": name}
    return html.Div(content, role="group", **label, **options)


def _control(setting: PlannerSetting, value: Any) -> Any:
    """A slider, a choice or a switch; text for what can only be seen."""
    from dash import dcc, html

    identity = {"type": "setting", "name": setting.name}
    if setting.kind == "choice":
        options = [None, *setting.choices] if setting.optional else list(setting.choices)
        if value not in options:
            options.insert(0, _AS_GIVEN)
            value = _AS_GIVEN
        shown = [{"label": f" {text_of(option)}", "value": text_of(option)} for option in options]
        control = dcc.RadioItems(shown, text_of(value), id=identity, inline=True)
    elif setting.kind == "switch":
        control = dcc.RadioItems(
            [{"label": f" {text_of(on)}", "value": text_of(on)} for on in (True, False)],
            text_of(value),
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


def text_of(value: Any) -> str:
    """A choice as it is shown."""
    return str(value).lower() if isinstance(value, bool) else "not set" if value is None else str(value)


def changed_settings(inspection: Inspection, names: list[str], values: list[Any]) -> dict[str, Any]:
    """The settings as the planner takes them, from what their controls show."""
    changes: dict[str, Any] = {}
    for name, value in zip(names, values, strict=True):
        setting = inspection.settings[name]
        if setting.kind == "choice":
            if value == _AS_GIVEN:
                continue
            kinds = {text_of(choice): choice for choice in (*setting.choices, None)}
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


def shown(inspection: Inspection, name: str, value: Any) -> Any:
    """A setting's value as its control has it."""
    setting = inspection.settings[name]
    if setting.kind == "choice":
        return text_of(value) if value is None or value in setting.choices else _AS_GIVEN
    return text_of(value) if setting.kind == "switch" else value
