"""Use of the panel in a real, narrow browser: a path, its preview, a film, a photograph."""

import math
import time

import pytest
from support.browser import drag, opened, press, unfold
from support.known_fields import ball, solid
from support.scenes import ball_scene
from support.served_page import served

pytestmark = pytest.mark.minutes

# Half the height of the photographs is 0.3125 of their focal length.
PHOTOGRAPH = 2 * math.atan(0.3125)
NAME = '<iframe srcdoc="<script>parent.document.title=1</script>"></iframe><img src=x onerror="document.title=2">'


def text(browser):
    return browser.find_element("css selector", "body").text


def wait(true, seconds=40.0):
    end = time.monotonic() + seconds
    while not (found := true()):
        assert time.monotonic() < end
        time.sleep(0.1)
    return found


def button(browser, label):
    press(browser, "xpath", f"//*[normalize-space(text())='{label}']")


def number(browser, label):
    """The number next to a label of the panel."""
    found = browser.find_elements("xpath", f"//*[text()='{label}']/following::input[not(@type='hidden')][1]")
    return float(found[0].get_attribute("value")) if found and found[0].get_attribute("value") else None


def canvas(browser):
    box = browser.find_element("css selector", "canvas").rect
    return box["width"], box["height"]


def test_a_person_makes_a_path_plays_it_films_it_and_chooses_a_photograph(tmp_path):
    scene = ball_scene(num_views=4, size=16)
    with (
        served(tmp_path, {"view_names": (NAME, "b", "c", "d")}, solid(ball(), samples=48), scene, 96) as page,
        opened(page.address, 500, 800) as browser,
    ):
        shown = wait(lambda: number(browser, "Field of view"))
        width, height = canvas(browser)
        assert width < height
        # The whole photograph is in a window that is narrower than it.
        assert math.tan(math.radians(shown) / 2) * width / height == pytest.approx(math.tan(PHOTOGRAPH / 2), rel=0.03)

        unfold(browser, "Controls", "//*[text()='Camera path']")  # the window is narrow
        unfold(browser, "Camera path", "//*[text()='Add keyframe']")
        for _ in range(2):
            button(browser, "Add keyframe")
            wait(lambda: "keyframe" in text(browser))
            drag(browser, -60, 0)
        wait(lambda: "2 keyframes, 2.0 s" in text(browser))
        # Its policy lets the page work.
        assert [each for each in browser.get_log("browser") if each["source"] == "security"] == []
        button(browser, "Play")
        wait(lambda: 0.2 < (number(browser, "Time") or 0) < 1.9)
        wait(lambda: number(browser, "Time") == 2.0)
        button(browser, "Save path")
        wait(lambda: "path.file=" in text(browser))
        button(browser, "Camera path")

        unfold(browser, "Photographs", "//*[text()='Photograph']")
        press(browser, "xpath", "//*[text()='Photograph']/following::input[1]")
        press(browser, "xpath", "//*[@role='option'][2]")
        wait(lambda: f"Camera of {NAME}" in text(browser))
        assert browser.title == "ball"  # an untrusted name is text
