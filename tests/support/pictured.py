"""Takes the pictures of the page in the documents: the running chain in Debian's Chromium, with an occluder before the arm.

    python -m penumbra.tests.support.pictured --cell arm --out docs/pictures

All that is shown comes from the chain. Chromium draws the scene without a graphics card and would take every processor: it gets
what the chain leaves, and the scene moves at a quarter of its speed.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

from playwright.sync_api import Page, sync_playwright

from penumbra.services import flags
from penumbra.tests.support.live import free_port, penumbra_up, wait_for

GL = ("--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
VIEWS: dict[str, tuple[int, Literal["light", "dark"]]] = {
    "dashboard": (1280, "light"),
    "dashboard-dark": (1280, "dark"),
    "dashboard-360": (360, "dark"),
}
"""Names of the pictures, with their widths [px] and colour schemes."""
SPEED, OCCLUSION = 0.25, 0.4
PATIENCE_S = 180.0
HIDDEN = (0.2, 0.6)
"""Bounds of the share of the arm that is hidden in the pictures."""
CHARTS_S, SETTLE_S = 90.0, 3.0
"""Times [s] for which the charts fill before the first picture, and for which the page settles after a change of its width."""
SHOWS = """
document.querySelector('#pose-state').dataset.state === 'tracking'
&& document.querySelectorAll('#process-rows tr').length >= 8
&& /pictures/.test(document.querySelector('#picture-rate').textContent)
&& /frames/.test(document.querySelector('#scene-rate').textContent)
"""


def is_partly_hidden(page: Page) -> bool:
    """Whether the page shows a tracked pose of an arm of which a part is hidden."""
    text = page.inner_text("#hidden-now")
    return bool(page.evaluate(SHOWS)) and text.endswith("%") and HIDDEN[0] < int(text.split()[0]) / 100 < HIDDEN[1]


def main() -> None:
    """Takes the pictures of a cell."""
    out = flags.Option("--out", type=Path, default=Path("docs/pictures"), help="folder of the pictures")
    options = flags.parse((flags.CELL, out, flags.Option("--seed", type=int, default=1, help="of the emulator")), sys.argv[1:])
    port = free_port()
    with ExitStack() as stack:
        running = stack.enter_context(penumbra_up(options.cell, options.seed, "--page", str(port), "--log-level", "error"))
        wait_for(running.is_tracking, PATIENCE_S, "a tracked pose", 0.5)
        wait_for(lambda: running.control({"command": "speed", "value": SPEED}), 10, "the emulator's answer")
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))  # the browser inherits it
        driver = stack.enter_context(sync_playwright())
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=[*GL], timeout=1e3 * PATIENCE_S)
        page = browser.new_page(viewport={"width": 1280, "height": 800}, reduced_motion="reduce")
        page.goto(f"http://127.0.0.1:{port}/", wait_until="commit", timeout=1e3 * PATIENCE_S)
        running.control({"command": "occlude", "value": OCCLUSION})
        time.sleep(CHARTS_S)
        for name, (width, scheme) in VIEWS.items():
            page.set_viewport_size({"width": width, "height": 800})
            page.emulate_media(color_scheme=scheme)
            time.sleep(SETTLE_S)
            wait_for(lambda: is_partly_hidden(page), PATIENCE_S, "a tracked arm that is partly hidden", 0.1)
            page.screenshot(path=str(options.out / f"{name}.png"), full_page=True, timeout=1e3 * PATIENCE_S)
        browser.close()


if __name__ == "__main__":
    main()
