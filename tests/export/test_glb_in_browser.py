"""A GLB as a viewer shows it that knows the standard, three.js in a real browser: y is up, and colours are as seen."""

import io
from dataclasses import replace

import numpy as np
import pytest
import torch
import viser
from PIL import Image
from support.browser import opened, wait_until
from support.known_fields import ball, solid
from support.ports import unused_port
from support.scenes import ball_scene

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.export.mesh import MeshExport
from nerf_lightning.nerf.geometry.frames import similarity, upright_rotation

pytestmark = pytest.mark.slow

RED, BLUE = (230, 20, 20), (20, 20, 230)


def test_what_was_up_is_up(tmp_path):
    """A ball in a capture that lay on its side: red on top, as the photographer saw it, and blue below."""

    def color(points):
        return torch.where(points[..., 2:] > 0, torch.tensor(RED), torch.tensor(BLUE)) / 255

    to_user = similarity(upright_rotation(torch.tensor([0.6, 0.0, 0.8])).mT, torch.zeros(3), 1.0).float()
    scene = replace(scene_record(ball_scene(num_views=8, size=24)), to_user=to_user)
    what = MeshExport(resolution=24, seen_only=False, format="glb")
    (path,) = what.export(solid(ball(), color=color), scene, tmp_path, 1 << 15)
    server = viser.ViserServer(host="127.0.0.1", port=unused_port(), verbose=False)
    try:
        server.scene.set_up_direction("+y")
        server.initial_camera.position, server.initial_camera.look_at = (0.0, 0.0, 3.0), (0.0, 0.0, 0.0)
        server.scene.add_glb("/ball", path.read_bytes(), cast_shadow=False, receive_shadow=False)
        with opened(f"http://127.0.0.1:{server.get_port()}", 900, 500) as driver:
            wait_until(driver, lambda _: near(driver, RED) is not None and near(driver, BLUE) is not None)
            top, below = near(driver, RED), near(driver, BLUE)
    finally:
        server.stop()
    assert top[1] < below[1] - 30
    assert abs(top[0] - below[0]) < 10


def near(driver, color) -> np.ndarray | None:
    """Return the middle (x, y) of the pixels of about a colour, where there are enough."""
    shot = np.array(Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")).astype(int)
    rows, columns = np.nonzero((np.abs(shot - color) < 40).all(axis=-1))
    return None if len(rows) < 500 else np.array([columns.mean(), rows.mean()])
