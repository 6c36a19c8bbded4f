"""The three reports in a real headless Chromium: no console errors, no request, plots that are there, light and dark,
keyboard and print.

FIELDCAL_SCREENSHOTS names a folder that keeps the screenshots.
"""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser_support import WIDER_THAN_THE_WINDOW, browser, picture, show
from outside_ci import outside_ci
from report_rows import publish_fleet

from fieldcal.flight.calibrate import identify, read, run_stages
from fieldcal.report import log_report, write_night_reports
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment

__all__ = ["browser"]  # a fixture

PLOTS = {"fleet": 5, "vehicle": 6, "flight": 9}
"""Drawings open on each page: sparklines; scale and zero_bias of three sensors; Figures 5–10 and three more."""

LEAST_CONTRAST = 4.5  # WCAG 2.1, level AA, for text
LEAST_INK = 20.0  # levels of 255 that a pixel differs from the paper

VISIBLE_PLOTS = """
return [...document.querySelectorAll('svg')].filter(svg => svg.checkVisibility()).map(svg => {
  const box = svg.getBoundingClientRect();
  const inked = [...svg.querySelectorAll('path, polyline, circle, use, text')].filter(e => {
    const own = e.getBoundingClientRect(), style = getComputedStyle(e);
    return own.width + own.height > 0 && (style.stroke !== 'none' || style.fill !== 'none');
  });
  return {width: box.width, height: box.height, inked: inked.length,
          named: !!(svg.getAttribute('aria-label') || svg.querySelector('title')?.textContent)};
});
"""
FOCUS = "const e = document.activeElement; return [e.tagName, e.textContent.trim(), getComputedStyle(e).outlineStyle];"


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("data")
    publish_fleet(
        root, {"alpha": "stable", "bravo": "step", "charlie": "drifting", "delta": "outlier", "echo": "insufficient"}
    )
    fleet, vehicle = write_night_reports(root, ["bravo"])
    (log,) = write_flights(root / "archive", Experiment(seed=4, dip_rad=np.radians(60.0), translation_rms_mps2=0.03))
    return {
        "fleet": fleet,
        "vehicle": vehicle,
        "flight": log_report(run_stages(read(*identify(log))), root / "flight.html"),
    }


@pytest.mark.parametrize("page", PLOTS)
def test_page_is_quiet_offline_and_drawn(browser: Any, pages: dict[str, Path], page: str) -> None:
    show(browser, pages[page])
    assert browser.get_log("browser") == []
    assert browser.execute_script("return performance.getEntriesByType('resource').map(e => e.name)") == []
    plots = browser.execute_script(VISIBLE_PLOTS)
    assert len(plots) >= PLOTS[page]
    for plot in plots:
        assert plot["width"] > 50
        assert plot["height"] > 20
        assert plot["inked"] >= 2
        assert plot["named"]
    assert browser.execute_script(WIDER_THAN_THE_WINDOW) <= 0


@outside_ci
@pytest.mark.parametrize("page", PLOTS)
def test_light_and_dark_differ_in_colour_only(browser: Any, pages: dict[str, Path], page: str) -> None:
    pictures = {}
    for scheme in ("light", "dark"):
        show(browser, pages[page], scheme)
        pictures[scheme] = picture(browser, f"{page}-{scheme}")
    light, dark = pictures["light"], pictures["dark"]
    assert light.shape == dark.shape
    assert np.median(light) > 230
    assert np.median(dark) < 50
    # what is drawn on the light page is drawn on the dark one: neither has ink in its paper's colour
    inked = [np.abs(p - np.median(p, axis=(0, 1))).max(axis=2) > LEAST_INK for p in (light, dark)]
    assert inked[0].mean() == pytest.approx(inked[1].mean(), rel=0.35)


def test_keyboard_reaches_content_and_links_with_a_visible_focus(browser: Any, pages: dict[str, Path]) -> None:
    from selenium.webdriver.common.keys import Keys

    show(browser, pages["fleet"])
    body = browser.find_element("tag name", "body")
    body.send_keys(Keys.TAB)
    tag, text, outline = browser.execute_script(FOCUS)
    assert (tag, text) == ("A", "Skip to the content")
    assert outline != "none"
    browser.switch_to.active_element.send_keys(Keys.ENTER)
    assert browser.execute_script("return document.activeElement.id") == "content"
    browser.switch_to.active_element.send_keys(Keys.TAB)
    assert browser.execute_script("return document.activeElement.getAttribute('role')") == "region"
    browser.switch_to.active_element.send_keys(Keys.TAB)
    tag, text, outline = browser.execute_script(FOCUS)
    assert (tag, text) == ("A", "bravo")
    assert outline != "none"
    browser.switch_to.active_element.send_keys(Keys.ENTER)
    assert browser.title == "Vehicle bravo"


def test_page_prints_on_white_paper_from_dark(browser: Any, pages: dict[str, Path]) -> None:
    show(browser, pages["vehicle"], "dark")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    colour = "return getComputedStyle(document.body).backgroundColor"
    assert browser.execute_script(colour) == "rgb(255, 255, 255)"
    assert not browser.find_element("tag name", "nav").is_displayed()
    pdf = base64.b64decode(browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})["data"])
    assert pdf.startswith(b"%PDF")
    assert len(re.findall(rb"/Type\s*/Page\b", pdf)) >= 3


def test_narrow_screen_scrolls_tables_not_the_page(browser: Any, pages: dict[str, Path]) -> None:
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride", {"width": 400, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    )
    try:
        for path in pages.values():
            show(browser, path)
            assert browser.execute_script(WIDER_THAN_THE_WINDOW) <= 0
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_texts_stand_out_from_their_paper() -> None:
    """WCAG contrast of the style sheet's own colours, light, dark and print."""
    css = (Path(__file__).parents[2] / "fieldcal/report/templates/style.css").read_text(encoding="utf-8")
    light, dark, paper = (
        dict(re.findall(r"--([\w-]+): (#\w{6});", block)) for block in re.findall(r":root \{.*?\}", css, re.S)
    )
    for colours in (light, {**light, **dark}, {**light, **paper}):
        for text in ("fg", "muted", "link", "c1", "c2", "c3", "c4", "warn"):
            for ground in ("bg", "panel"):
                assert contrast(colours[text], colours[ground]) >= LEAST_CONTRAST, (text, ground)
        for kind in ("ok", "look", "bad", "none"):
            assert contrast(colours[f"{kind}-fg"], colours[f"{kind}-bg"]) >= LEAST_CONTRAST, kind


def contrast(a: str, b: str) -> float:
    """WCAG 2.1 contrast ratio of two sRGB colours."""
    high, low = sorted((luminance(a), luminance(b)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def luminance(colour: str) -> float:
    """WCAG 2.1 relative luminance of #rrggbb."""
    level = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])
