"""Views, notes, distances and the turntable in a real browser."""

import json
import time
from itertools import pairwise

import numpy as np
import pytest
import torch
from support.browser import drag, opened
from support.page_in_browser import drawn, hide_controls, name_it, press, psnr, shot, wait_for, wait_until_there
from support.shiny_ball import RADIUS, all_around, record_of, run_of, shiny_model
from support.splat_page import read_page

from nerf_lightning.extensions.splats.page import PageExport
from nerf_lightning.nerf.geometry.world_frame import similarity

pytestmark = pytest.mark.minutes

EVIL = '<img src=x onerror="document.title=1">'
MOTION = {"features": [{"name": "prefers-reduced-motion", "value": "no-preference"}]}
TAP = """
const at = {clientX: arguments[0], clientY: arguments[1], pointerId: 1}, scene = document.getElementById('scene');
scene.setPointerCapture = () => {};
for (const name of ['pointerdown', 'pointerup']) scene.dispatchEvent(new PointerEvent(name, at));"""


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page of a ball in a capture whose unit is 3 of the scene's, and a centimetre long."""
    folder, scene = tmp_path_factory.mktemp("page"), all_around()
    content = {
        "views": [{"name": EVIL, "photograph": "ball_2"}],
        "notes": [{"text": EVIL, "position": [5.0 + 3 * RADIUS, 0.0, 0.0]}],
    }
    (folder / "given.json").write_text(json.dumps(content))
    chosen = {"views": str(folder / "given.json"), "first_view": EVIL, "title": EVIL}
    what = PageExport(2000, 1.0, photographs=6, max_views=0, **chosen)
    to_user = similarity(torch.eye(3), torch.tensor([5.0, 0.0, 0.0]), 3.0)
    with torch.no_grad():
        return what.export(
            shiny_model(), record_of(scene, to_user=to_user, metres_per_unit=0.01), folder, 65_536, run_of(scene)
        )[0]


def test_views_notes_and_distances_are_shown_added_saved_and_stay_texts(page, tmp_path):
    with opened(page.as_uri(), 500, 400) as driver:
        run = driver.execute_script
        driver.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
        wait_for(driver, "still")
        assert run("return document.title") == EVIL
        assert run("return document.querySelector('#pins .note').textContent") == EVIL
        assert run("return document.querySelectorAll('#pins img, #views img').length") == 0
        hide_controls(driver)
        found = shot(driver)
        height, width = found.shape[:2]
        assert psnr(found, drawn(page, 2, width, height)) > 38
        press(driver, "v")
        name_it(driver, "mine")
        press(driver, "n")
        assert run("return document.getElementById('told').textContent").startswith("Click")  # there is a mouse
        run(TAP, 2, 2)
        assert run("return document.getElementById('told').textContent").startswith("There is nothing here")
        run(TAP, width / 2, height / 2)
        name_it(driver, "mine")
        press(driver, "m")
        run(TAP, width / 2, height / 2)
        run(TAP, width / 2, height / 2 + 30)
        told = run("return document.querySelector('#pins .distance').textContent")
        assert run("return document.getElementById('told').textContent") == told
        press(driver, "delete")
        assert run("return document.getElementById('told').textContent") == ""
        run("document.getElementById('tools').open = true; document.getElementById('measure').click()")
        assert not run("return document.getElementById('tools').open")  # a narrow window, which it would cover
        press(driver, "escape")
        press(driver, "m")
        press(driver, "enter")
        press(driver, "escape")
        run("document.getElementById('save-marks').click()")
        wait_until_there(tmp_path / "views.json")
        assert not [entry for entry in driver.get_log("browser") if "GPU stall" not in entry["message"]]
    saved = json.loads((tmp_path / "views.json").read_text())
    assert [view["name"] for view in saved["views"]] == [EVIL, "mine"]
    for key, value in saved["views"][0].items():
        if key != "name":
            np.testing.assert_allclose(saved["views"][1][key], value, rtol=1e-6, atol=1e-6)
    eye = np.array(read_page(page)[0]["cameras"][2]["eye"])
    point = (np.array(saved["notes"][1]["position"]) - [5.0, 0.0, 0.0]) / 3
    # On the side of the ball, which is soft, that the camera sees.
    assert np.linalg.norm(point) == pytest.approx(RADIUS, abs=0.2)
    assert point @ eye / np.linalg.norm(point) / np.linalg.norm(eye) > 0.999
    assert saved["distances"] == []
    # Thirty pixels at about the distance of the surface; it curves away from the camera.
    focal = read_page(page)[0]["cameras"][2]["focal"][0] * min(width, height) / 32
    across = 0.03 * 30 / focal * (np.linalg.norm(eye) - np.linalg.norm(point))
    assert float(told.removesuffix(" m")) == pytest.approx(across, rel=0.15)


def test_labels_at_one_point_do_not_overlap_and_same_texts_are_numbered(page):
    with opened(page.as_uri(), 500, 400) as driver:
        run = driver.execute_script
        wait_for(driver, "still")
        for _ in range(3):
            press(driver, "v")
            name_it(driver, "mine")
            press(driver, "n")
            press(driver, "enter")
            name_it(driver, "mine")
        wait_for(driver, "still")
        assert run("return [...document.querySelectorAll('#views button')].map(each => each.textContent)")[1:] == (
            ["mine", "mine (2)", "mine (3)"]
        )
        box = "const {top, bottom} = each.getBoundingClientRect(); return [top, bottom]"
        notes = "[...document.querySelectorAll('#pins .note')].filter(each => each.textContent.startsWith('mine'))"
        boxes = run(f"return {notes}.map(each => {{ {box} }})")
        assert all(below[0] >= above[1] for above, below in pairwise(boxes))
        leaders = run("return [...document.querySelectorAll('#lines path')].map(each => each.getAttribute('d'))")
        assert sum(not leader.endswith(" v 0") for leader in leaders) >= 2  # to labels that had to give way


@pytest.mark.parametrize(("key", "dialog"), [("i", "numbers"), ("v", "naming")])
def test_each_dialog_closes_by_its_button_and_by_escape(page, key, dialog):
    with opened(page.as_uri(), 500, 400) as driver:
        wait_for(driver, "still")
        views = len(driver.find_elements("css selector", "#views button"))
        for leave in (lambda: driver.find_element("css selector", f"#{dialog} .close").click(), escape(driver)):
            press(driver, key)
            assert driver.find_element("id", dialog).is_displayed()
            leave()
            assert not driver.find_element("id", dialog).is_displayed()
        assert len(driver.find_elements("css selector", "#views button")) == views


def escape(driver):
    return lambda: driver.switch_to.active_element.send_keys("\ue00c")


def test_it_turns_by_itself_until_it_is_touched(page):
    with opened("about:blank", 300, 300) as driver:
        driver.execute_cdp_cmd("Emulation.setEmulatedMedia", MOTION)
        driver.get(page.as_uri())
        wait_for(driver, "moving")
        pressed = "return document.getElementById('turn').getAttribute('aria-pressed')"
        assert driver.execute_script(pressed) == "true"
        place = "return document.querySelector('#pins .note').style.transform"
        before = driver.execute_script(place)
        time.sleep(1)
        assert driver.execute_script(place) != before
        drag(driver, 20, 0)
        wait_for(driver, "still")
        assert driver.execute_script(pressed) == "false"
        press(driver, "t")
        wait_for(driver, "moving")
        assert driver.execute_script(pressed) == "true"
