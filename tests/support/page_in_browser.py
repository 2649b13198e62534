"""An exported page in a browser: waiting for it, keys, pictures of it, and what its file shows by the marcher."""

import io
import time

import numpy as np
import torch
from PIL import Image
from support.baked_ball import read_baked

from nerf_lightning.export.baking.cost import over
from nerf_lightning.export.baking.marcher import Marcher
from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import view_rays

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


def marched(page, view: int, width: int, height: int, behind="white") -> np.ndarray:
    """What the file shows through a camera in a window, its picture in the middle."""
    lens = read_baked(page)[0]["cameras"][view]
    c2w = torch.tensor([*lens["axes"], lens["eye"]]).T
    return marched_through(page, c2w, lens["focal"][0], (lens["width"], lens["height"]), width, height, behind)


def marched_through(page, c2w, focal, size, width, height, behind="white") -> np.ndarray:
    about, baked = read_baked(page)
    small, large = sorted((width / size[0], height / size[1]))
    scale = small * (large / small) ** (1 / 3 if about["contraction"] else 0)
    cameras = pinhole_cameras(c2w[None].float(), scale * float(focal), width, height)
    rays, _ = view_rays(RayGenerator(cameras, torch.zeros(1), torch.ones(1)), all_pixels(cameras, 0))
    return over(Marcher(baked).render(rays), behind).clamp(0, 1).numpy()


def psnr(one, other) -> float:
    return float(-10 * np.log10(np.mean((one - other) ** 2)))


def wait_until_there(file) -> None:
    end = time.monotonic() + 30
    while not file.exists():
        assert time.monotonic() < end
        time.sleep(0.1)
