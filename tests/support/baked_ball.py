"""A ball whose color depends on where it is seen from, baked, and its page."""

import base64
import gzip
import json
import re
from dataclasses import replace

import numpy as np
import torch
from support.known_fields import SolidField, ball
from support.scenes import ball_scene

from nerf_lightning.checkpoints.reading import scene_record
from nerf_lightning.export.baking.bake import bake
from nerf_lightning.export.baking.baked_field import BakedField
from nerf_lightning.export.baking.contraction import Contraction
from nerf_lightning.export.base import PageExtras
from nerf_lightning.nerf.models.dense_level import DenseLevel
from nerf_lightning.nerf.models.radiance_model import RadianceModel
from nerf_lightning.nerf.samplers.stratified import StratifiedSampler
from nerf_lightning.nerf.types.renderings import FieldOutput

RADIUS = 0.6


class ShinyField(SolidField):
    """Its color is its place, and its side that one looks from."""

    def forward(self, points, features=None):
        rgb = 0.5 + 0.3 * points.positions + 0.2 * points.directions
        return FieldOutput(self.density(points)[0], rgb.clamp(0, 1))


def shiny_model(distance=None, **settings) -> RadianceModel:
    """Soft enough for a coarse grid."""
    soft = distance or (lambda positions: 0.2 * ball(RADIUS)(positions))
    field = ShinyField(soft, **({"inside": 100.0} | settings))
    return RadianceModel({"fine": DenseLevel(StratifiedSampler(256), field)}).eval()


def all_around(size: int = 32, **changes):
    """The scene, all of whose views train and test."""
    views = tuple(range(6))
    return replace(ball_scene(num_views=6, size=size), splits={"train": views, "test": views}, **changes)


def record_of(scene, **changes):
    return replace(scene_record(scene), **changes)


def quiet(stage: str, share: float) -> None:
    """Take no note of progress."""


def baked_ball(resolution: int = 48, harmonics: int = 4, model=None, record=None):
    with torch.no_grad():
        return bake(model or shiny_model(), record or record_of(all_around()), resolution, harmonics, 4096, quiet)


def beside(scene, *facts) -> PageExtras:
    return PageExtras(scene, facts=tuple(facts))


def deserialized(about, content: bytes) -> BakedField:
    """The field of which `described` and `serialized` have made these."""
    blocks, colored, channels = about["blocks"], about["colored"], 3 * about["harmonics"]
    raw, ends = np.frombuffer(gzip.decompress(content), np.uint8), np.cumsum([4 * blocks, 512 * blocks, 64 * blocks])
    numbers, density, bits, colors = np.split(raw, ends)
    outside = about["contraction"]
    return BakedField(
        *(tuple(about[key]) for key in ("lower", "spacing", "shape")),
        np.frombuffer(numbers.tobytes(), "<i4"),
        density.reshape(blocks, 8, 8, 8),
        np.unpackbits(bits, bitorder="little").astype(bool).reshape(blocks, 8, 8, 8),
        colors.reshape(channels, colored),
        tuple(about["ranges"]),
        outside and Contraction(tuple(outside["center"]), outside["half"], outside["near"]),
        about["closed"],
    )


def read_baked(page):
    """What a page says of its scene, and the field in it."""
    text = page.read_text()
    about, field = (re.search(rf'id="{name}">([^<]*)</script>', text)[1] for name in ("about", "field"))
    return json.loads(about), deserialized(json.loads(about), base64.b64decode(field))
