"""A headless Chromium, driven by Playwright. PD4DGS_BROWSER names it, else one of BROWSERS is looked for."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from typing import Any

from pd4dgs_codec.errors import DataError

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
PATIENCE_MS = 120_000


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
        raise DataError(f"there is no browser {named or ' or '.join(BROWSERS)} (PD4DGS_BROWSER names one)")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=FLAGS)
        yield browser
        browser.close()
