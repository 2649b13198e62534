"""An exported page in a browser: waiting for it, keys, pictures of it, and what its file shows by the rasterizer."""

import io
import time
from unittest import mock

import numpy as np
import torch
from PIL import Image
from support.splat_page import read_page

from nerf_lightning.extensions.splats import gaussians
from nerf_lightning.extensions.splats.gaussians import Pinhole
from nerf_lightning.extensions.splats.reference import rasterize
from nerf_lightning.nerf.geometry.cameras import pinhole_cameras

STATE = "return document.body.dataset.state"
MESSAGE = "return document.getElementById('message').textContent"


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


def name_it(driver, text: str) -> None:
    """Answer the page's form that asks for a name."""
    form = "document.querySelector('#naming form').requestSubmit(document.querySelector('#naming [value=save]'))"
    driver.execute_script(f"document.getElementById('name').value = arguments[0]; {form}", text)


def hide_controls(driver) -> None:
    """Let the scene have the whole window."""
    press(driver, "h")
    wait_for(driver, "still")


def drawn(page, view: int, width: int, height: int, behind=1.0) -> np.ndarray:
    """What the file shows through a camera in a window, its picture in the middle."""
    lens = read_page(page)[0]["cameras"][view]
    c2w = torch.tensor([*lens["axes"], lens["eye"]]).T
    return drawn_through(page, c2w, lens["focal"][0], (lens["width"], lens["height"]), width, height, behind)


def drawn_through(page, c2w, focal, size, width, height, behind=1.0) -> np.ndarray:
    about, splats = read_page(page)
    scale = min(width / size[0], height / size[1])
    camera = Pinhole.of(pinhole_cameras(c2w[None].float(), scale * float(focal), width, height), 0, about["near"])
    dilation = gaussians.DILATION * max(1.0, scale * float(focal) / about["focal"]) ** 2
    with mock.patch.object(gaussians, "DILATION", dilation):
        return rasterize(splats, camera, torch.full((3,), behind)).clamp(0, 1).numpy()


def psnr(one, other) -> float:
    return float(-10 * np.log10(np.mean((one - other) ** 2)))


def wait_until_there(file) -> None:
    end = time.monotonic() + 30
    while not file.exists():
        assert time.monotonic() < end
        time.sleep(0.1)
