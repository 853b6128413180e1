"""A headless Chromium, driven by Playwright, and its pages of the player. PD4DGS_BROWSER names it, else one of BROWSERS
is looked for."""

from __future__ import annotations

import base64
import contextlib
import io
import os
import shutil
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from common import ROOT

from pd4dgs_codec.errors import DataError

PLAYER = ROOT / "player"

#: The first draws the same pictures with a fifth less work: it is Chromium without windows.
BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = [
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--js-flags=--expose-gc",
    "--enable-precise-memory-info",
]
#: A busy machine may take long over a picture; only a hang takes this long, milliseconds.
TIMEOUT_MS = 120_000
POLL_MS = 50
#: Other viewers, by the name of their harness in player/test-browser/, and what it imports of player/node_modules.
VIEWERS = {
    "spark": ("three", "@sparkjsdev/spark"),
    "playcanvas": ("playcanvas",),
    "supersplat": ("playcanvas", "@playcanvas/supersplat-viewer"),
}
#: The element of a page.
ELEMENT = "document.querySelector('pd4-player')"


@contextlib.contextmanager
def launched() -> Iterator[Any]:
    """A headless browser as Playwright sees it. DataError without one, or without Playwright."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise DataError("playwright is not installed (pip install playwright)") from None
    named = os.environ.get("PD4DGS_BROWSER")
    found = shutil.which(named) if named else next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        raise DataError(f"found no browser, expected {named or ' or '.join(BROWSERS)} (PD4DGS_BROWSER names one)")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=FLAGS)
        yield browser
        browser.close()


def check_packages(*viewers: str) -> None:
    """Raises DataError if a package is not installed that these of VIEWERS need."""
    for viewer in viewers:
        for name in VIEWERS[viewer]:
            if not (PLAYER / "node_modules" / name).is_dir():
                raise DataError(f"{viewer}: {name} is not installed (npm install --no-package-lock in player/)")


def call(page: Any, script: str, *args: Any) -> Any:
    """The result of a function, given as JavaScript, in a page."""
    return page.evaluate(f"(args) => ({script})(...args)", list(args))


def wait_for_level(page: Any, level: int) -> None:
    """Until the element of a page shows a level."""
    until(page, f"{ELEMENT}?.player?.status.level === {level}")


def until(page: Any, expression: str, timeout_ms: float = TIMEOUT_MS) -> None:
    """Until an expression holds in a page. Playwright's own wait evaluates it there, which policies of pages forbid."""
    deadline = time.monotonic() + timeout_ms / 1000
    while not page.evaluate(expression):
        if time.monotonic() > deadline:
            raise TimeoutError(expression)
        page.wait_for_timeout(POLL_MS)


def pixels(text: str, width: int, height: int) -> np.ndarray:
    """uint8 [H, W, 3] of a harness's picture."""
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(height, width, 4)[..., :3]


def screenshot(page: Any) -> np.ndarray:
    """uint8 [H, W, 3] of what a page shows once nothing of it fades in or out."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(page.screenshot(animations="disabled"))).convert("RGB"))


def eyes_of_headset(page: Any, width: int, height: int) -> np.ndarray:
    """uint8 [H, W, 3]: the settled picture of the emulated headset (player/test-browser/headset.js), both eyes beside
    each other, after a click on the element's button."""
    page.locator("pd4-player").get_by_role("button", name="Show in the headset").click()
    page.wait_for_function(f"headset.frames && {ELEMENT}.player._isEvaluated() && {ELEMENT}.player._isSorted()")
    drawn = page.evaluate("headset.frames")
    page.wait_for_function("(drawn) => headset.frames > drawn + 1", arg=drawn)
    return pixels(page.evaluate("headset.read()"), width, height)
