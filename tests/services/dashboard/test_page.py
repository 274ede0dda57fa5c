"""The page in a real browser: Debian's Chromium, without a screen, driven by playwright. Skipped where it is not installed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from penumbra.shared.geometry import rigid
from penumbra.tests.services.dashboard.conftest import Served
from penumbra.tests.support.live import PATIENCE_S, wait_for

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytest.importorskip("playwright", reason="playwright is not installed: pip install -e '.[test]'")
from playwright import sync_api  # noqa: E402 (only where it is installed)

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")

ALWAYS = ("--no-sandbox", "--disable-dev-shm-usage")
WITH_GL = (*ALWAYS, "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
WITHOUT_GL = (*ALWAYS, "--disable-gpu", "--disable-3d-apis")
LONG_MS = 3e3 * PATIENCE_S
"""A software renderer on a busy machine takes its time, and a deadline that is not reached costs nothing."""
PICTURES = Path(os.environ.get("PENUMBRA_PICTURES", "/nowhere"))
"""Where screenshots go, to be looked at."""


@pytest.fixture(scope="module")
def driver() -> Iterator[sync_api.Playwright]:
    with sync_api.sync_playwright() as started:
        yield started


class Tab:
    """The page in a browser of its own, and what went wrong in it."""

    def __init__(self, browser, url: str, width: int, scheme: str):
        self.context = browser.new_context(viewport={"width": width, "height": 800}, color_scheme=scheme, reduced_motion="reduce")
        self.page = self.context.new_page()
        self.page.set_default_timeout(LONG_MS)
        self.faults: list[str] = []
        self.requests: list[str] = []
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("console", lambda said: self.faults.append(said.text) if said.type == "error" else None)
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(url, wait_until="commit", timeout=LONG_MS)
        self.wait("document.querySelector('#link')?.dataset.state === 'open'")

    def wait(self, condition: str) -> None:
        """Waits here: what waits in the page is made of texts, which the page's policy does not let run."""
        wait_for(lambda: self.page.evaluate(condition), LONG_MS / 1e3, condition, 0.1)

    def text(self, selector: str) -> str:
        return self.page.inner_text(selector)

    def keep(self, name: str) -> None:
        if PICTURES.is_dir():
            self.page.screenshot(path=str(PICTURES / f"{name}.png"), full_page=True)


@pytest.fixture(scope="module")
def browsers(driver) -> Iterator[Callable[[tuple[str, ...]], sync_api.Browser]]:
    """A browser with these flags; each is started once."""
    started: dict[tuple[str, ...], sync_api.Browser] = {}

    def browser(flags: tuple[str, ...]) -> sync_api.Browser:
        if flags not in started:
            started[flags] = driver.chromium.launch(executable_path=CHROMIUM, args=[*flags], timeout=LONG_MS)
        return started[flags]

    yield browser
    for each in started.values():
        each.close()


@pytest.fixture
def open_tab(browsers, served: Served):
    opened = []

    def open_it(width: int = 1280, scheme: str = "light", flags=WITHOUT_GL) -> Tab:
        opened.append(Tab(browsers(flags), served.url, width, scheme))
        return opened[-1]

    yield open_it
    for tab in opened:
        tab.context.close()


SHOWS = """
document.querySelector('#pose-state').dataset.state === 'tracking'
&& document.querySelectorAll('#process-rows tr').length >= 6
&& document.querySelectorAll('#pad-list li').length === 8
&& /pictures/.test(document.querySelector('#picture-rate').textContent)
&& !/–/.test(document.querySelector('#error-now').textContent)
"""
LIT = """[...document.querySelector('#space').parentElement.querySelectorAll('canvas')].length === 1
&& /frames/.test(document.querySelector('#scene-rate').textContent)"""


def test_the_page_shows_the_cell_without_errors_and_asks_nobody_else(open_tab, served: Served):
    tab = open_tab(flags=WITH_GL)
    tab.wait(SHOWS)
    tab.wait(LIT)
    colours = tab.page.evaluate(
        "() => { const c = document.querySelector('#picture');"
        "return new Set(c.getContext('2d').getImageData(0, 0, c.width, c.height).data).size }"
    )
    assert colours > 20, "the picture is painted"
    assert tab.page.get_by_role("button", name="Restart fusion").count() == 1
    assert all(url.startswith((served.url, served.url.replace("http", "ws"), "data:", "blob:")) for url in tab.requests)
    tab.keep("1280-light")
    assert not tab.faults


MOVED = """async ([link, q]) => {
    const { Group } = await import("./vendor/three.module.js"), { move } = await import("./scene.js");
    const group = new Group();
    for (const each of [2, q]) move(group, link, each);
    group.updateMatrix();
    return group.matrix.elements;
}"""


def test_a_joint_moves_its_link_on_the_page_as_in_the_robot(open_tab):
    """A joint that turns and one that slides, by the page's own functions."""
    rng = np.random.default_rng(8)
    turn, offset, axis, q = rng.normal(size=3), rng.normal(size=3), np.array([0.6, 0.0, 0.8]), 0.7
    position, orientation = rigid.position_orientation(rigid.perturb(np.eye(4), np.concatenate([offset, turn])))
    for slides in (False, True):
        link = {"pose": [*position.tolist(), *orientation.tolist()], "axis": axis.tolist(), "slides": slides}
        found = open_tab().page.evaluate(MOVED, [link, q])
        along = np.concatenate([q * axis, np.zeros(3)] if slides else [np.zeros(3), q * axis])
        expected = rigid.transform(position, orientation) @ rigid.perturb(np.eye(4), along)
        np.testing.assert_allclose(np.reshape(found, (4, 4)).T, expected, atol=1e-12)


@pytest.mark.parametrize("flags", [WITH_GL, WITHOUT_GL], ids=["webgl", "no-webgl"])
def test_the_page_fits_a_telephone(open_tab, flags):
    tab = open_tab(360, "dark", flags)
    tab.wait(SHOWS)
    assert tab.page.evaluate("document.documentElement.scrollWidth") == 360
    assert tab.page.locator("#no-webgl").is_visible() == (flags is WITHOUT_GL)
    assert tab.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(14, 17, 22)", "the dark scheme"
    tab.keep("360-dark" if flags is WITH_GL else "360-dark-no-webgl")
    if flags is WITH_GL:
        assert not tab.faults


def test_the_page_works_with_a_keyboard_alone_and_keeps_the_focus(open_tab, served: Served):
    tab = open_tab()
    tab.wait(SHOWS)
    tab.wait("!document.querySelector('#occlusion').disabled")
    reached = []
    for _ in range(40):
        tab.page.keyboard.press("Tab")
        reached.append(tab.page.evaluate("document.activeElement.id || document.activeElement.getAttribute('aria-label') || ''"))
    assert {"show-mask", "show-outline", "occlusion", "occlusion-auto", "speed", "motion", "pause", "events"} <= set(reached)
    tab.page.focus("#occlusion")
    outline = tab.page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
    assert outline == "solid", "the focus is seen"
    before = served.shown.hidden
    tab.page.keyboard.press("Home")  # a slider that is at its end says nothing of a key to there
    tab.page.keyboard.press("End")
    wait_for(lambda: served.shown.hidden == 1.0 or tab.text("#steer-said"), 60, "the emulator to hide the arm")
    assert tab.text("#steer-said") == ""
    # a second of updates of the tables
    number = tab.page.evaluate("document.querySelector('#steer-now').textContent")
    tab.wait(f"document.querySelector('#steer-now').textContent !== {number!r}")
    assert tab.page.evaluate("document.activeElement.id") == "occlusion"
    tab.page.keyboard.press("Home")
    wait_for(lambda: served.shown.hidden == 0.0, 60, "the emulator to show the arm")
    served.shown.hidden = before


def test_a_lost_pose_is_said_in_words_with_its_reason(open_tab, served: Served):
    tab = open_tab()
    tab.wait(SHOWS)
    served.shown.hidden, served.shown.feels = 0.92, False
    try:
        tab.wait("document.querySelector('#announce').textContent === 'forearm: lost'")
        tab.wait("/92% hidden/.test(document.querySelector('#pose-why').textContent)")
        tab.wait("/nothing in range/.test(document.querySelector('#events li .why').textContent)")
        tab.keep("1280-lost-no-webgl")
    finally:
        served.shown.hidden, served.shown.feels = 0.1, True
    tab.wait("document.querySelector('#announce').textContent === 'forearm: tracking'")


def test_a_page_elsewhere_in_the_browser_gets_nothing(open_tab, served: Served):
    """A page of another origin, in the same browser, with all that JavaScript can do."""
    tab = open_tab()
    other = tab.context.new_page()
    other.route("http://evil.example/", lambda route: route.fulfill(body="<h1>hello</h1>", content_type="text/html"))
    other.goto("http://evil.example/")
    found = other.evaluate(
        """async (ours) => {
            const blind = '{"command":"occlude","value":1}';
            const json = { "Content-Type": "application/json" };
            const tries = {
                key: () => fetch(`${ours}key`, { method: "POST" }).then((answer) => answer.json()),
                blind: () => fetch(`${ours}emulator`, { method: "POST", mode: "no-cors", body: blind })
                    .then((answer) => answer.text()).then((text) => text || Promise.reject("nothing to read")),
                steer: () => fetch(`${ours}restart`, { method: "POST", headers: json, body: '{"service":"fusion"}' }),
                look: () => fetch(`${ours}scene`).then((answer) => answer.arrayBuffer()),
                socket: () => new Promise((resolve, reject) => {
                    const socket = new WebSocket(`${ours.replace("http", "ws")}socket`);
                    socket.onopen = () => resolve("open");
                    socket.onerror = () => reject("refused");
                }),
                frame: () => new Promise((resolve, reject) => {
                    const frame = document.createElement("iframe");
                    frame.src = ours;
                    frame.onload = () => (frame.contentDocument === null ? reject("not ours to see") : resolve("framed"));
                    document.body.append(frame);
                }),
            };
            const out = {};
            for (const [name, attempt] of Object.entries(tries)) {
                out[name] = await attempt().then(() => "worked", () => "refused");
            }
            return out;
        }""",
        served.url,
    )
    assert found == dict.fromkeys(["key", "blind", "steer", "look", "socket", "frame"], "refused")
    assert served.shown.hidden == 0.1
