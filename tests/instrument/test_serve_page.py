"""The pages of a served bench and of a chart, in a real browser."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("aiohttp", reason='pip install "diffuserbench[remote]"')

from drivers.errors import StoppedError
from drivers.frame import Frame
from drivers.led_array import LedPattern
from drivers.remote.camera import RemoteCamera
from drivers.remote.light_and_motion import RemoteLedArray
from drivers.remote.options import RemoteOptions
from instrument.bench.config_file import parse_config
from instrument.evaluation.chart import ChartData
from instrument.evaluation.figures import chart_page
from instrument.serve.server import BenchServer, Serving
from instrument.serve.watching import picture
from recon.evaluation.scored import Point
from tests.drivers.test_remote import BENCH, TOKEN
from tests.mocks.devices import MockCamera, MockOptions, MockWorld, MockWorldOptions
from tests.mocks.waiting import until


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium without a screen, driven through its own driver."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="pip install selenium")
    paths = shutil.which("chromium"), shutil.which("chromedriver")
    if None in paths:
        pytest.skip("no browser: apt install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = paths[0]
    for flag in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(paths[1]))
    try:
        yield driver
    finally:
        driver.quit()


@pytest.fixture
def server() -> Iterator[BenchServer]:
    with BenchServer(parse_config(BENCH, None), Serving(token=TOKEN, port=0)) as server:
        yield server


def test_live_picture_state_and_stop(browser: Any, server: BenchServer, tmp_path: Any) -> None:
    def text(name: str) -> str:
        return str(browser.find_element("id", name).text)

    # Nobody operates: the page has the camera opened, and shows it.
    browser.get(f"{server.url}/#{TOKEN}")
    assert until(lambda: text("age").startswith("Live: frame"))
    assert TOKEN not in browser.current_url
    assert until(lambda: "SIMULATED" in text("state"))  # asked for now and then
    assert "operated by\nnobody" in text("state")
    assert browser.execute_script("return document.getElementById('picture').width") == 320

    # An operator takes it over; the page shows his frames and what he has lit.
    (tmp_path / "token").write_text(TOKEN)
    options = RemoteOptions(url=server.url, token_file=str(tmp_path / "token"))
    camera, leds = RemoteCamera(options), RemoteLedArray(options)
    camera.open()
    leds.open()
    leds.set_pattern(LedPattern("LED 7", ((7, (255, 255, 255)),)))
    assert until(lambda: "LED 7" in text("state") and "process" in text("state"))
    camera.set_exposure_ms(7.5)
    frame = camera.snap()
    assert until(lambda: f"frame {frame.metadata.frame_id}" in text("age") and "7.5 ms" in text("words"))

    # STOP ends his operation.
    browser.find_element("id", "stop").click()
    assert until(lambda: "Stopped: light off, motion stopped" in text("notice"))
    with pytest.raises(StoppedError, match="STOP was pressed by somebody at 127"):
        assert until(lambda: leds.pattern is None)
    for device in (camera, leds):
        device.close()
    assert until(lambda: "operated by\nnobody" in text("state"))

    # The server ends: nothing on the page passes for current.
    server.close()
    assert until(lambda: "No connection to the bench" in text("notice") and "NOT CURRENT" in text("age"))
    complaints = [
        entry for entry in browser.get_log("browser") if "WebSocket connection" not in entry["message"]
    ]
    assert [entry for entry in complaints if "ERR_CONNECTION_REFUSED" not in entry["message"]] == []


def test_a_wrong_token_is_asked_for_again(browser: Any, server: BenchServer) -> None:
    browser.get(f"{server.url}/#wrong")
    field = browser.find_element("id", "token")
    assert until(field.is_displayed)
    assert browser.find_element("id", "notice").text == "This token is not the bench's."
    field.send_keys(f"{TOKEN}\n")
    assert until(
        lambda: (
            browser.find_element("id", "bench").text.startswith("simulated")
            or browser.find_element("id", "state").text
        )
    )


def test_a_picture_hides_no_saturated_pixel_and_is_no_larger_than_needed() -> None:
    import cv2

    with MockCamera(MockOptions(), MockWorld(MockWorldOptions())) as camera:
        metadata = camera.snap().metadata
    image = np.tile(np.arange(3000, dtype=np.uint16) % 900, (2000, 1))
    image[1234, 2345] = (1 << metadata.significant_bits) - 1
    said, encoded = picture(Frame(image.astype(np.uint16), metadata))
    shown = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == (666, 1000, 3)
    red = shown[..., 2].astype(int) - shown[..., 1]
    place = np.unravel_index(red.argmax(), red.shape)
    assert np.abs(np.subtract(place, (1234 // 3, 2345 // 3))).max() <= 8  # a block of the JPEG's
    assert "2000 x 3000" in said["words"]


def test_a_click_on_a_chart_names_a_setting_and_dims_the_others(browser: Any, tmp_path: Path) -> None:
    points = tuple(
        Point(f"admm p{n}", count, 1e-3 * count, psnr_db=20 + n + float(np.log10(count)), family="admm")
        for n in range(3)
        for count in (3, 10, 30)
    )
    page = tmp_path / "chart.html"
    page.write_text(chart_page(ChartData("reconstruction", {}, points, {}, ())), "utf-8")
    browser.get(page.as_uri())
    words = "return [...document.querySelectorAll('svg text')].map(t => t.textContent)"
    circles = "[...document.querySelectorAll('circle')]"
    faint = f"return {circles}.filter(c => c.getAttribute('fill-opacity') < 0.5).length"
    click = "document.querySelectorAll('.reach')[1].dispatchEvent(new MouseEvent('click', {bubbles: true}))"
    assert {"21", "22", "23"} < set(browser.execute_script(words)), "round numbers"
    browser.execute_script(click)
    assert "admm p1" in browser.execute_script(words)
    assert browser.execute_script(faint) == 6
    browser.execute_script(click)
    assert "admm p1" not in browser.execute_script(words)
