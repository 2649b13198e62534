"""A scene-independent model: it renders any scene from its photographs (GNT, ICLR 2023, arXiv 2207.13298)."""

import logging
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nerf_lightning.extensions.view_transformer.block import Block
from nerf_lightning.extensions.view_transformer.experts import imbalance, roughness
from nerf_lightning.extensions.view_transformer.image_network import ImageNetwork, ImageNorm
from nerf_lightning.extensions.view_transformer.nearest_view import baselines
from nerf_lightning.extensions.view_transformer.projection import Projected, project_samples
from nerf_lightning.extensions.view_transformer.source_views import SourceViews, choose_sources
from nerf_lightning.extensions.view_transformer.view_tables import ViewTables
from nerf_lightning.extensions.view_transformer.views import BlendedColor, Largest, PooledColor, Spread, Views
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.matmul_precision import Linear
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.randomness import RayRandom
from nerf_lightning.nerf.ranges import require_ranges
from nerf_lightning.nerf.samplers.base import DenseSampler
from nerf_lightning.nerf.types.photographs import Photographs
from nerf_lightning.nerf.types.rays import RayBundle, RaySamples
from nerf_lightning.nerf.types.renderings import DenseRendering, Rendering
from nerf_lightning.nerf.types.scene import DRAWN

DEEP = 8.0
"""Ratio of a ray's far to near beyond which it is sampled evenly in inverse distance."""
NEAREST = 1e-3
"""Minimum start of a ray's samples as a share of its end: 0 has no inverse."""
RANGES = {
    "width": (8, 1024),
    "blocks": (1, 64),
    "heads": (1, 64),
    "num_sources": (1, 64),
    "image_features": (1, 1024),
    "image_scale": (2, 8),
    "image_width": (1, 1024),
    "image_blocks": (0, 16),
    "experts": (0, 64),
    "balance": (0.0, 1e6),
    "smoothness": (0.0, 1e6),
}

LEAST_SEEN = 0.5
"""Minimum share of a render's rays that are seen: a few rays beyond the corners of all photographs are normal."""
STARTS = {"largest": Largest, "spread": Spread}
COLORS = {"pooled": PooledColor, "blended": BlendedColor}

log = logging.getLogger(__name__)


class ViewTransformer(Model):
    """Features of photographs at projections of a ray's points; attention over views, then along the ray; color.

    There is no density and no compositing: the color follows from the points' states, over the background of the
    photographs. Opacity is 1, or 0 if no source sees the ray. Depth is the mean distance under the attention of the
    last block. Dropout is omitted, so that runs are reproducible bit for bit.

    Args:
        sampler: where along the rays; evenly in inverse distance where a ray ends beyond 8 times its beginning.
        width: width of the states of points.
        blocks: number of blocks, each with attention across views, then along the ray.
        heads: heads of the attention along the ray.
        num_sources: photographs from which a view is rendered; in training up to two more or fewer.
        image_features: channels of the image network.
        image_scale: pixels of a photograph per feature, along each side: 2, 4 or 8.
        image_width: channels of the image network at half the photographs' size.
        image_blocks: residual blocks of the image network at each of its sizes.
        image_rate: the initial learning rate of the image network; null: that of the rest.
        image_norm: how photographs are normalized before the image network, against different exposures: none; instance
            (mean 0 and standard deviation 1 in each channel); neurn (the local deviation, arXiv 2505.06894).
        start: the initial state of a point: largest (the maximum over views in each channel, as published), or spread
            (also their variance, which shows whether they see the same point).
        color: how a ray's color follows from the states of its points: pooled (a linear layer on their mean, as
            published), or blended (the source colors, weighted by two attentions, plus a correction from the mean;
            learns in fewer steps).
        experts: number of experts that replace the feed-forward layer after the views in every second block, with top-2
            routing per point and one shared expert (GNT-MOVE, ICCV 2023); 0: none.
        balance: weight of the load-balancing loss.
        smoothness: weight of the smoothness loss: neighboring rays should choose the same experts.

    Raises:
        ValueError: a number is out of range, or the width is not divisible by the heads.
    """

    needs_photographs = True
    baselines = staticmethod(baselines)
    has_static_shapes = False
    replays = False

    def __init__(
        self,
        sampler: DenseSampler,
        width: int = 64,
        blocks: int = 8,
        heads: int = 4,
        num_sources: int = 10,
        image_features: int = 32,
        image_scale: int = 4,
        image_width: int = 64,
        image_blocks: int = 3,
        image_rate: float | None = 1e-3,
        image_norm: ImageNorm = "none",
        start: Literal["largest", "spread"] = "largest",
        color: Literal["pooled", "blended"] = "pooled",
        experts: int = 0,
        balance: float = 0.01,
        smoothness: float = 0.01,
    ):
        super().__init__()
        require_ranges(locals(), RANGES)
        if width % heads:
            raise ValueError(f"width={width} cannot be shared by heads={heads}: give a multiple")
        if image_scale & (image_scale - 1):
            raise ValueError(f"image_scale={image_scale}: give 2, 4 or 8")
        if experts in (1, 2):
            raise ValueError(f"experts={experts}: give 0 for none, or 3 at least, of which two are chosen")
        self.sampler, self.num_sources = sampler, num_sources
        self.balance, self.smoothness = balance, smoothness
        self.image_network = ImageNetwork(image_features, image_scale, image_width, image_blocks, image_norm)
        self.image_network.learning_rate = image_rate
        self.look = nn.Sequential(Linear(image_features + 3, width), nn.ReLU(inplace=True), Linear(width, width))
        self.begin = STARTS[start](width)
        self.blocks = nn.ModuleList(
            Block(width, heads, encoded=number % 2 == 0, experts=experts if number % 2 else 0)
            for number in range(blocks)
        )
        self.color = COLORS[color](width)
        self.tables: ViewTables | None = None
        self.warned = False

    @property
    def level_names(self) -> tuple[str, ...]:
        """There is one level."""
        return ("views",)

    def set_source_images(self, photographs: Photographs) -> None:
        """Set the photographs that rays are rendered from, replacing earlier ones.

        Raises:
            InputError: a capture has fewer photographs than views are rendered from, or a random background.
        """
        if photographs.background in DRAWN:
            raise InputError(
                "model=view_transformer renders what photographs show, and they do not show "
                f"scene.background={photographs.background}: give scene.background=white or black."
            )
        counts = torch.bincount(photographs.capture)
        fewest = int(counts[counts > 0].min()) if len(counts) else 0
        if fewest < self.num_sources:
            raise InputError(
                f"model=view_transformer renders each view from {self.num_sources} photographs, and a capture has "
                f"{fewest} to look at: give it more training views, or model.num_sources={max(1, fewest - 1)}."
            )
        self.tables, self.warned = ViewTables(photographs), False

    def forward(
        self, rays: RayBundle, background: Float[Tensor, "*rays 3"] | None, random: RayRandom | None
    ) -> list[Rendering]:
        """Render a flat batch of rays from the photographs around them.

        Args:
            rays: unit directions, in the world, scene units.
            background: the color if no source sees any of the ray; None: black.
            random: the step's random numbers for these rays; None for evaluation.

        Raises:
            InputError: there are no photographs to render from.
        """
        tables = self.tables
        if tables is None:
            raise InputError("model=view_transformer was given no photographs: call set_source_images first.")
        tables.move_to(rays.near.device)
        photographs = tables.photographs
        sources = choose_sources(photographs, rays, self.num_sources, random)
        samples = self._samples(rays, random)
        of_ray = sources.views[sources.target]
        projected = project_samples(photographs.cameras, tables.least_cosine, of_ray, rays, samples.midpoints)
        visible = projected.visible & sources.valid[sources.target][:, None]
        projected = replace(projected, visible=visible)
        views = self._looked_up(tables, sources, projected)
        states = self.begin(views)
        positions = rays.origins[:, None] + samples.midpoints[..., None] * rays.directions[:, None]
        penalty, weights = None, None
        for number, block in enumerate(self.blocks):
            last = number == len(self.blocks) - 1
            states, gates, weights = block(states, views, positions, rays, random, last)
            if gates is not None and random is not None:
                of_block = self.smoothness * roughness(gates, rays, sources.target) + self.balance * imbalance(gates)
                penalty = of_block if penalty is None else penalty + of_block
        rgb, weights = self.color(states, views, weights)
        seen = visible.flatten(1).any(dim=1)
        opacity = seen.to(rgb)
        self._warn_of_unseen(opacity)
        behind = torch.zeros_like(rgb) if background is None else background
        return [
            DenseRendering(
                rgb=torch.where(seen[:, None], rgb, behind),
                foreground=rgb * opacity[:, None],
                opacity=opacity,
                depth=(weights * samples.midpoints).sum(dim=-1),
                weights=weights,
                samples=samples,
                penalty=penalty,
            )
        ]

    def points_per_ray(self, training: bool) -> float:
        """Return samples times sources: each point is looked up in every view."""
        return float(self.sampler.num_samples_after(0) * self.num_sources)

    def reset_parameters(self) -> None:
        """Reinitialize every parameter from torch's generator."""
        for module in reversed(list(self.modules())):  # a module overrides the initialization of its submodules
            reset = getattr(module, "reset_parameters", None)
            if module is not self and reset is not None:
                reset()

    def _samples(self, rays: RayBundle, random: RayRandom | None) -> RaySamples:
        far = rays.far
        near = rays.near.maximum(NEAREST * far)
        deep = (far > DEEP * near)[:, None]
        even = self.sampler(replace(rays, near=near, far=far), [], random).edges
        inverse = self.sampler(replace(rays, near=1.0 / near, far=1.0 / far), [], random).edges
        return RaySamples(torch.where(deep, 1.0 / inverse, even))

    def _looked_up(self, tables: ViewTables, sources: SourceViews, projected: Projected) -> Views:
        views, numbered = torch.unique(sources.views, return_inverse=True)
        numbers = views.tolist()
        view = numbered[sources.target][:, None].expand(projected.visible.shape)
        features = tables.features(views, numbers, self.image_network).look_up(view, projected.xy)
        colors = tables.colors(views, numbers).look_up(view, projected.xy)
        return Views(self.look(torch.cat([colors, features], dim=-1)), colors, projected.turned, projected.visible)

    def _warn_of_unseen(self, opacity: Float[Tensor, "rays"]) -> None:
        if not self.training and not self.warned and float(opacity.mean()) < LEAST_SEEN:
            self.warned = True
            log.warning(
                "no photograph sees most of the rays, so they show the background: the camera is outside what the "
                "capture covers"
            )
