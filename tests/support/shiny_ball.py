"""A ball whose color depends on where it is seen from."""

from dataclasses import replace

from support.known_fields import SolidField, ball
from support.scenes import ball_scene

from nerf_lightning.checkpoints.record import scene_record
from nerf_lightning.export.base import RunContext
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
    soft = distance or (lambda positions: 0.2 * ball(RADIUS)(positions))
    field = ShinyField(soft, **({"inside": 100.0} | settings))
    return RadianceModel({"fine": DenseLevel(StratifiedSampler(256), field)}).eval()


def all_around(size: int = 32, **changes):
    """The scene, all of whose views train and test."""
    views = tuple(range(6))
    return replace(ball_scene(num_views=6, size=size), splits={"train": views, "test": views}, **changes)


def record_of(scene, **changes):
    return replace(scene_record(scene), **changes)


def run_of(scene, *facts) -> RunContext:
    return RunContext(scene, facts=tuple(facts))
