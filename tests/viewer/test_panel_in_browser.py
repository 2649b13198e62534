"""What a person does in the panel, in a real and narrow browser: a path, its preview, a film, a photograph."""

import io
import math
import time

import numpy as np
import pytest
from PIL import Image
from support.browser import drag, opened, press, unfold
from support.known_fields import ball, solid
from support.scenes import ball_scene
from support.served_page import served

pytestmark = pytest.mark.slow

# Half the height of the photographs is 0.3125 of their focal length.
PHOTOGRAPH = 2 * math.atan(0.3125)


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
    """The number beside a label of the panel."""
    found = browser.find_elements("xpath", f"//*[text()='{label}']/following::input[not(@type='hidden')][1]")
    return float(found[0].get_attribute("value")) if found and found[0].get_attribute("value") else None


def shot(browser):
    return np.array(Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")).astype(int)


def canvas(browser):
    box = browser.find_element("css selector", "canvas").rect
    return box["width"], box["height"]


def is_blue(pixel):
    return pixel[2] - max(pixel[0], pixel[1]) > 20


def at(browser, place):
    """Where a place of the scene is on the screen: the first view is from the first photograph, 1.4 times as far."""
    eye = 1.4 * np.array([4.0, 0.0, 1.6])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    to = np.array(place) - eye
    width, height = canvas(browser)
    focal = 0.5 * min(width, height) / math.tan(0.5 * PHOTOGRAPH) / (to @ forward)
    return round(0.5 * width + focal * (to @ right)), round(0.5 * height - focal * (to @ np.cross(right, forward)))


def near(browser, place):
    column, row = at(browser, place)
    return shot(browser)[row - 4 : row + 5, column - 2 : column + 3].reshape(-1, 3)


def test_a_person_makes_a_path_plays_it_films_it_and_chooses_a_photograph(tmp_path):
    scene = ball_scene(num_views=4, size=16)
    with (
        served(tmp_path, model=solid(ball(), samples=48), scene=scene, height=96) as page,
        opened(page.address, 500, 800) as browser,
    ):
        shown = wait(lambda: number(browser, "Field of view"))
        width, height = canvas(browser)
        assert width < height
        # The whole photograph is in a window that is narrower than it.
        assert math.tan(math.radians(shown) / 2) * width / height == pytest.approx(math.tan(PHOTOGRAPH / 2), rel=0.03)

        # The box's edges behind the ball are hidden, others are not.
        unfold(browser, "Crop box", "//*[contains(text(), 'Show only')]")
        press(browser, "xpath", "//*[contains(text(), 'Show only')]/following::input[@type='checkbox'][1]")
        wait(lambda: any(map(is_blue, near(browser, (1.0, -0.9, 1.0)))))
        wait(lambda: not any(map(is_blue, near(browser, (-1.0, -0.55, -1.0)))))
        press(browser, "xpath", "//*[contains(text(), 'Show only')]/following::input[@type='checkbox'][1]")
        button(browser, "Crop box")

        unfold(browser, "Camera path", "//*[text()='Add keyframe']")
        for _ in range(2):
            button(browser, "Add keyframe")
            wait(lambda: "keyframe" in text(browser))
            drag(browser, -60, 0)
        wait(lambda: "2 keyframes, 2.0 s" in text(browser))
        button(browser, "Play")
        wait(lambda: 0.2 < (number(browser, "Time") or 0) < 1.9)
        wait(lambda: number(browser, "Time") == 2.0)
        button(browser, "Save as yaml")
        wait(lambda: "path.file=" in text(browser))
        button(browser, "Camera path")

        unfold(browser, "Film", "//*[text()='Render film']")
        button(browser, "Render film")
        wait(lambda: "Frame " in text(browser))
        button(browser, "Stop the film")
        wait(lambda: "The film was stopped." in text(browser))
        button(browser, "Film")

        unfold(browser, "Photographs", "//img[@class='nerf-photograph']")
        press(browser, "css selector", "img.nerf-photograph")
        wait(lambda: "Through the camera of" in text(browser))
        across = {each.rect["y"] for each in browser.find_elements("css selector", "img.nerf-photograph")}
        assert len(across) == 2  # three beside each other
