"""What the inspector costs: every interaction of its page in a headless Chromium, planning anew, and traces.

    python benchmarks/inspector.py [--sizes NAME ...] [--repeats 5]

Drives the real page as a reader does, by keys and clicks, on walker-walk, served with all cores as the command does,
with networks of the preset's size that were not trained (what is drawn costs the same). An interaction lasts from its
event to the last change of the page, painted. On a busy machine that says as much about the others as about the page,
so beside the median seconds stand the CPU seconds of the page's main thread and of this process, which serves it, the
load, and how much of a core a busy loop of this process got. Needs Chromium and chromedriver; frames are rendered where
MUJOCO_GL, or EGL, can.
Writes `benchmarks/results/cpu/inspector.json`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ctypes.util import find_library
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl" if find_library("EGL") else "disable")  # before Python loads MuJoCo

import torch  # noqa: E402

from torchrl_etdmpc.envs import get_task  # noqa: E402
from torchrl_etdmpc.inspector.inspection import Inspection, State  # noqa: E402
from torchrl_etdmpc.inspector.page import make_page, serve  # noqa: E402
from torchrl_etdmpc.modules import WorldModel  # noqa: E402
from torchrl_etdmpc.runs import library_versions  # noqa: E402
from torchrl_etdmpc.training import build_agent, preset  # noqa: E402

TASK, SIZES_OF_WALKER, STEPS = "walker-walk", (24, 6), 6
RESULTS = Path(__file__).parent / "results" / "cpu" / "inspector.json"
LARGE = {"num_samples": 512, "num_elites": 64, "num_proposals": 24, "iterations": 8}
SIZES: dict[str, tuple[str, dict[str, int]]] = {
    "preset cpu": ("cpu", {}),
    "512 x 8": ("cpu", LARGE),  # candidates x iterations, networks of the preset cpu
    "full size": ("efficient-tdmpc", LARGE),  # networks of the thesis' size: plans and traces alone, which take long
}
QUIET_MS = 600  # without a change or a request after which an interaction is over
# Counts requests, and notes when the page last changed: after the browser has painted what changed.
WATCH = """
    const now = () => performance.now();
    window.watch = {last: now(), open: 0};
    const changed = () => requestAnimationFrame(() => setTimeout(() => { window.watch.last = now(); }));
    new MutationObserver(changed).observe(document.documentElement,
        {subtree: true, childList: true, attributes: true, characterData: true});
    const fetched = window.fetch;
    window.fetch = (...call) => {
        window.watch.open += 1;
        return fetched(...call).finally(() => { window.watch.open -= 1; window.watch.last = now(); });
    };
    for (const kind of ['keydown', 'click', 'input', 'pointerdown']) {
        document.addEventListener(kind, () => { window.watch.begun ??= now(); }, true);
    }
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    answer: dict[str, Any] = {"task": TASK, "cores": os.cpu_count(), "threads": torch.get_num_threads(), "sizes": {}}
    answer["versions"] = library_versions() | {name: version(name) for name in ("dash", "plotly", "selenium")}
    answer |= {"load_average_before": os.getloadavg(), "share_of_a_core": [share_of_a_core()]}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    for name in options.sizes:  # each is kept, the largest takes long
        answer["sizes"][name] = measured(name, options.repeats)
        answer["versions"] |= answer["sizes"][name].pop("versions")
        answer["share_of_a_core"].append(share_of_a_core())
        answer["load_average_after"] = os.getloadavg()
        options.out.write_text(json.dumps(answer, indent=1) + "\n")
        show(name, answer["sizes"][name])
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; {options.out}")


def share_of_a_core() -> float:
    """How much of a core a loop of a second gets, beside whatever else runs."""
    began, used = time.perf_counter(), time.process_time()
    while time.perf_counter() - began < 1:
        pass
    return round(time.process_time() - used, 3)


def measured(name: str, repeats: int) -> dict[str, Any]:
    preset_name, changes = SIZES[name]
    planner = untrained(preset_name, changes)
    inspection = Inspection(planner, get_task(TASK), steps=STEPS, bare=True)
    try:
        trace = inspection.plan(State(0, 0))  # plays and films the episode
        seconds, planned = [], []
        for step in range(1, 1 + repeats):
            began = time.perf_counter()
            trace = inspection.plan(State(0, step % STEPS))
            seconds.append(time.perf_counter() - began)
            planned.append(trace.manifest["seconds"])
        assert torch.from_numpy(trace["scores"][-1]).std() > 1e-3, "every candidate is as good: nothing to look at"
        with tempfile.TemporaryDirectory() as folder:
            size = trace.save(Path(folder) / "trace.npz").stat().st_size
            interactions, versions = {}, {}
            if name != "full size":
                with browser(Path(folder) / "browser") as driver:
                    interactions = by_hand(driver, inspection, Path(folder) / "page", repeats)
                    versions = {"chromium": driver.capabilities["browserVersion"]}
    finally:
        inspection.close()
    return {
        "repeats": repeats,
        "candidates": trace["scores"].shape[1],
        "iterations": trace.iterations,
        "horizon": trace.horizon,
        "heads": trace.num_dynamics,
        "planning_s": statistics.median(planned),
        "planning_and_simulating_s": statistics.median(seconds),
        "frames": trace.get("frames") is not None,
        "trace_mb": size / 1e6,
        "interactions": interactions,
        "versions": versions,
    }


def untrained(preset_name: str, changes: dict[str, int]) -> Any:
    """The preset's planner, over networks whose scores differ: new ones find every candidate equally good."""
    config = replace(preset(preset_name), task=TASK, compile="off")
    config = replace(config, planner=replace(config.planner, **changes))
    torch.manual_seed(0)
    planner = build_agent(config, *SIZES_OF_WALKER).eval_planner
    model = planner.world_model
    assert isinstance(model, WorldModel)
    for parameter in model.parameters():
        if parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=parameter.shape[-2] ** -0.5)
    return planner


@contextmanager
def browser(profile: Path) -> Iterator[Any]:
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    chromium, driver = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        sys.exit("error: needs chromium and chromedriver: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for option in (
        *("headless=new", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-sync"),
        *("disable-background-networking", "disable-component-update", "window-size=1280,1000"),
        f"user-data-dir={profile}",
    ):
        options.add_argument(f"--{option}")
    started = webdriver.Chrome(options=options, service=Service(driver))
    try:
        yield started
    finally:
        started.quit()


class Hand:
    """Does one thing on the page after another and notes what each took."""

    def __init__(self, driver: Any, repeats: int) -> None:
        self.driver, self.repeats = driver, repeats
        self.took: dict[str, dict[str, Any]] = {}
        driver.execute_cdp_cmd("Performance.enable", {"timeDomain": "threadTicks"})

    def page_cpu(self) -> float:
        """CPU seconds of the page's main thread so far."""
        metrics = self.driver.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]
        return next(entry["value"] for entry in metrics if entry["name"] == "TaskDuration")

    def settle(self) -> None:
        """Until nothing changes any more."""
        end = time.monotonic() + 300
        script = "return window.watch.open === 0 && performance.now() - window.watch.last > arguments[0]"
        while not self.driver.execute_script(script, QUIET_MS):
            assert time.monotonic() < end, "the page does not come to rest"
            time.sleep(0.1)

    def open(self, name: str, address: str) -> None:
        """Loads a page."""
        before, used = self.page_cpu(), time.process_time()
        self.driver.get(address)
        self.driver.execute_script(WATCH)
        self.settle()
        last, after = self.driver.execute_script("return window.watch.last / 1000"), self.page_cpu()
        if after < before:  # a page from elsewhere is another process of the browser
            before = 0.0
        self.note(name, [last], [after - before], [time.process_time() - used])

    def does(self, name: str, *acts: Callable[[], Any]) -> None:
        """Does the acts in turn, each followed by rest."""
        seconds, page, server = [], [], []
        for number in range(self.repeats):
            self.settle()
            self.driver.execute_script("window.watch.begun = null")
            before, used = self.page_cpu(), time.process_time()
            acts[number % len(acts)]()
            self.settle()
            took = self.driver.execute_script("return window.watch.last - window.watch.begun") / 1000
            seconds.append(took)
            page.append(self.page_cpu() - before)
            server.append(time.process_time() - used)
        self.note(name, seconds, page, server)

    def note(self, name: str, seconds: list[float], page: list[float], server: list[float]) -> None:
        self.took[name] = {
            "median_s": round(statistics.median(seconds), 3),
            "longest_s": round(max(seconds), 3),
            "page_cpu_s": round(statistics.median(page), 3),
            "server_cpu_s": round(statistics.median(server), 3),
        }

    def push(self, slider: str, key: str) -> Callable[[], None]:
        """A key on a slider's handle, or on the slider itself."""

        def act() -> None:
            control = self.driver.execute_script("return document.getElementById(arguments[0])", slider)
            handles = control.find_elements("css selector", "[role=slider]")
            (handles[0] if handles else control).send_keys(key)

        return act

    def press(self, name: str) -> Callable[[], None]:
        """A click on a button."""
        return lambda: self.driver.execute_script("document.getElementById(arguments[0]).click()", name)

    def choose(self, group: str, number: int) -> Callable[[], None]:
        """One of several choices."""
        script = "document.getElementById(arguments[0]).querySelectorAll('input')[arguments[1]].click()"
        return lambda: self.driver.execute_script(script, group, number)

    def click_candidates(self, name: str, side: str = "a") -> None:
        """Clicks candidates with the mouse, which is there before; the one that is shown already does not count."""
        from selenium.webdriver import ActionChains

        element = self.driver.find_element("id", f"latent_plane-{side}")
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
        repeats, self.repeats, noted = self.repeats, 1, []
        for point in element.find_elements("css selector", ".scatterlayer .trace path.point")[::5]:
            ActionChains(self.driver).move_to_element(point).perform()
            before = self.table(side)
            self.does(name, ActionChains(self.driver).click().perform)
            entry = self.took.pop(name)
            if self.table(side) != before:
                noted.append(entry)
            if len(noted) == repeats:
                break
        assert len(noted) == repeats, "too few clicks reached a candidate"
        self.repeats = repeats
        self.note(name, *([entry[key] for entry in noted] for key in ("median_s", "page_cpu_s", "server_cpu_s")))

    def table(self, side: str) -> str:
        """The title of the return table, which names the candidate."""
        script = """
            const graph = document.getElementById(arguments[0]);
            return (graph.layout || graph.querySelector('.js-plotly-plot').layout).title.text"""
        return self.driver.execute_script(script, f"return_table-{side}")


def by_hand(driver: Any, inspection: Inspection, folder: Path, repeats: int) -> dict[str, dict[str, Any]]:
    """Every interaction of the page, and of the page that it saves."""
    from selenium.webdriver.common.keys import Keys

    started = threading.Event()
    found: list[Any] = []

    def ready(*served: Any) -> None:
        found.extend(served)
        started.set()

    app = make_page(inspection, folder=folder)
    thread = threading.Thread(target=serve, args=(app,), kwargs={"port": 0, "ready": ready})
    thread.start()
    assert started.wait(60)
    address, stop = found
    hand = Hand(driver, repeats)
    try:
        hand.open("the page opens", address)
        back_and_on = (Keys.ARROW_LEFT, Keys.ARROW_RIGHT)

        def scrubs(beside: str = "") -> None:
            hand.does("an iteration is scrubbed" + beside, *(hand.push("iteration", key) for key in back_and_on))
            hand.click_candidates("a candidate is clicked" + beside)

        scrubs()
        hand.press("unclick")()
        hand.settle()
        hand.does("another depth", *(hand.push("depth", key) for key in back_and_on))
        hand.does("other components", *(hand.choose("components", number) for number in (1, 2, 0)))
        hand.does("another step of the episode", *(hand.push("step", key) for key in reversed(back_and_on)))
        setting = '{"name":"inverse_temperature","type":"setting"}'
        hand.does("a setting is moved", *(hand.push(setting, key) for key in back_and_on))
        hand.does("a plan is held, and let go", hand.press("hold"), hand.press("release"))
        hand.press("hold")()
        hand.settle()
        hand.does("a setting is moved beside a held plan", *(hand.push(setting, key) for key in back_and_on))
        scrubs(" beside a held plan")
        hand.does("the theme", hand.press("theme"))
        hand.does("the page is saved", hand.press("save"))
        assert (folder / "index.html").exists()
        hand.open("a saved page opens", (folder / "index.html").as_uri())
        hand.does("an iteration is scrubbed in it", *(hand.push("iteration", key) for key in back_and_on))
        hand.click_candidates("a candidate is clicked in it")
    finally:
        stop()
        thread.join()
    hand.took["the page is saved"]["mb"] = round(sum(file.stat().st_size for file in folder.iterdir()) / 1e6, 1)
    return hand.took


def show(name: str, found: dict[str, Any]) -> None:
    print(
        f"{name}: {found['candidates']} candidates x {found['iterations']} iterations, {found['heads']} heads; a plan "
        f"{found['planning_s']:.3f} s, in the simulator {found['planning_and_simulating_s']:.3f} s; a trace "
        f"{found['trace_mb']:.2f} MB"
    )
    if not found["interactions"]:
        return
    print("| interaction | median s | longest s | CPU s of the page | of the server |\n|---|---|---|---|---|")
    for what, took in found["interactions"].items():
        numbers = (took[key] for key in ("median_s", "longest_s", "page_cpu_s", "server_cpu_s"))
        print(f"| {what} | {' | '.join(f'{number:.2f}' for number in numbers)} |")


if __name__ == "__main__":
    main()
