from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

import numpy as np
import pytest
import torch

pytest.importorskip("dash")
pytest.importorskip("gymnasium")

from torchrl_etdmpc.envs import get_task  # noqa: E402
from torchrl_etdmpc.inspector import load_trace, play_episode, trace_plan, with_settings  # noqa: E402
from torchrl_etdmpc.inspector.inspection import Inspection, State, Strip  # noqa: E402
from torchrl_etdmpc.inspector.page import make_page, serve, slider_range  # noqa: E402
from torchrl_etdmpc.inspector.saved_page import write_page  # noqa: E402
from torchrl_etdmpc.inspector.settings import settings_of_class  # noqa: E402
from torchrl_etdmpc.modules import WorldModel  # noqa: E402
from torchrl_etdmpc.planners import EnsembleMPPIPlanner, LatentEnv  # noqa: E402

TASK = get_task("gym/Pendulum-v1")
BUDGET: dict[str, Any] = {"horizon": 3, "num_samples": 24, "num_elites": 5, "num_proposals": 3, "iterations": 3}


class Greedy(EnsembleMPPIPlanner):
    """A planner with an argument of its own."""

    def __init__(self, env: LatentEnv, *, greed: float = 0.5, **kwargs: Any) -> None:
        super().__init__(env, **kwargs)
        self.greed = greed


def make_planner() -> Greedy:
    torch.manual_seed(0)
    model = WorldModel(3, 1, latent_dim=16, mlp_dim=16, num_dynamics=2)
    for parameter in model.parameters():  # an untrained model finds every candidate equally good
        if parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=parameter.shape[-2] ** -0.5)
    return Greedy(LatentEnv(model), greed=0.25, **BUDGET)


class Served:
    """A page in a thread of this process."""

    def __init__(self, app: Any, **options: Any) -> None:
        started = threading.Event()

        def ready(address: str, stop: Callable[[], None]) -> None:
            self.address, self.stop = address, stop
            started.set()

        self.thread = threading.Thread(target=serve, args=(app,), kwargs={"port": 0, "ready": ready, **options})
        self.thread.start()
        assert started.wait(30)

    def close(self) -> None:
        self.stop()
        self.thread.join(30)
        assert not self.thread.is_alive()


@pytest.fixture(scope="module")
def inspection() -> Iterator[Inspection]:
    made = Inspection(make_planner(), TASK, steps=8, about={"checkpoint": {"name": "agent.pt"}})
    yield made
    made.close()


@pytest.fixture(scope="module")
def served(inspection) -> Iterator[Served]:
    page = Served(make_page(inspection))
    yield page
    page.close()


def test_every_setting_has_a_control_also_a_new_one():
    inspection = Inspection(make_planner())
    text = json.dumps(make_page(inspection).layout.to_plotly_json(), default=lambda part: part.to_plotly_json())
    for name in settings_of_class(Greedy):
        assert f'{{"type": "setting", "name": "{name}"}}' in text, name
    inspection.close()


@pytest.mark.parametrize("value", [-3, 0, 1, 3, 512])
def test_a_whole_slider_holds_its_value(value):
    low, high, step = slider_range(settings_of_class(Greedy)["horizon"], value)
    assert low <= value <= high and step == 1


@pytest.mark.parametrize("name", ["beta", "discount"])
@pytest.mark.parametrize("value", [-2.0, -0.8, 0.0, 0.05, 0.99, 2.0, 30.0])
def test_a_number_s_slider_holds_its_value(name, value):
    low, high, step = slider_range(settings_of_class(Greedy)[name], value)
    assert low <= value <= high and 0 < step < high


@pytest.mark.parametrize("value", [0.0, 0.05, 0.8, 1.0, 10.0])
def test_much_pessimism_can_be_reached_from_little(value):
    assert slider_range(settings_of_class(Greedy)["beta"], value) == (0.0, 20.0, 0.1)


def test_the_page_answers_this_machine_only(served):
    assert urlopen(served.address).status == 200
    for name in ("localhost", "localhost:8050", "[::1]", "[::1]:8050"):
        assert urlopen(Request(served.address, headers={"Host": name})).status == 200
    with pytest.raises(HTTPError, match="403") as caught:
        urlopen(Request(served.address, headers={"Host": "evil.example:8050"}))
    caught.value.close()


def test_a_page_that_may_be_reached_from_elsewhere_answers_by_any_name(inspection):
    client = make_page(inspection, allow_remote=True).server.test_client()
    assert client.get("/", headers={"Host": "another.example:8050"}).status_code == 200


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "::"])
def test_another_address_is_refused_unless_told(host):
    with pytest.raises(
        ValueError, match=f"host must be this machine's own address, 127.0.0.1, got '{host}'.*allow_remote"
    ):
        serve(None, host=host)


def test_a_port_in_use_is_one_line():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(OSError, match=f"port={port} cannot be used .*; choose another one, e.g. port={port + 1}"):
            serve(None, port=port)
    with socket.socket() as other:
        with contextlib.suppress(OSError):  # somebody else has it
            other.bind(("127.0.0.1", 65_535))
            other.listen()
        with pytest.raises(OSError, match="port=65535 cannot be used .*; choose another one, e.g. port=8050"):
            serve(None, port=65_535)


def test_an_address_of_another_machine_is_one_line():
    with pytest.raises(OSError, match=r"^host=192\.0\.2\.1 is no address of this machine \(.*\)\.$"):
        serve(None, host="192.0.2.1", allow_remote=True)


def wait_for(condition: Callable[[], Any], what: str, seconds: float = 30) -> Any:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.05)
    pytest.fail(f"the page did not show {what}")


def wait_for_numbers(read: Callable[[], Any], wanted: Any, what: str) -> None:
    def there() -> bool:
        found = np.array(read(), dtype=float)
        return found.shape == np.shape(wanted) and np.allclose(found, wanted, atol=1e-5)

    wait_for(there, what)


class Page:
    """What the browser shows."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def traces(self, name: str, kind: str | None = None) -> list[dict[str, Any]]:
        """Of a figure, the drawn traces with their numbers."""
        script = """
            const graph = document.getElementById(arguments[0]);
            const drawn = graph.classList.contains('js-plotly-plot') ? graph : graph.querySelector('.js-plotly-plot');
            const plain = values => values === undefined || values === null ? null : Array.from(values, value =>
                value && value.length !== undefined && typeof value !== 'string' ? Array.from(value) : value);
            return (drawn && drawn._fullData || []).map(trace => ({name: trace.name, x: plain(trace.x),
                y: plain(trace.y), z: plain(trace.z), customdata: plain(trace.customdata),
                colour: trace.marker ? plain(trace.marker.color.length ? trace.marker.color : null) : null}));
        """
        found = self.driver.execute_script(script, name)
        return [trace for trace in found if kind is None or trace["name"] == kind]

    def rings(self, graph: str) -> list[dict[str, Any]]:
        """Shapes around a clicked candidate, as they are drawn."""
        script = """
            const graph = document.getElementById(arguments[0]);
            const drawn = graph.classList.contains('js-plotly-plot') ? graph : graph.querySelector('.js-plotly-plot');
            const paths = drawn.querySelectorAll('.shapelayer path').length;
            return (drawn._fullLayout.shapes || []).map(shape => ({xref: shape.xref, x: shape.xanchor,
                y: shape.yanchor, paths: paths}));
        """
        return self.driver.execute_script(script, graph)

    def count_drawn(self, graph: str) -> None:
        """Counts in ``window.drawn`` how often a figure is drawn as a whole from now on."""
        script = """
            const react = Plotly.react;
            window.drawn = 0;
            Plotly.react = (graph, ...rest) => {
                window.drawn += graph.parentElement.id === arguments[0] ? 1 : 0;
                return react(graph, ...rest);
            };
        """
        self.driver.execute_script(script, graph)

    def text(self, name: str) -> str:
        return self.driver.find_element("id", name).text

    def click(self, name: str) -> None:
        self.driver.find_element("id", name).click()

    def push(self, slider: str, key: str) -> None:
        """A key on a slider's handle."""
        control = self.driver.execute_script("return document.getElementById(arguments[0])", slider)
        control.find_element("css selector", "[role=slider]").send_keys(key)

    def click_candidate(self, graph: str) -> list[dict[str, Any]]:
        """A circle, with the mouse: the first that no other mark covers. Returns the rings around it."""
        from selenium.webdriver import ActionChains

        element = self.driver.find_element("id", graph)
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
        for number in range(6):
            point = element.find_elements("css selector", ".scatterlayer .trace path.point")[number]
            ActionChains(self.driver).move_to_element(point).pause(0.3).click().perform()
            end = time.monotonic() + 5
            while time.monotonic() < end:
                rings = self.rings(graph)
                if rings:
                    return rings
        pytest.fail("no click reached a candidate")

    def require_clean(self) -> None:
        """No error in the console and no request that left the loopback."""
        from_console = [entry for entry in self.driver.get_log("browser") if entry["level"] == "SEVERE"]
        assert from_console == []
        for entry in self.driver.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                address = urlsplit(message["params"]["request"]["url"])
                own = address.scheme.startswith("chrome")  # of the browser's own first page
                inside = own or address.scheme in ("data", "file", "blob", "about")
                assert inside or address.hostname == "127.0.0.1", address.geturl()


@pytest.fixture
def page(tmp_path, monkeypatch) -> Iterator[Page]:
    selenium = pytest.importorskip("selenium.webdriver")
    chromium, driver = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("needs chromium and chromedriver: apt-get install chromium chromium-driver")
    from selenium.webdriver.chrome.service import Service

    monkeypatch.chdir(tmp_path)
    options = selenium.ChromeOptions()
    options.binary_location = chromium
    for option in (
        *("headless=new", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-sync"),
        *("disable-background-networking", "disable-component-update", "window-size=1280,1000"),
        f"user-data-dir={tmp_path / 'browser'}",
    ):
        options.add_argument(f"--{option}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    started = selenium.Chrome(options=options, service=Service(driver))
    yield Page(started)
    started.quit()


def expected(step: int, **changes: Any):
    """The planner's own numbers, without the page."""
    episode = play_episode(make_planner(), TASK, seed=0, steps=8)
    planner = with_settings(make_planner(), **changes)
    return trace_plan(planner, episode.observation[step], plan_mean=episode.plan_mean[step])


def shows(page: Page, trace: Any, side: str, iteration: int) -> bool:
    marks = [mark for mark in page.traces(f"latent_plane-{side}") if mark["name"] in ("candidate", "elite", "proposal")]
    scores: dict[int, float] = {}
    for mark in marks:
        scores |= dict(zip(mark["customdata"] or [], mark["colour"] or [], strict=True))
    shown = [scores.get(candidate, np.nan) for candidate in range(trace["scores"].shape[1])]
    return len(scores) == len(shown) and np.allclose(shown, trace["scores"][iteration], atol=1e-5)


def candidate_at(page: Page, rings: list[dict[str, Any]]) -> int:
    """The candidate in the middle of a ring in the first head's panel."""
    assert [ring["xref"] for ring in rings] == ["x", "x2"] and rings[0]["paths"] == 2
    middle = np.array([rings[0]["x"], rings[0]["y"]])
    for kind in ("candidate", "elite", "proposal"):
        marks = page.traces("latent_plane-a", kind)[0]
        away = np.abs(np.stack([marks["x"], marks["y"]], 1) - middle).max(1)
        if away.min() < 1e-5:
            return marks["customdata"][int(away.argmin())]
    pytest.fail("the ring is around no candidate")


@pytest.mark.slow
def test_a_browser_shows_the_planner_s_numbers(page, served, tmp_path):
    """A state is chosen, a slider is moved, iterations are scrubbed, a candidate is clicked, two settings are compared
    and the page is saved; then the saved page does what it can without a server."""
    from selenium.webdriver.common.keys import Keys

    page.driver.get(served.address)
    # Both this thread and the page's play the episode with torch's one generator: one after the other.
    wait_for(lambda: page.driver.find_elements("css selector", "#described-a li"), "the first state")
    assert "episode 0, step 0" in page.text("described-a")
    first = expected(0)
    assert np.ptp(first["scores"][-1]) > 1e-2  # or any numbers would do
    wait_for(lambda: shows(page, first, "a", -1), "the plan of the first state")
    assert f"{float(first['value']):.3f}" in page.text("described-a")

    frames = wait_for(lambda: page.driver.find_elements("css selector", "#strip button"), "the filmstrip")
    assert len(frames) == 8
    controls = page.driver.find_elements("css selector", "[role=slider], input, button:not(.hidden)")
    unnamed = [control.get_attribute("outerHTML")[:200] for control in controls if not control.accessible_name]
    assert len(controls) > 30 and unnamed == []  # for who hears the page
    frames[5].click()  # a state by its frame
    chosen = expected(5)
    wait_for(lambda: shows(page, chosen, "a", -1), "the plan of step 5")
    page.push("step", Keys.ARROW_LEFT)
    chosen = expected(4)
    wait_for(lambda: shows(page, chosen, "a", -1), "the plan of step 4, by the keyboard")

    page.push("iteration", Keys.ARROW_LEFT)
    wait_for(lambda: shows(page, chosen, "a", 1), "the iteration before")
    means = chosen["mean"][1, :, 0]
    wait_for_numbers(lambda: page.traces("plan_gaussian-a", "a1")[0]["y"], means, "the mean of that iteration")

    page.count_drawn("latent_plane-a")
    clicked = page.click_candidate("latent_plane-a")
    candidate = candidate_at(page, clicked)
    table = chosen["returns"][1, candidate].reshape(3, -1)
    wait_for_numbers(lambda: page.traces("return_table-a")[0]["z"], table, "its return table")
    assert page.driver.execute_script("return window.drawn") == 0  # the ring is moved, the candidates stay
    page.click("unclick")
    wait_for(lambda: not page.rings("latent_plane-a"), "the chosen sequence again")
    table = chosen["chosen_returns"].reshape(3, -1)
    wait_for_numbers(lambda: page.traces("return_table-a")[0]["z"], table, "its return table again")

    page.push("iteration", Keys.END)
    wait_for(lambda: shows(page, chosen, "a", -1), "the last iteration again")
    page.click("hold")
    wait_for(lambda: shows(page, chosen, "b", -1), "the held setting beside it")
    page.push('{"name":"horizon","type":"setting"}', Keys.ARROW_RIGHT)
    longer = expected(4, horizon=4)
    wait_for(lambda: shows(page, longer, "a", -1), "the plan with a longer horizon")
    assert shows(page, chosen, "b", -1)
    wait_for(lambda: "horizon 4 3" in page.text("differences"), "the differences")
    gap = chosen["mean"][-1] - longer["mean"][-1, :3]
    wait_for_numbers(lambda: page.traces("difference")[0]["z"], gap, "the difference of the plans")

    page.push('{"name":"num_elites","type":"setting"}', Keys.END)  # 10 elites of 24 candidates can be
    page.push('{"name":"num_samples","type":"setting"}', Keys.HOME)
    wait_for(lambda: "num_elites must be at most num_samples=0" in page.text("error"), "why a setting cannot be")
    page.click("reset")
    wait_for(lambda: shows(page, chosen, "a", -1), "the settings it was trained with")

    page.click("save")
    wait_for(lambda: "saved" in page.text("saved"), "that it was saved")
    assert np.array_equal(load_trace(tmp_path / "page" / "trace.npz")["scores"], chosen["scores"])
    page.require_clean()

    page.driver.get((tmp_path / "page" / "index.html").as_uri())
    wait_for(lambda: shows(page, chosen, "a", -1), "the saved plan")
    assert shows(page, chosen, "b", -1)
    page.driver.find_element("id", "iteration").send_keys(Keys.ARROW_LEFT)
    wait_for(lambda: shows(page, chosen, "a", 1), "an earlier iteration of the saved plan")
    clicked = page.click_candidate("latent_plane-a")
    candidate = candidate_at(page, clicked)
    table = chosen["returns"][1, candidate].reshape(3, -1)
    wait_for_numbers(lambda: page.traces("return_table-a")[0]["z"], table, "its return table in the saved page")
    page.require_clean()


@pytest.mark.slow
def test_the_theme_is_the_system_s_until_it_is_toggled(page, served):
    def paper() -> str:
        return page.driver.execute_script("return getComputedStyle(document.body).backgroundColor")

    for scheme, colour, other in (
        ("light", "rgb(255, 255, 255)", "rgb(20, 23, 27)"),
        ("dark", "rgb(20, 23, 27)", "rgb(255, 255, 255)"),
    ):
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        page.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        page.driver.get(served.address)
        wait_for(lambda: page.driver.find_elements("id", "theme"), "the page")
        page.driver.execute_script("localStorage.clear(); document.documentElement.removeAttribute('data-theme')")
        assert paper() == colour
        page.click("theme")
        assert paper() == other


@pytest.mark.slow
def test_nothing_is_cut_off_on_paper(page, tmp_path):
    trace, frame = expected(0), np.zeros((64, 64, 3), np.uint8)
    saved = write_page(tmp_path / "page", trace, trace, strip=Strip(list(range(30)), [frame] * 30), step=0)
    page.driver.get(saved.as_uri())
    wait_for(lambda: shows(page, trace, "b", -1), "the saved plan")
    page.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    paper = {"width": 700, "height": 1000, "deviceScaleFactor": 1, "mobile": False}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", paper)
    script = """return Array.from(document.querySelectorAll('.js-plotly-plot'), graph =>
        [Number(graph.querySelector('.main-svg').getAttribute('width')), graph.clientWidth])"""
    wait_for(lambda: np.ptp(page.driver.execute_script(script), axis=1).max() <= 1, "figures of the paper's width")
    assert page.driver.execute_script("return document.documentElement.scrollWidth") <= 700
    strips = "return Array.from(document.querySelectorAll('.strip'), strip => strip.scrollWidth - strip.clientWidth)"
    assert max(page.driver.execute_script(strips)) <= 0
    assert not page.driver.find_element("id", "iteration").is_displayed()
    assert "3 of 3" in page.text("iteration-value")


@pytest.mark.slow
def test_no_text_of_a_figure_is_cut_off(page, tmp_path):
    found = expected(0)
    large = {name: -213 + found[name] / 10 for name in ("scores", "returns", "chosen_returns", "policy_scores")}
    trace = dataclasses.replace(found, arrays={**found.arrays, **large})  # as of an agent that has learned
    page.driver.get(write_page(tmp_path / "page", trace).as_uri())
    wait_for(lambda: shows(page, trace, "a", -1), "the saved plan")
    script = """return Array.from(document.querySelectorAll('.js-plotly-plot'), graph => {
        const [outer, texts] = [graph.getBoundingClientRect(), graph.querySelectorAll('.main-svg text')];
        const within = box => box.left >= outer.left - 1 && box.right <= outer.right + 1;
        return Array.from(texts).filter(text => !within(text.getBoundingClientRect())).map(text => text.textContent);
    }).flat()"""
    drawn = "return document.querySelectorAll('.js-plotly-plot .main-svg text').length"
    assert page.driver.execute_script(drawn) > 50
    assert page.driver.execute_script(script) == []


@pytest.mark.slow
def test_two_settings_stand_below_each_other_on_a_narrow_screen(page, tmp_path):
    trace = expected(0)
    page.driver.get(write_page(tmp_path / "page", trace, trace).as_uri())
    wait_for(lambda: shows(page, trace, "b", -1), "the saved plan")
    script = """return ['a', 'b'].map(side =>
        document.getElementById('return_table-' + side).getBoundingClientRect().left)"""
    for width, beside in ((1000, True), (500, False)):
        screen = {"width": width, "height": 1000, "deviceScaleFactor": 1, "mobile": False}
        page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
        first, second = page.driver.execute_script(script)
        assert (second > first) == beside


def test_a_state_to_begin_with_is_planned_first(inspection):
    app = make_page(inspection, state=State(episode=3, step=2), folder=Path("elsewhere"))
    text = json.dumps(app.layout.to_plotly_json(), default=lambda part: part.to_plotly_json())
    assert '"id": "folder"' in text and '"value": "elsewhere"' in text
    assert '"value": 3' in text


def test_the_settings_that_come_back_are_those_of_the_start_and_are_called_so(with_replay):
    app = make_page(with_replay)  # of a planner that the command may have been told to change
    text = json.dumps(app.layout.to_plotly_json(), default=lambda part: part.to_plotly_json())
    assert '"children": "as at the start", "id": "reset"' in text


def test_the_seed_of_the_noise_to_begin_with_is_shown(inspection):
    text = json.dumps(
        make_page(inspection, seed=17).layout.to_plotly_json(), default=lambda part: part.to_plotly_json()
    )
    assert '"value": 17' in text


def ask(app: Any, output: str, changed: str, **held: Any) -> dict[str, Any]:
    """What the page answers when one part changes, by what its parts hold; nothing where all stays as it is."""
    client = app.server.test_client()
    options = {"headers": {"Host": "127.0.0.1"}}
    (found,) = [
        each
        for each in client.get("/_dash-dependencies", **options).json
        if output in each["output"] and each["clientside_function"] is None
    ]
    names = [name.rsplit(".", 1) for name in found["output"].strip(".").split("...")]
    outputs: Any = [{"id": name, "property": part} for name, part in names]
    told = {
        kind: [[] if part["id"].startswith("{") else part | {"value": held.get(part["id"])} for part in found[kind]]
        for kind in ("inputs", "state")
    }
    body = {
        "output": found["output"],
        "outputs": outputs if found["output"].startswith("..") else outputs[0],
        "changedPropIds": [changed],
        **told,
    }
    response = client.post("/_dash-update-component", json=body, **options)
    assert response.status_code in (200, 204), response.text
    return response.json["response"] if response.status_code == 200 else {}


@pytest.fixture
def with_replay() -> Iterator[Inspection]:
    made = Inspection(make_planner(), TASK, steps=8, replay=lambda row: torch.zeros(3) + row, rows=50)
    yield made
    made.close()


def number_of(inspection: Inspection, state: State) -> int:
    job = inspection.start(state, {})
    assert job.future is not None
    return job.future.result()


def test_the_filmstrip_is_that_of_the_plan_from_an_episode_to_the_replay_buffer_and_back(with_replay):
    app = make_page(with_replay)
    episode, row = number_of(with_replay, State(0, 3)), number_of(with_replay, State(0, 40, replay=True))
    film = "strip.children"
    seen = ask(app, film, "trace-a.data", **{"trace-a": episode})
    assert (seen["step"], seen["filmed"]) == ({"max": 7}, {"data": 0})
    assert ask(app, film, "trace-a.data", **{"trace-a": episode, "filmed": 0}) == {}
    seen = ask(app, film, "trace-a.data", **{"trace-a": row, "filmed": 0})
    assert seen == {"strip": {"children": []}, "step": {"max": 49}, "filmed": {"data": "replay"}}
    assert ask(app, film, "trace-a.data", **{"trace-a": row, "filmed": "replay"}) == {}
    seen = ask(app, film, "trace-a.data", **{"trace-a": episode, "filmed": "replay"})
    assert (seen["step"], seen["filmed"]) == ({"max": 7}, {"data": 0})


def test_a_step_beyond_the_end_of_what_is_chosen_is_the_last_one(with_replay):
    app = make_page(with_replay)
    step = {"step": {"value": 7}}
    assert ask(app, "step.value", "source.value", source="episode", episode=0, step=40) == step  # not played yet
    number_of(with_replay, State(0, 3))
    assert ask(app, "step.value", "source.value", source="episode", episode=0, step=40) == step
    assert ask(app, "step.value", "episode.value", source="episode", episode=0, step=7) == {}
    assert ask(app, "step.value", "source.value", source="replay", episode=0, step=49) == {}
    assert ask(app, "step.value", "source.value", source="replay", episode=None, step=60) == {"step": {"value": 49}}


@pytest.mark.parametrize("name", ["episode", "step", "seed"])
@pytest.mark.parametrize("number", [None, -1, 1.5, 2**31, 2**70])
def test_a_number_that_is_none_is_named_before_anything_is_planned(with_replay, name, number):
    at = {"source": "replay", "episode": 0, "step": 7, "seed": 5} | {name: number}
    said = ask(make_page(with_replay), "trace-a.data", f"{name}.value", **at)
    assert said["error"]["children"] == "episode, step and seed must be whole numbers in [0, 2**31 - 1]."
    assert "trace-a" not in said


def test_what_is_shown_is_saved_whatever_the_controls_say_by_now(with_replay, tmp_path, monkeypatch):
    monkeypatch.setattr("torchrl_etdmpc.inspector.saved_page.picture", lambda frame: "data:,")
    with_replay.play(0)
    frame = np.zeros((4, 4, 3), np.uint8)
    monkeypatch.setattr(with_replay, "strip", lambda episode: Strip([0, 3], [frame] * 2) if episode == 0 else None)
    app = make_page(with_replay)
    for state, marked in ((State(0, 3), True), (State(0, 40, replay=True), False)):
        shown = {"trace-a": number_of(with_replay, state), "folder": str(tmp_path / "page"), "episode": None}
        said = ask(app, "saved.children", "save.n_clicks", **shown)
        assert said == {"saved": {"children": f"saved: {tmp_path / 'page' / 'index.html'}"}}
        assert ('class="here"><img alt="step 3"' in (tmp_path / "page" / "index.html").read_text()) == marked


def test_a_plan_that_was_begun_before_another_was_held_comes_in_the_held_one_s_components(with_replay):
    app = make_page(with_replay)
    held = number_of(with_replay, State(0, 3, replay=True))
    at = {"source": "replay", "episode": 0, "step": 7, "seed": 5}
    alone = ask(app, "trace-a.data", "step.value", **at)["trace-a"]["data"]
    assert not np.allclose(with_replay.traces[alone]["basis"], with_replay.traces[held]["basis"])
    seen = ask(app, "trace-a.data", "poll.n_intervals", job=1, **at, **{"trace-b": held})
    while "trace-a" not in seen:
        seen = ask(app, "trace-a.data", "poll.n_intervals", job=1, **at, **{"trace-b": held})
    beside = with_replay.traces[seen["trace-a"]["data"]]
    np.testing.assert_allclose(beside["basis"], with_replay.traces[held]["basis"])
    np.testing.assert_allclose(beside["scores"], with_replay.traces[alone]["scores"])


def test_a_plan_that_is_no_longer_kept_is_not_saved_without_a_word(with_replay, tmp_path):
    app = make_page(with_replay)
    shown = number_of(with_replay, State(0, 3, replay=True))
    folder = {"folder": str(tmp_path / "page")}
    assert ask(app, "saved.children", "save.n_clicks", **folder)["saved"]["children"] == "There is nothing to save yet."
    gone = "is no longer kept, as the last 16 are; plan it again."
    for one, two, which in ((shown + 1, None, "This plan"), (shown, shown + 1, "The held plan")):
        said = ask(app, "saved.children", "save.n_clicks", **folder, **{"trace-a": one, "trace-b": two})
        assert said["saved"]["children"] == f"{which} {gone}"
