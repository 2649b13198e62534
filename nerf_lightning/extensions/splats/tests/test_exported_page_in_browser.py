"""The page in a real browser: it shows what the rasterizer draws, asks for nothing, and says what is wrong."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.browser import SIZES, drag, layout_faults, opened
from support.contracted_hall import hall_model, hall_scene
from support.page_in_browser import (
    MESSAGE,
    drawn,
    drawn_through,
    hide_controls,
    name_it,
    press,
    psnr,
    shot,
    wait_for,
    wait_until_there,
)
from support.shiny_ball import all_around, record_of, run_of, shiny_model
from support.splat_page import read_page

from nerf_lightning.commands.export import page_path
from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.instantiate import build
from nerf_lightning.extensions.splats.page import PageExport
from nerf_lightning.nerf.geometry.world_frame import similarity
from nerf_lightning.video.paths.keyframe_path import KeyframePath
from nerf_lightning.video.paths.orbit import Orbit
from nerf_lightning.video.shots import Subject, lay_path, make_shots

pytestmark = pytest.mark.minutes

WITHOUT = "HTMLCanvasElement.prototype.getContext = () => null;"


@pytest.fixture(scope="module", params=[2, *(pytest.param(n, marks=pytest.mark.exhaustive) for n in (0, 1, 3))])
def page(request, tmp_path_factory):
    """With harmonics of some degree, fitted for a moment, so that they are not zero."""
    what, scene = PageExport(400, 0.5, request.param, photographs=3, max_views=0), all_around()
    with torch.no_grad():
        return what.export(shiny_model(), record_of(scene), tmp_path_factory.mktemp("page"), 65_536, run_of(scene))[0]


def test_it_shows_what_the_rasterizer_draws_and_asks_for_nothing(page):
    with opened(page.as_uri(), 256, 360) as driver:
        run = driver.execute_script
        wait_for(driver, "still")
        hide_controls(driver)
        found = shot(driver)
        height, width = found.shape[:2]
        first = read_page(page)[0]["first"]
        assert psnr(found, drawn(page, first, width, height)) > 38
        # Not because all is white.
        assert found.std() > 0.1
        assert run("return performance.getEntriesByType('resource').length") == 0
        assert driver.get_log("browser") == []
        run("document.querySelectorAll('#photographs button')[1].click(); document.getElementById('wipe').value = 0")
        run("dispatchEvent(new Event('resize'))")
        wait_for(driver, "still")
        assert psnr(shot(driver), drawn(page, 1, width, height)) > 38
        before = shot(driver)
        drag(driver, 40, 0)
        wait_for(driver, "still")
        assert psnr(shot(driver), before) < 35


@pytest.mark.parametrize("page", [2], indirect=True)
def test_nothing_overlaps_or_hides_the_first_view_on_desktops_and_phones(page):
    box = "document.getElementById(id).getBoundingClientRect()"
    edges = f"return ['photograph', 'photographs', 'controls'].map(id => {box})"
    wipe = "document.getElementById('wipe')"
    with opened(page.as_uri(), 1280, 800) as driver:
        for size in SIZES:
            assert layout_faults(driver, size) == []
            wait_for(driver, "still")
            photograph, strip, controls = driver.execute_script(edges)
            assert controls["bottom"] < photograph["top"] + 1
            assert photograph["bottom"] <= strip["top"] + 1
            bars = SIZES[size][1] - (strip["top"] - controls["bottom"])
            assert bars < 0.2 * SIZES[size][1]
            # The slider is as wide as the photograph.
            assert driver.execute_script(f"return {wipe}.getBoundingClientRect().width") == pytest.approx(
                photograph["width"]
            )
            assert strip["bottom"] == pytest.approx(SIZES[size][1])
            # Nothing moves when the slider between photograph and render goes.
            press(driver, "arrowleft")
            assert driver.execute_script(edges)[1:] == [strip, controls]
            driver.execute_script("dispatchEvent(new KeyboardEvent('keyup', {key: 'arrowleft'}))")
            # Fingers or keys: what there is.
            press(driver, "i")
            controls = driver.find_element("css selector", "#numbers").text
            assert ("two fingers" in controls, "Shift + drag" in controls) == (size == "phone", size != "phone")
            assert layout_faults(driver, size, "document.getElementById('tools').open = true") == []
            controls = "[...document.querySelectorAll('button, select, summary, label')]"
            heights = driver.execute_script(f"return {controls}.map(each => each.getBoundingClientRect().height)")
            assert min(filter(None, heights)) >= (40 if size == "phone" else 24)
            before = "document.getElementById('turn').getBoundingClientRect()"
            left = driver.execute_script(f"return {before}.left")
            driver.execute_script("document.getElementById('tools').open = false")
            assert driver.execute_script(f"return {before}.left") == left, "opening the tools moves nothing"


@pytest.mark.parametrize("page", [2], indirect=True)
def test_firefox_shows_it_too(page):
    with opened(page.as_uri(), 500, 500, "Firefox") as driver:
        wait_for(driver, "still")
        hide_controls(driver)
        found = shot(driver)
        assert psnr(found, drawn(page, read_page(page)[0]["first"], *found.shape[1::-1])) > 36


@pytest.mark.parametrize("page", [2], indirect=True)
def test_the_photograph_lies_over_its_camera_and_other_things_can_be_shown(page):
    with opened(page.as_uri(), 256, 360) as driver:
        run = driver.execute_script
        wait_for(driver, "still")
        run("document.querySelectorAll('#photographs button')[1].click()")
        wait_for(driver, "still")
        box = run("const b = document.getElementById('photograph').getBoundingClientRect(); return [b.width, b.height]")
        assert box[0] == pytest.approx(box[1])
        assert not run("return document.getElementById('frame').hidden")
        labels = "return document.getElementById('frame').innerText"
        assert run(labels).split() == ["Photograph", "Render"]
        run("const w = document.getElementById('wipe'); w.value = 0; w.dispatchEvent(new Event('input'))")
        assert run(labels).split() == ["Render"]
        hide_controls(driver)
        colors = shot(driver)
        for number in (1, 2):
            press(driver, str(number + 1))
            wait_for(driver, "still")
            assert np.abs(shot(driver) - colors).mean() > 0.01
            assert run("return document.getElementById('scale').hidden") == (number != 1)
        near, far = run("return ['near', 'far'].map(id => Number(document.getElementById(id).value))")
        eye = np.linalg.norm(read_page(page)[0]["cameras"][1]["eye"])
        assert eye - 1 < near < far < eye + 1  # the ball is in the middle
        press(driver, "i")
        assert run("return document.getElementById('numbers').open")


def test_a_scene_without_bounds_is_shown_as_the_rasterizer_draws_it(tmp_path):
    what, scene = PageExport(400, 0.0, photographs=2, max_views=0), hall_scene()
    with torch.no_grad():
        page = what.export(hall_model(), record_of(scene), tmp_path, 1 << 14, run_of(scene))[0]
    with opened(page.as_uri(), 256, 360) as driver:
        wait_for(driver, "still")
        hide_controls(driver)
        found = shot(driver)
        height, width = found.shape[:2]
        assert psnr(found, drawn(page, read_page(page)[0]["first"], width, height, 0.0)) > 38
        assert found.std() > 0.1
        assert found.min(axis=2).mean() > 0.05  # the wall is there
        framed = "return document.body.classList.contains('framed')"  # dark outside of the photograph's frame
        assert driver.execute_script(framed)
        drag(driver, 10, 0)
        wait_for(driver, "still")
        assert not driver.execute_script(framed)
        assert driver.get_log("browser") == []


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """A page of a capture in other units and axes, with an orbit of ten seconds; and its record."""
    what, scene = PageExport(400, 0.0, photographs=3, max_views=0), all_around()
    turn = torch.linalg.qr(torch.tensor([[0.2, 1.0, 0.3], [-0.5, 0.1, 1.0], [1.0, 0.4, 0.2]]))[0]
    record = record_of(scene, to_user=similarity(turn * turn.det(), torch.tensor([50.0, -3.0, 2.0]), 3.0))
    orbit = page_path(Orbit(120, fps=12), record, tmp_path_factory.mktemp("run"))
    with torch.no_grad():
        return what.export(
            shiny_model(), record, tmp_path_factory.mktemp("moving"), 65_536, replace(run_of(scene), keyframes=orbit)
        )[0], record


def seen_by(path, page, record, second: float, found: np.ndarray) -> np.ndarray:
    """What the program's camera of this second sees in a window like the one that was found."""
    cameras = lay_path(path, record)[round(second * path.fps)]
    height, width = found.shape[:2]
    size = (int(cameras.width), int(cameras.height))
    return drawn_through(page, cameras.c2w, cameras.focal[0], size, width, height)


def to_second(driver, second: float) -> np.ndarray:
    line = "const time = document.getElementById('time'); time.value = arguments[0];"
    driver.execute_script(f"{line} time.dispatchEvent(new Event('input'))", str(second))
    wait_for(driver, "still")
    return shot(driver)


def test_a_camera_path_is_played_as_it_is_filmed_and_one_that_is_recorded_is_filmed_as_it_was_played(moving, tmp_path):
    page, record = moving
    with opened(page.as_uri(), 256, 480) as driver:
        run = driver.execute_script
        saves = {"behavior": "allow", "downloadPath": str(tmp_path)}
        driver.execute_cdp_cmd("Browser.setDownloadBehavior", saves)
        wait_for(driver, "still")
        assert run("return document.getElementById('length').value") == "0.0 / 10.0 s"
        hide_controls(driver)
        found = to_second(driver, 4.25)
        assert found.std() > 0.1
        assert psnr(found, seen_by(Orbit(120, fps=12), page, record, 4.25, found)) > 36  # a curve through 25 of 120
        press(driver, " ")
        wait_for(driver, "moving")
        assert run("return document.getElementById('play').textContent") == "Pause"
        press(driver, " ")
        wait_for(driver, "still")
        for view in range(3):
            run(f"document.querySelectorAll('#photographs button')[{view}].click()")
            drag(driver, 30, 10)
            wait_for(driver, "still")
            recorded = shot(driver)
            press(driver, "v")
            name_it(driver, f"view {view}")
        assert run("return document.getElementById('length').value") == "0.0 / 4.0 s"
        run("document.getElementById('save').click()")
        file = tmp_path / "camera_path.yaml"
        wait_until_there(file)
        config = compose_config("render", ["ckpt=RUN", "path=keyframes", f"path.file={file}"]).config
        path = build(config.path)
        assert len(lay_path(path, record).c2w) == 121
        for second in (1.5, 4.0):
            found = to_second(driver, second)
            assert psnr(found, seen_by(path, page, record, second, found)) > 38
        assert psnr(found, recorded) > 38
        for _ in range(2):
            run("document.querySelector('#views button').click()")
            press(driver, "delete")
        assert run("return document.getElementById('length').value") == "0.0 / 10.0 s"
        assert driver.get_log("browser") == []
    # And filmed by the program itself.
    shots = make_shots([Subject(shiny_model(), record, "white")], replace_frames(path, 3), 65_536)
    assert float(shots[0].picture(1).opacity.max()) > 0.9


def replace_frames(path: KeyframePath, num_frames: int) -> KeyframePath:
    path.asked_frames = num_frames
    return path


@pytest.mark.parametrize("page", [2], indirect=True)
def test_what_is_wrong_is_said_on_the_page(page, tmp_path):
    whole, broken = page.read_text(), tmp_path / "broken.html"
    payload = whole.index('id="splats">') + len('id="splats">')
    cases = {
        whole[: payload + 2000]: "This file is not whole: 0.00 MB of the scene's",
        whole[: whole.index('<script type="application/json"')]: "the file is not whole",
        whole[: payload + 400] + "AAAAAAAA" + whole[payload + 408 :]: "The scene in this file is damaged",
        whole.replace('"splats": ', '"splats": 1'): "The scene in this file is damaged",
    }
    with opened("about:blank", 256, 360) as driver:
        for text, said in cases.items():
            broken.write_text(text)
            driver.get(broken.as_uri())
            if 'id="splats"' in text:
                wait_for(driver, "refused")
            assert said in driver.execute_script(MESSAGE)
            assert driver.execute_script("return document.getElementById('still').naturalWidth") > 0
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": WITHOUT})
        driver.get(page.as_uri())
        wait_for(driver, "refused")
        assert "does not have WebGL2" in driver.execute_script(MESSAGE)
        shown = "return getComputedStyle(document.getElementById('still')).display"
        assert driver.execute_script(shown) != "none"
