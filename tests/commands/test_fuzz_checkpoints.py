"""Checkpoints altered anywhere: refused in one paragraph, or as good as sound, whatever is done with them."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.altered import alterations
from support.fuzzing import fuzzed, harmless
from support.resumed import Resumed
from support.running import FAST_PATH

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.config.load_model import load_model
from nerf_lightning.files.budgets import Budgets, allow
from nerf_lightning.nerf.geometry.cameras import rays_through_pixels
from nerf_lightning.nerf.types.rays import PixelIndex


@pytest.fixture(scope="module")
def runs(stopped, stopped_fast, capture, tmp_path_factory):
    fast = Resumed(stopped_fast, capture, tmp_path_factory.mktemp("fast"), *FAST_PATH)
    return [Resumed(stopped, capture, tmp_path_factory.mktemp("nerf")), fast]


@pytest.fixture(scope="module", autouse=True)
def _short_marches():
    allow(Budgets(intervals=4096))
    yield
    allow(Budgets())


def render_a_pixel(file):
    checkpoint = read_checkpoint(file)
    model, scene = load_model(checkpoint), checkpoint.scene
    zero = torch.zeros(3, dtype=torch.int64)
    rays = rays_through_pixels(scene.cameras, PixelIndex(view=zero, x=zero, y=zero + 1), scene.near, scene.far)
    with torch.no_grad():
        rgb = model(rays, None, random=None)[-1].rgb
    assert bool(torch.isfinite(rgb).all())


@fuzzed(50)
@given(st.data())
def test_an_altered_checkpoint(runs, data):
    run = data.draw(st.sampled_from(runs))
    torch.save(data.draw(alterations(run.whole)).content, run.file)
    harmless(render_a_pixel, run.file)
    harmless(run.take_file)
