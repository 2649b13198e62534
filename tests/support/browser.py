"""A real browser without a screen, driven through its own driver; tests are skipped where there is none."""

import io
import shutil
import time
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from PIL import Image

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--no-first-run",
    "--disable-background-networking",
)
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def why_no_browser() -> str | None:
    """Return why no browser can be driven here, and what to do about it; None where one can."""
    try:
        import selenium  # noqa: F401
    except ImportError:
        return "selenium is not installed: pip install selenium"
    if not any(map(shutil.which, BROWSERS)) or not shutil.which("chromedriver"):
        return "no Chromium with its driver here (Debian: apt install chromium chromium-driver)"
    return None


@contextmanager
def opened(address: str, width: int = 800, height: int = 600):
    """Open a page; skip the test where there is no browser."""
    reason = why_no_browser()
    if reason is not None:
        pytest.skip(reason)
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    options = ChromeOptions()
    options.binary_location = next(filter(None, map(shutil.which, BROWSERS)))
    for flag in (*FLAGS, f"--window-size={width},{height}"):
        options.add_argument(flag)
    driver = Chrome(options=options, service=Service(shutil.which("chromedriver")))
    try:
        driver.set_page_load_timeout(120)
        driver.get(address)
        yield driver
    finally:
        driver.quit()


def canvas_of(driver) -> np.ndarray:
    """Return what the left half of the scene shows: the panel is on the right."""
    shot = np.array(Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB"))
    return shot[shot.shape[0] // 3 :, : shot.shape[1] // 2].astype(float)


def wait_until(driver, good, seconds: float = 90.0) -> np.ndarray:
    """Wait until what the scene shows is good."""
    end = time.monotonic() + seconds
    while not good(picture := canvas_of(driver)):
        assert time.monotonic() < end, "the page did not come to show what it should"
        time.sleep(0.3)
    return picture


def drag(driver, right: int, down: int) -> None:
    """Turn the camera with the mouse."""
    from selenium.webdriver import ActionChains

    canvas = driver.find_element("css selector", "canvas")
    ActionChains(driver).move_to_element(canvas).click_and_hold().move_by_offset(right, down).release().perform()


def press(driver, by: str, what: str, seconds: float = 40.0) -> None:
    """Click on something as soon as it can be clicked: folders of the panel take a while to open."""
    from selenium.common.exceptions import WebDriverException

    end = time.monotonic() + seconds
    while True:
        for element in driver.find_elements(by, what):
            try:
                element.click()
            except WebDriverException:
                continue
            return
        assert time.monotonic() < end, f"{what} cannot be clicked"
        time.sleep(0.1)


def unfold(driver, title: str, inside: str, seconds: float = 60.0) -> None:
    """Open a folder of the panel, until what is in it (an XPath) shows: a click may fall while the page still moves."""
    from selenium.common.exceptions import WebDriverException

    end = time.monotonic() + seconds
    while True:
        press(driver, "xpath", f"//*[normalize-space(text())='{title}']")
        shown_by = time.monotonic() + 6.0
        while time.monotonic() < shown_by:
            with suppress(WebDriverException):  # an element may go while it is asked
                if any(element.is_displayed() for element in driver.find_elements("xpath", inside)):
                    return
            time.sleep(0.1)
        assert time.monotonic() < end, f"{title} does not open"
