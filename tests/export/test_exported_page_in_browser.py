"""The page in a real browser: it shows what the marcher computes, asks for nothing, and says what is wrong."""

import io
import time

import numpy as np
import pytest
import torch
from PIL import Image
from support.baked_ball import all_around, beside, record_of, shiny_model
from support.browser import drag, opened

from nerf_lightning.export.baking.cost import over
from nerf_lightning.export.baking.marcher import Marcher
from nerf_lightning.export.page import PageExport
from nerf_lightning.export.page_file import read_baked
from nerf_lightning.nerf.geometry.cameras import pinhole_cameras
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import view_rays

pytestmark = pytest.mark.slow

STATE = "return document.body.dataset.state"
MESSAGE = "return document.getElementById('message').textContent"
WITHOUT = "HTMLCanvasElement.prototype.getContext = () => null;"


@pytest.fixture(scope="module", params=["small", pytest.param("large", marks=pytest.mark.exhaustive)])
def page(request, tmp_path_factory):
    """With harmonics of degree 1, and of degree 2."""
    what, scene = PageExport(request.param, 32, photographs=3, max_views=0), all_around()
    what.beside = beside(scene)
    with torch.no_grad():
        return what.export(shiny_model(), record_of(scene), tmp_path_factory.mktemp("page"), 4096)[0]


def wait_for(driver, *states: str) -> None:
    end = time.monotonic() + 90
    while driver.execute_script(STATE) not in states:
        assert time.monotonic() < end, driver.execute_script(MESSAGE)
        time.sleep(0.2)


def shot(driver) -> np.ndarray:
    return np.array(Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")).astype(float) / 255


def press(driver, key: str) -> None:
    event = "new KeyboardEvent('keydown', {key: arguments[0], bubbles: true})"
    driver.execute_script(f"document.body.dispatchEvent({event})", key)


def marched(page, view: int, width: int, height: int) -> np.ndarray:
    """What the file shows through a camera in a window, its picture in the middle."""
    about, baked = read_baked(page)
    lens = about["cameras"][view]
    scale = min(width / lens["width"], height / lens["height"])
    c2w = torch.tensor([*lens["axes"], lens["eye"]]).T[None]
    cameras = pinhole_cameras(c2w, scale * lens["focal"][0], width, height)
    rays, _ = view_rays(RayGenerator(cameras, torch.zeros(1), torch.ones(1)), 0)
    return over(Marcher(baked).render(rays), "white").clamp(0, 1).numpy()


def psnr(one, other) -> float:
    return float(-10 * np.log10(np.mean((one - other) ** 2)))


def test_it_shows_what_the_marcher_computes_and_asks_for_nothing(page):
    with opened(page.as_uri(), 256, 360) as driver:
        run = driver.execute_script
        wait_for(driver, "still")
        run("document.body.classList.add('bare')")
        found = shot(driver)
        height, width = found.shape[:2]
        assert psnr(found, marched(page, 0, width, height)) > 38
        # Not because all is white.
        assert found.std() > 0.1
        assert run("return performance.getEntriesByType('resource').length") == 0
        assert driver.get_log("browser") == []
        run("document.querySelectorAll('#photographs button')[1].click(); document.getElementById('wipe').value = 0")
        run("dispatchEvent(new Event('resize'))")
        wait_for(driver, "still")
        assert psnr(shot(driver), marched(page, 1, width, height)) > 38
        before = shot(driver)
        drag(driver, 40, 0)
        wait_for(driver, "still")
        assert psnr(shot(driver), before) < 35


@pytest.mark.parametrize("page", ["small"], indirect=True)
def test_the_photograph_lies_over_its_camera_and_other_things_can_be_shown(page):
    with opened(page.as_uri(), 256, 360) as driver:
        run = driver.execute_script
        wait_for(driver, "still")
        run("document.querySelectorAll('#photographs button')[1].click()")
        wait_for(driver, "still")
        box = run("const b = document.getElementById('photograph').getBoundingClientRect(); return [b.width, b.height]")
        assert box[0] == pytest.approx(box[1])
        assert not run("return document.getElementById('photograph').hidden")
        run("document.getElementById('wipe').value = 0; document.body.classList.add('bare')")
        run("dispatchEvent(new Event('resize'))")
        wait_for(driver, "still")
        colors = shot(driver)
        for number in (1, 2):
            press(driver, str(number + 1))
            wait_for(driver, "still")
            assert np.abs(shot(driver) - colors).mean() > 0.02
        press(driver, "i")
        assert run("return document.getElementById('numbers').open")


@pytest.mark.parametrize("page", ["small"], indirect=True)
def test_what_is_wrong_is_said_on_the_page(page, tmp_path):
    whole, broken = page.read_text(), tmp_path / "broken.html"
    payload = whole.index('id="field">') + len('id="field">')
    cases = {
        whole[: payload + 2000]: "This file is not whole: 0.00 MB of the scene's",
        whole[: whole.index('<script type="application/json"')]: "the file is not whole",
        whole[: payload + 400] + "AAAAAAAA" + whole[payload + 408 :]: "The scene in this file is damaged",
        whole.replace('"bricks": ', '"bricks": 1'): "The scene in this file is damaged",
    }
    with opened("about:blank", 256, 360) as driver:
        for text, said in cases.items():
            broken.write_text(text)
            driver.get(broken.as_uri())
            if 'id="field"' in text:
                wait_for(driver, "refused")
            assert said in driver.execute_script(MESSAGE)
            assert driver.execute_script("return document.getElementById('still').naturalWidth") > 0
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": WITHOUT})
        driver.get(page.as_uri())
        wait_for(driver, "refused")
        assert "does not have WebGL2" in driver.execute_script(MESSAGE)
        shown = "return getComputedStyle(document.getElementById('still')).display"
        assert driver.execute_script(shown) != "none"
