"""A real headless Chromium for tests of pages.

Chromium and its driver are Debian's (`apt-get install chromium chromium-driver`); without them these tests fail where
CI is set and are skipped elsewhere. FIELDCAL_SCREENSHOTS names a folder that keeps the screenshots.
"""

from __future__ import annotations

import base64
import io
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is part of the extra `test`")

SWITCHES = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--window-size=1280,900",
)
WIDER_THAN_THE_WINDOW = "return document.documentElement.scrollWidth - window.innerWidth;"


def found(name: str) -> str:
    """Path of a program; without it the test fails under CI and is skipped elsewhere."""
    path = shutil.which(name)
    if path is None:
        why = f"{name} is not installed: apt-get install chromium chromium-driver"
        pytest.fail(why) if os.environ.get("CI") else pytest.skip(why)
    return path


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    options = webdriver.ChromeOptions()
    options.binary_location = found("chromium")
    for switch in (*SWITCHES, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(switch)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(found("chromedriver")))
    yield driver
    driver.quit()


DRAWN = "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(done))"


def show(browser: Any, path: Path | str, scheme: str = "light") -> None:
    """Open a page in a colour scheme, and wait for its first frame: on a busy machine it is loaded some time before,
    and nothing of it is visible then."""
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "screen", "features": features})
    browser.get(path if isinstance(path, str) else path.as_uri())
    browser.execute_async_script(DRAWN)


def picture(browser: Any, name: str) -> np.ndarray:
    """The whole page as (height, width, 3) levels 0–255."""
    from PIL import Image

    size = browser.execute_cdp_cmd("Page.getLayoutMetrics", {})["cssContentSize"]
    clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
    shot = browser.execute_cdp_cmd("Page.captureScreenshot", {"captureBeyondViewport": True, "clip": clip})
    png = base64.b64decode(shot["data"])
    if folder := os.environ.get("FIELDCAL_SCREENSHOTS"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        (Path(folder) / f"{name}.png").write_bytes(png)
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(float)
