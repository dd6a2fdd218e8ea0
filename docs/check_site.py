"""Walks through the built site in a headless Chromium, as a reader on a phone and at a desk would.

    python docs/check_site.py build/docs/html [--screenshots FOLDER]

Every page, made 390 and 1280 pixels wide: nothing on the console, no request to another host, every image there,
nothing wider than the window, every link within the site leads somewhere, and a block of code is copied by its button.
The API pages hold every public name. Without a Chromium it says so and checks names and links alone.
"""

from __future__ import annotations

import argparse
import functools
import html.parser
import http.server
import importlib
import json
import os
import shutil
import sys
import tempfile
import threading
import urllib.parse
from pathlib import Path

WIDTHS = (390, 1280)
FLAGS = (
    "--headless=new --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --hide-scrollbars"
)


class _Links(html.parser.HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if value and (name == "id" or (tag == "a" and name == "name")):
                self.anchors.add(value)
            if value and tag in ("a", "img", "script", "link", "source", "object") and name in ("href", "src", "data"):
                self.links.append(value)


def pages_of(site: Path) -> list[Path]:
    """Every page of the site."""
    return sorted(path for path in site.rglob("*.html") if "_static" not in path.parts)


def dead_links(site: Path) -> list[str]:
    """Links within the site that lead nowhere."""
    read = {}
    for page in pages_of(site):
        read[page.resolve()] = parser = _Links()
        parser.feed(page.read_text(encoding="utf-8"))
    faults = []
    for page, parser in read.items():
        for link in parser.links:
            parts = urllib.parse.urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (page.parent / urllib.parse.unquote(parts.path)).resolve() if parts.path else page
            if not target.is_file():
                faults.append(f"{page.relative_to(site.resolve())}: {link} leads nowhere")
            elif parts.fragment and target in read and urllib.parse.unquote(parts.fragment) not in read[target].anchors:
                faults.append(f"{page.relative_to(site.resolve())}: {link} has no such place")
    return faults


def undocumented(site: Path) -> list[str]:
    """Public names that the API pages do not hold, and names there that are not public."""
    import generate

    faults = []
    for room in generate.ROOMS:
        module = importlib.import_module(f"torchrl_etdmpc.{room}")
        parser = _Links()
        parser.feed((site / "docs" / "generated" / "api" / f"{room}.html").read_text(encoding="utf-8"))
        prefix = f"{module.__name__}."
        shown = {anchor.removeprefix(prefix) for anchor in parser.anchors if anchor.startswith(prefix)}
        top = {name for name in shown if "." not in name}
        missing = set(module.__all__) - top
        home = {name for name in missing if not getattr(getattr(module, name), "__module__", prefix).startswith(prefix)}
        faults += [f"{prefix}{name} is public and not documented" for name in sorted(missing - home)]
        faults += [f"{prefix}{name} is documented and not public" for name in sorted(top - set(module.__all__))]
    return faults


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *args: object) -> None:
        pass


def _serve(site: Path) -> http.server.ThreadingHTTPServer:
    handler = functools.partial(_Quiet, directory=str(site))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server


def _driver(profile: str):
    from selenium import webdriver
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    options = Options()
    options.binary_location = str(_chromium())
    for flag in (*FLAGS.split(), f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    return webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))


def _chromium() -> str | None:
    found = (shutil.which(name) for name in ("chromium", "chromium-browser", "google-chrome"))
    return next(filter(None, found), None)


LOOK = """
const width = document.documentElement.clientWidth;  // a phone's innerWidth grows with what is too wide
const wide = document.documentElement.scrollWidth - width;
const missing = image => !image.complete || image.naturalWidth === 0;
const images = [...document.images].filter(missing).map(image => image.src);
let widest = '';
if (wide > 0) {
  for (const element of document.querySelectorAll('article *')) {
    const right = element.getBoundingClientRect().right;
    if (right > width + 1 && !element.closest('.table-wrapper, pre, .formula'))
      { widest = element.tagName + '.' + element.className + ' ' + element.textContent.slice(0, 40); break; }
  }
}
return {wide: wide, widest: widest, images: images};
"""
COPY = """
const button = document.querySelector('button.copybtn');
if (!button) return null;
let copied = null;
navigator.clipboard.writeText = text => { copied = text; return Promise.resolve(); };
document.execCommand = command => { copied = document.getSelection().toString() || 'copied'; return true; };
button.click();
return copied;
"""


def walk(site: Path, screenshots: Path | None = None) -> list[str]:
    """What is wrong with the pages as a browser shows them."""
    faults = []
    server = _serve(site)
    base = f"http://127.0.0.1:{server.server_port}/"
    copied = 0
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        driver = _driver(profile)
        try:
            for page in pages_of(site):
                name = str(page.relative_to(site))
                driver.get(base + urllib.parse.quote(name))
                for width in WIDTHS:
                    driver.execute_cdp_cmd(
                        "Emulation.setDeviceMetricsOverride",
                        {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600},
                    )
                    seen = driver.execute_script(LOOK)
                    where = f"{name} at {width}"
                    if seen["wide"] > 0:
                        faults.append(f"{where}: {seen['wide']} px wider than the window ({seen['widest']})")
                    faults += [f"{where}: {image} does not load" for image in seen["images"]]
                    if driver.execute_script("return document.querySelector('button.copybtn') !== null"):
                        if driver.execute_script(COPY):
                            copied += 1
                        else:
                            faults.append(f"{where}: the button copies nothing")
                    if screenshots is not None:
                        screenshots.mkdir(parents=True, exist_ok=True)
                        target = screenshots / f"{width}-{name.replace('/', '_')}.png"
                        driver.save_screenshot(str(target))
                faults += [f"{name}: {entry['message']}" for entry in driver.get_log("browser")]
                for entry in driver.get_log("performance"):
                    message = json.loads(entry["message"])["message"]
                    if message["method"] == "Network.requestWillBeSent":
                        url = message["params"]["request"]["url"]
                        if not url.startswith((base, "data:", "about:", "chrome", "blob:")):
                            faults.append(f"{name}: asks for {url}")
        finally:
            driver.quit()
            server.shutdown()
            server.server_close()
    if not copied:
        faults.append("no block of code can be copied")
    return faults


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("site", type=Path)
    parser.add_argument("--screenshots", type=Path, help="a folder for a picture of every page and width")
    options = parser.parse_args()
    faults = [*dead_links(options.site), *undocumented(options.site)]
    browser = _chromium() is not None and shutil.which("chromedriver") is not None
    if browser:
        faults += walk(options.site, options.screenshots)
    print("\n".join(faults) if faults else f"{len(pages_of(options.site))} pages: names and links are whole")
    print(
        "walked through in Chromium" if browser else "not walked through: there is no chromium with chromedriver here"
    )
    sys.exit(bool(faults))


if __name__ == "__main__":
    os.environ.setdefault("MUJOCO_GL", "disable")
    sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent / "src")]
    main()
