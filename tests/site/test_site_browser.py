"""The site in a real headless Chromium, from a disk and from a web server: sort, search, filter, zoom, values under the
pointer and by keyboard, comparing, downloads, light, dark, phone, print, and axe's accessibility check.

axe-core 4.14.1 (MPL-2.0) lies in tests/site/axe as its package has it; it is no part of fieldcal.
"""

from __future__ import annotations

import base64
import csv
import functools
import hashlib
import http.server
import json
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from browser_support import WIDER_THAN_THE_WINDOW, browser, picture, show
from history_rows import flight
from report_rows import publish_fleet

from fieldcal.batch.flights import one_flight
from fieldcal.batch.night import plan_night, publishings
from fieldcal.config.configuration import Alerts
from fieldcal.report.fitness import Criteria
from fieldcal.report.links import flight_name
from fieldcal.simulation.archive import write_flights
from fieldcal.simulation.experiment import Experiment
from fieldcal.site import write_site
from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.publish import publish

__all__ = ["browser"]  # a fixture

AXE = Path(__file__).parent / "axe" / "axe.min.js"
AXE_SHA256 = "29348999450cdf2849a8e70b7912fc2da85a849da39c0d0d5394f51d4a9ed95c"
FEW = [f"quad-{i:02d}" for i in range(14)]
HOSTILE = "</script><img src=x onerror=alert(1)>&'\"#?%2e%2e/\u202e\x1b"
SERIOUS = ("serious", "critical")
WAIT_S = 10.0

VISIBLE_ROWS = """
return [...document.querySelectorAll('main tbody tr')].filter(r => r.checkVisibility()).map(r => r.cells[0].textContent)
"""
INKED = """
return [...document.querySelectorAll('canvas')].map(c => {
  const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
  let inked = 0;
  for (let i = 3; i < d.length; i += 4) inked += d[i] > 0;
  return inked;
})
"""
SHOWN_X = "return [...document.querySelectorAll('.uplot')].length && location.hash"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Vehicles made of rows, and one whose log a night read."""
    folder = tmp_path_factory.mktemp("site")
    root = folder / "data"
    publish_fleet(root, {"bravo": "step", "charlie": "drifting"}, n_flights=6)
    for vehicle in (*FEW, HOSTILE):
        publish(root, vehicle, flight(vehicle, f"{vehicle}-0"), [f"{vehicle}-0"])
    write_flights(folder / "archive", Experiment(seed=3, duration_s=6.0))
    night = plan_night(folder / "archive", root)
    outcomes = [one_flight(root, job, night.configuration) for job in night.missing()]
    for publishing in publishings(night, outcomes):
        publishing.publish()
    return write_site(root, Criteria(Alerts(expires_days=1e5))).parent


@pytest.fixture(scope="module")
def flown(site: Path) -> str:
    """Page of the flight with readings."""
    (flight_id,) = Warehouse(site.parent).scan("flight").filter(vehicle_id="sim-1").collect()["flight_id"]
    return flight_name(flight_id)


@pytest.fixture(scope="module")
def served(site: Path) -> Iterator[str]:
    """Address of the site from a plain web server."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            """Nothing."""

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(site))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()


def until(true: Callable[[], Any]) -> Any:
    """What it gives once that is true."""
    give_up = time.monotonic() + WAIT_S
    while not (found := true()):
        assert time.monotonic() < give_up
        time.sleep(0.02)
    return found


def drawn(browser: Any, place: str) -> Any:
    """The figure `place` once it was brought into sight and drawn."""
    chart = browser.find_element("css selector", f"[data-chart='{place}']")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", chart)
    until(lambda: chart.find_elements("css selector", ".uplot canvas"))
    return chart


def a_chart(browser: Any, title: str) -> Any:
    """A vehicle's figure by its title, drawn."""
    script = """
      const all = fieldcal.data.get(document.querySelector('script[data-page]').dataset.page).charts;
      return all.find(one => one.title === arguments[0]).id;
    """
    until(lambda: browser.execute_script("return document.readyState === 'complete'"))
    return drawn(browser, browser.execute_script(script, title))


def rows(browser: Any) -> list[str]:
    return [str(text) for text in browser.execute_script(VISIBLE_ROWS)]


def filled(browser: Any, label: str, text: str) -> None:
    """Type into the field with this label."""
    field = browser.find_element("xpath", f"//label[starts-with(normalize-space(), '{label}')]/*")
    if field.tag_name == "input":
        field.clear()
    field.send_keys(text)


@pytest.mark.parametrize("place", ["disk", "server"])
def test_a_hostile_name_is_a_name(browser: Any, site: Path, served: str, place: str) -> None:
    base = served if place == "server" else f"{site.as_uri()}/"
    show(browser, f"{base}flights.html#q=img")
    until(lambda: len(browser.find_elements("css selector", "tbody td a")) == 1)
    vehicle = browser.find_element("css selector", "tbody td a")
    name = vehicle.text
    assert name == HOSTILE.replace("\u202e", "\\u202e").replace("\x1b", "\\x1b")
    vehicle.click()
    until(lambda: browser.title == f"Vehicle {name}")
    assert a_chart(browser, "gyroscope scale").find_elements("css selector", "canvas")
    browser.find_element("link text", "compare").click()
    until(lambda: browser.title == "Compare")
    first = browser.find_element("xpath", "//label[starts-with(., 'First')]/input")
    assert first.get_attribute("value") == f"vehicle {name}"
    filled(browser, "Second", "vehicle quad-00\t")
    until(lambda: browser.find_elements("css selector", ".compare canvas"))
    assert browser.find_elements("css selector", "img") == []
    assert browser.get_log("browser") == []


@pytest.mark.parametrize("place", ["disk", "server"])
def test_pages_are_quiet_and_load_nothing_from_elsewhere(
    browser: Any, site: Path, served: str, flown: str, place: str
) -> None:
    base = served if place == "server" else f"{site.as_uri()}/"
    for name in ("index.html", "vehicle-bravo.html", flown, "flights.html", "compare.html#a=vehicle-bravo"):
        show(browser, base + name)
        loaded = browser.execute_script("return performance.getEntriesByType('resource').map(e => e.name)")
        assert all(one.startswith(base) for one in loaded)
        assert browser.execute_script(WIDER_THAN_THE_WINDOW) <= 0
        if name == flown:
            drawn(browser, "readings-gyroscope")
            assert min(browser.execute_script(INKED)) > 200
        assert [one for one in browser.get_log("browser") if "favicon" not in one["message"]] == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(browser: Any, site: Path, flown: str, scheme: str) -> None:
    axe = AXE.read_bytes()
    assert hashlib.sha256(axe).hexdigest() == AXE_SHA256
    pair = "compare.html#a=vehicle-bravo&b=vehicle-charlie"
    pages = ("index.html", "vehicle-bravo.html", flown, "flights.html", pair)
    for name in pages if scheme == "light" else pages[:3]:
        show(browser, f"{site.as_uri()}/{name}", scheme)
        if name.startswith("vehicle"):
            a_chart(browser, "gyroscope zero_bias")
        # Through the debugger: the page's own policy lets no such script in.
        browser.execute_cdp_cmd("Runtime.evaluate", {"expression": axe.decode()})
        asked = {"expression": "axe.run().then(r => JSON.stringify(r.violations))", "awaitPromise": True}
        told = browser.execute_cdp_cmd("Runtime.evaluate", asked)["result"]["value"]
        found = [
            (one["id"], one["impact"], one["nodes"][0]["html"][:200])
            for one in json.loads(told)
            if one["impact"] in SERIOUS
        ]
        assert found == [], name
        picture(browser, f"site-{name.split('.')[0].split('-')[0]}-{scheme}")


def test_fleet_sorts_searches_and_filters_and_the_address_remembers(browser: Any, site: Path) -> None:
    index = f"{site.as_uri()}/index.html"
    show(browser, index)
    every = rows(browser)
    assert len(every) == len(FEW) + 4
    assert every[:3] == ["sim-1", "bravo", "charlie"]
    assert "No flight gave a constant. " in browser.find_element("css selector", "tbody tr").text
    assert "fly the manoeuvre" in browser.find_element("css selector", "tbody tr").text
    browser.find_element("xpath", "//th/button[text()='vehicle']").click()
    in_order = rows(browser)
    assert [one for one in in_order if one.isascii() and "<" not in one] == sorted(
        one for one in every if "<" not in one
    )
    browser.find_element("xpath", "//th/button[text()='vehicle']").click()
    assert rows(browser) == in_order[::-1]
    filled(browser, "Search", "quad-1")
    assert rows(browser) == sorted(FEW[10:], reverse=True)
    assert f"{len(FEW) - 10} of {len(every)}" in browser.find_element("css selector", ".controls").text
    address = browser.current_url
    show(browser, "about:blank")
    show(browser, address)
    assert rows(browser) == sorted(FEW[10:], reverse=True)
    show(browser, "about:blank")
    show(browser, index)
    filled(browser, "standing", "look first")
    assert rows(browser) == ["bravo", "charlie"]


def test_every_flight_is_found(browser: Any, site: Path, flown: str) -> None:
    show(browser, f"{site.as_uri()}/flights.html")
    assert len(rows(browser)) == 2 * 6 + len(FEW) + 2
    filled(browser, "Search", "bravo week")
    assert len(rows(browser)) == 6
    filled(browser, "verdict", "partial")
    assert len(rows(browser)) == 1
    show(browser, "about:blank")
    show(browser, f"{site.as_uri()}/flights.html#q=sim-1")
    assert [f"flight-{one}.html" for one in rows(browser)] == [flown]
    browser.find_element("link text", rows(browser)[0]).click()
    assert browser.title.startswith("Flight ")


def test_pointer_and_keyboard_read_the_values_of_the_history(browser: Any, site: Path) -> None:
    from selenium.webdriver import ActionChains, Keys

    show(browser, f"{site.as_uri()}/vehicle-bravo.html")
    chart = a_chart(browser, "gyroscope zero_bias")
    own = Warehouse(site.parent).scan("calibration", vehicle_id="bravo").sort("started_at")
    own = own.filter(sensor="gyroscope", parameter="zero_bias", axis="x").collect()
    trend = Warehouse(site.parent).scan("drift", vehicle_id="bravo")
    trend = trend.filter(sensor="gyroscope", parameter="zero_bias", axis="x").collect()
    at_25 = np.degrees(own["value"] - trend["slope_per_degc"][0] * (own["temperature_degc"] - 25.0))

    over = chart.find_element("css selector", ".u-over")
    half = over.rect["width"] / 2
    ActionChains(browser).move_to_element_with_offset(over, int(half) - 12, 0).perform()
    value = chart.find_element("css selector", ".legend .value")
    until(lambda: value.text)
    assert value.text.startswith(f"{at_25[-1]:.6g}"[:6])
    assert own["flight_id"][-1] in chart.find_element("css selector", ".readout").text

    panels = chart.find_element("css selector", ".panels")
    panels.send_keys(Keys.ESCAPE)
    for _ in range(len(own) + 2):
        panels.send_keys(Keys.ARROW_LEFT)
    assert value.text.startswith(f"{at_25[0]:.6g}"[:6])
    readout = chart.find_element("css selector", ".readout")
    assert readout.get_attribute("aria-live") == "polite"
    assert own["flight_id"][0] in readout.text
    assert browser.execute_script("return getComputedStyle(document.activeElement).outlineStyle") != "none"
    chart.find_element("css selector", "details summary").click()
    until(lambda: chart.find_elements("css selector", ".values tbody tr"))  # made when it opens
    cells = [row.text for row in chart.find_elements("css selector", ".values tbody tr")]
    assert len([one for one in cells if one.startswith("x flights") or one.startswith("x before")]) == len(own)


def test_drag_and_keys_zoom_all_panels_and_the_address_keeps_it(browser: Any, site: Path, flown: str) -> None:
    from selenium.webdriver import ActionChains, Keys

    def shown() -> tuple[float, float]:
        found = re.search(r"readings-gyroscope=[^&]*~([\d.e-]+)~([\d.e-]+)", browser.current_url.replace("%7E", "~"))
        return (float(found[1]), float(found[2])) if found else (-1.0, -1.0)

    show(browser, f"{site.as_uri()}/{flown}")
    over = drawn(browser, "readings-gyroscope").find_element("css selector", ".u-over")
    before = browser.execute_script(INKED)[0]
    wide = int(over.rect["width"])
    drag = ActionChains(browser).move_to_element_with_offset(over, -wide // 4, 0).click_and_hold()
    drag.move_by_offset(wide // 2, 5).release().perform()
    low, high = until(lambda: shown() if shown()[1] > 0 else None)
    assert (low, high) == pytest.approx((1.5, 4.5), abs=0.15)
    until(lambda: browser.execute_script(INKED)[0] != before)
    address = browser.current_url
    panels = browser.find_element("css selector", "[data-chart='readings-gyroscope'] .panels")
    panels.send_keys("+")
    assert shown()[1] - shown()[0] == pytest.approx((high - low) / 2, rel=0.01)
    panels.send_keys(Keys.SHIFT, Keys.ARROW_RIGHT)
    panels.send_keys("0")
    assert shown() == (-1.0, -1.0)
    show(browser, "about:blank")
    show(browser, address)
    drawn(browser, "readings-gyroscope")
    assert shown() == (low, high)
    browser.find_element("css selector", "[data-chart='readings-gyroscope'] button[title='Zoom out']").click()
    assert shown()[1] - shown()[0] == pytest.approx(6.0, rel=0.1) or shown() == (-1.0, -1.0)


def test_two_beside_each_other(browser: Any, site: Path) -> None:
    show(browser, f"{site.as_uri()}/compare.html")
    for label, name in (("First", "vehicle bravo"), ("Second", "vehicle charlie")):
        filled(browser, label, f"{name}\t")
    until(lambda: browser.find_elements("css selector", ".compare canvas"))
    assert "a=vehicle-bravo&b=vehicle-charlie" in browser.current_url
    row = browser.find_element("xpath", "//th[text()='gyroscope zero_bias x']/..").text
    frame = Warehouse(site.parent).sql(
        "SELECT vehicle_id, value_at_25degc AS v, sd FROM latest_calibration WHERE sensor = 'gyroscope'"
        " AND parameter = 'zero_bias' AND axis = 'x' AND vehicle_id IN ('bravo', 'charlie') ORDER BY vehicle_id"
    )
    (a, b), (sa, sb) = frame["v"].to_list(), frame["sd"].to_list()
    assert float(row.split()[-1]) == pytest.approx((a - b) / np.hypot(sa, sb), rel=0.06)
    names = [one.text for one in browser.find_elements("css selector", ".compare .legend")]
    assert any("bravo: " in one and "charlie: " in one for one in names)
    show(browser, "about:blank")
    show(browser, f"{site.as_uri()}/compare.html#a=vehicle-bravo&b=flight-nothing")
    assert "Choose two" in browser.find_element("css selector", ".compare").text


def test_what_a_figure_shows_is_taken_away(browser: Any, site: Path, flown: str, tmp_path: Path) -> None:
    browser.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
    show(browser, f"{site.as_uri()}/{flown}")
    chart = drawn(browser, "readings-accelerometer")
    chart.find_element("css selector", "button[title^='Download']").click()
    (path,) = until(lambda: list(tmp_path.glob("*.csv")))
    until(lambda: path.read_text(encoding="utf-8").endswith("\n"))
    with path.open(encoding="utf-8") as file:
        told = list(csv.DictReader(file))
    frame = pl.read_parquet(site / "data" / f"{flown.removesuffix('.html')}.parquet")
    same = frame.filter(
        pl.col("figure") == "Accelerometer", pl.col("view") == told[0]["view"], pl.col("y").is_not_null()
    )
    assert [float(one["y"]) for one in told] == pytest.approx(same["y"].to_list(), rel=1e-6)
    assert [one["curve"] for one in told] == same["curve"].to_list()
    link = chart.find_element("link text", "Parquet")
    assert link.get_attribute("href") == (site / "data" / f"{flown.removesuffix('.html')}.parquet").as_uri()


def test_keyboard_reaches_the_content_and_sorts(browser: Any, site: Path) -> None:
    from selenium.webdriver import Keys

    show(browser, f"{site.as_uri()}/index.html")
    browser.find_element("tag name", "body").send_keys(Keys.TAB)
    assert browser.switch_to.active_element.text == "Skip to the content"
    reached = []
    for _ in range(12):
        browser.switch_to.active_element.send_keys(Keys.TAB)
        focus = browser.switch_to.active_element
        reached.append(focus.text or focus.tag_name)
        assert browser.execute_script("return getComputedStyle(document.activeElement).outlineStyle") != "none"
        if focus.text.startswith("vehicle"):
            focus.send_keys(Keys.ENTER)
            break
    assert reached[:3] == ["Fleet", "Flights", "Compare"]
    assert [one for one in rows(browser) if "<" not in one] == sorted(one for one in rows(browser) if "<" not in one)
    assert browser.switch_to.active_element.find_element("xpath", "..").get_attribute("aria-sort") == "ascending"


def test_phone_and_print(browser: Any, site: Path, flown: str) -> None:
    metrics = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        for name in ("index.html", "flights.html", flown, "vehicle-bravo.html"):
            show(browser, f"{site.as_uri()}/{name}")
            if name == flown:
                drawn(browser, "readings-gyroscope")
            assert browser.execute_script(WIDER_THAN_THE_WINDOW) <= 0
            picture(browser, f"site-{name.split('.')[0].split('-')[0]}-phone")
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    show(browser, f"{site.as_uri()}/vehicle-bravo.html", "dark")
    a_chart(browser, "gyroscope zero_bias")
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    assert browser.execute_script("return getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    for hidden in (".controls", ".bar", "nav"):
        assert not any(one.is_displayed() for one in browser.find_elements("css selector", hidden))
    pdf = base64.b64decode(browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})["data"])
    assert len(re.findall(rb"/Type\s*/Page\b", pdf)) >= 2


def test_paper_has_the_colours_of_the_reports_print() -> None:
    package = Path(__file__).parents[2] / "fieldcal"
    print_block = re.findall(r"@media print \{.*", (package / "report/templates/style.css").read_text(), re.S)[0]
    paper = dict(re.findall(r"--([\w-]+): (#\w{6});", print_block))
    own = dict(re.findall(r"--paper-([\w-]+): (#\w{6});", (package / "site/assets/site.css").read_text()))
    assert own == {name: paper[name] for name in own}
    assert set(own) == {"bg", "fg", "muted", "line", "c1", "c2", "c3", "c4", "warn"}
