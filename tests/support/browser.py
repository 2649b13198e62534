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
    "--force-prefers-reduced-motion",
    "--no-first-run",
    "--disable-background-networking",
)
# What each browser is called, its driver, and where both come from.
BROWSERS = {
    "Chromium": (("chromium", "chromium-browser", "google-chrome"), "chromedriver", "chromium chromium-driver"),
    "Firefox": (("firefox", "firefox-esr"), "geckodriver", "firefox-esr, and geckodriver from its releases"),
}


def why_no_browser(browser: str = "Chromium") -> str | None:
    """Return why no browser can be driven here, and what to do about it; None where one can."""
    try:
        import selenium  # noqa: F401
    except ImportError:
        return "selenium is not installed: pip install selenium"
    names, driver, packages = BROWSERS[browser]
    if not any(map(shutil.which, names)) or not shutil.which(driver):
        return f"no {browser} with its driver here (Debian: apt install {packages})"
    return None


@contextmanager
def opened(address: str, width: int = 800, height: int = 600, browser: str = "Chromium"):
    """Open a page; skip the test where there is no browser."""
    reason = why_no_browser(browser)
    if reason is not None:
        pytest.skip(reason)
    from selenium import webdriver

    names, driver_name, _ = BROWSERS[browser]
    kind, flags = ("Chrome", FLAGS) if browser == "Chromium" else ("Firefox", ("-headless",))
    options = getattr(webdriver, f"{kind}Options")()
    options.binary_location = next(filter(None, map(shutil.which, names)))
    for flag in (*flags, f"--window-size={width},{height}"):
        options.add_argument(flag)
    service = getattr(webdriver, f"{kind}Service")(shutil.which(driver_name))
    driver = getattr(webdriver, kind)(options=options, service=service)
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


SIZES = {"desktop": (1280, 800), "phone": (390, 844)}
LAYOUT = """
const seen = element => { const box = element.getBoundingClientRect(); return box.width > 0 && box.height > 0; };
// A phone widens innerWidth to what does not fit, and shows all of it smaller.
const faults = [], {scrollWidth, clientWidth} = document.documentElement;
if (scrollWidth > clientWidth) faults.push(`it is ${scrollWidth} pixels wide, in a window of ${clientWidth}`);
for (const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT); walker.nextNode();) {
  const element = walker.currentNode.parentElement, text = walker.currentNode.textContent.trim();
  if (!text || !seen(element) || element.closest("script, style, option")) continue;
  if (parseFloat(getComputedStyle(element).fontSize) < 10) faults.push(`small text: ${text.slice(0, 40)}`);
}
const controls = [...document.querySelectorAll("button, input, select, summary, a.button")].filter(seen);
const name = element => element.id || element.textContent.trim().slice(0, 20) || element.type;
controls.forEach((one, number) => controls.slice(number + 1).forEach(other => {
  if (one.contains(other) || other.contains(one)) return;
  const [a, b] = [one, other].map(element => element.getBoundingClientRect());
  const width = Math.min(a.right, b.right) - Math.max(a.left, b.left);
  const height = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
  if (width > 1 && height > 1) faults.push(`${name(one)} lies over ${name(other)}`);
}));
return faults;
"""


def layout_faults(driver, size: str, prepare: str = "") -> list[str]:
    """Return what is wrong with a page in a window of this size: sideways scrolling, small text, controls that overlap.

    Args:
        driver: shows the page.
        size: of `SIZES`.
        prepare: a script to run before looking.
    """
    width, height = SIZES[size]
    window = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": size == "phone"}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", window)
    driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": size == "phone"})
    driver.refresh()
    time.sleep(0.5)
    driver.execute_script(prepare)
    return driver.execute_script(LAYOUT)
