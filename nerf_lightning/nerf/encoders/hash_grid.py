"""Learned features on a multiresolution hash grid (Sec. 3, arXiv 2201.05989).

Sizes: conf/encoder/hash_grid*.yaml, for model=auto `config/auto_settings.py`. Resolutions of levels:
`kernels/hash_grid/layout.py`.
"""

import math

import psutil
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from nerf_lightning.messages.errors import ANOTHER, InputError
from nerf_lightning.nerf.encoders.base import Encoder
from nerf_lightning.nerf.kernels.hash_grid.layout import HashGridLayout, hash_grid_layout
from nerf_lightning.nerf.kernels.hash_grid.op import interpolate
from nerf_lightning.nerf.part import StepContext
from nerf_lightning.nerf.ranges import require_ranges

INITIAL_RANGE = 1e-4
# Weights, gradients and Adam's two moments, in float32.
BYTES_PER_PARAMETER = 16
MOST_LEVELS = 64
FINEST = 1 << 24
"""Number of cells that float32 can distinguish."""


class HashGridEncoder(Encoder):
    """Concatenate features interpolated trilinearly in grids of growing resolution.

    Points are in the unit cube, so a field that maps its positions there is needed (`field=ngp`). A level whose
    vertices fit into its table is dense; a finer one shares entries through a hash, and training resolves the
    collisions.

    Finer levels may be blended in one after another, from coarse to fine, over the first share of the run (Sec. 3.3,
    arXiv 2104.06405; for hash grids Heo et al., ICML 2023): until then the scene is smooth, which helps cameras find
    their place and geometry its rough shape. Levels that are not on yet are not computed.

    Args:
        num_levels: number of grids.
        features_per_level: features per vertex.
        log2_table_size: maximum number of entries per level, as a power of two.
        min_resolution: cells along a side of the coarsest grid.
        max_resolution: cells along a side of the finest grid; about the scene's size over its smallest detail.
        blend_in: share of the run over which levels are blended in, from coarse to fine; 0: all from the start.

    Raises:
        InputError: training the tables would not fit into the machine's memory.
    """

    needs_unit_cube = True
    level_weights: Tensor

    def __init__(
        self,
        num_levels: int = 8,
        features_per_level: int = 4,
        log2_table_size: int = 18,
        min_resolution: int = 16,
        max_resolution: int = 512,
        blend_in: float = 0.0,
    ):
        super().__init__()
        if not 1 <= min_resolution <= max_resolution or num_levels < 1 or features_per_level < 1:
            raise ValueError("1 <= min_resolution <= max_resolution, and at least one level and feature are needed")
        if num_levels > MOST_LEVELS:
            raise ValueError(f"num_levels={num_levels}: give {MOST_LEVELS} at most")
        require_ranges(locals(), {"log2_table_size": (1, 30), "max_resolution": (1, FINEST), "blend_in": (0.0, 1.0)})
        self.layout = hash_grid_layout(num_levels, log2_table_size, min_resolution, max_resolution)
        self.features_per_level, self.blend_in = features_per_level, blend_in
        self._weights = [1.0] * num_levels  # mirrors the buffer, which is not read at each step
        if blend_in:
            # In the checkpoint, so that it renders as the last step did.
            self.register_buffer("level_weights", torch.ones(num_levels))
        _require_memory(self.layout.offsets[-1] * features_per_level)
        self.table = nn.Parameter(torch.empty(self.layout.offsets[-1], features_per_level))
        self.reset_parameters()

    @property
    def out_dim(self) -> int:
        """Number of levels times features per level."""
        return len(self.layout.resolutions) * self.features_per_level

    def forward(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points features"]:
        """Return the features, coarsest level first."""
        return self._interpolate(points, None)

    def tables(self) -> list[nn.Parameter]:
        """Return the single table that holds all levels."""
        return [self.table]

    def grid(self) -> tuple[Tensor, HashGridLayout] | None:
        """Return the table and its layout; None while levels are blended in."""
        return None if self._blends else (self.table, self.layout)

    def attach_gradients(
        self, points: Float[Tensor, "*points 3"], features: Float[Tensor, "*points features"]
    ) -> Float[Tensor, "*points features"]:
        """Return known features of points, computed before without gradients, with gradients attached."""
        # While levels are blended in they are computed again: the known features are weighted.
        return self._interpolate(points, None if self._blends else features.reshape(-1, self.out_dim))

    @property
    def replays(self) -> bool:  # type: ignore[override]
        """Whether blending is off."""
        return not self.blend_in

    def on_step(self, context: StepContext) -> None:
        """Update the blending weights: level l (from 0) rises over the l-th part of `blend_in`."""
        if self.blend_in:
            self._set_weights(blending_weights(len(self.layout.resolutions), context.progress / self.blend_in))

    def validate_state(self) -> None:
        """Check the loaded state.

        Raises:
            InputError: invalid level weights.
        """
        if self.blend_in:
            weights = self.level_weights.tolist()
            if not all(0.0 <= weight <= 1.0 for weight in weights):
                raise InputError(f"The weights of the levels in the encoder's state are not valid. {ANOTHER}")
            self._set_weights(weights)

    def _set_weights(self, weights: list[float]) -> None:
        if weights != self._weights:
            self._weights = weights
            self.level_weights.copy_(torch.tensor(weights))

    @property
    def _blends(self) -> bool:
        return self._weights[-1] < 1.0

    def _interpolate(self, points: Tensor, cached: Tensor | None) -> Tensor:
        if not self._blends:
            features = interpolate(self.table, points.reshape(-1, 3), self.layout, cached)
        else:
            levels = sum(weight > 0.0 for weight in self._weights)
            features = interpolate(self.table, points.reshape(-1, 3), self.layout.coarsest(levels))
            features = features * self.level_weights[:levels].repeat_interleave(self.features_per_level)
            features = functional.pad(features, (0, self.out_dim - features.shape[-1]))
        return features.view(*points.shape[:-1], self.out_dim)

    def reset_parameters(self) -> None:
        """Reinitialize the tables, uniform in [-1e-4, 1e-4] as in the paper."""
        nn.init.uniform_(self.table, -INITIAL_RANGE, INITIAL_RANGE)


def blending_weights(num_levels: int, share: float) -> list[float]:
    """Return the weight of each level, coarsest first, `share` of the way from the coarsest alone to all of them.

    w_l = (1 - cos(pi a)) / 2 with a = share (L - 1) - (l - 1), clamped to [0, 1] (Eq. 14, arXiv 2104.06405).

    >>> [[round(weight, 3) for weight in blending_weights(3, share)] for share in (0.0, 0.75, 1.0)]
    [[1.0, 0.0, 0.0], [1.0, 1.0, 0.5], [1.0, 1.0, 1.0]]
    """
    risen = [min(1.0, max(0.0, share * (num_levels - 1) - (level - 1))) for level in range(1, num_levels)]
    return [1.0, *(0.5 - 0.5 * math.cos(math.pi * part) for part in risen)]


def _require_memory(num_parameters: int) -> None:
    needed, there = BYTES_PER_PARAMETER * num_parameters, psutil.virtual_memory().total
    if needed > 0.8 * there:
        raise InputError(
            f"encoder=hash_grid: its tables have {num_parameters:,} parameters, and training them takes "
            f"{needed / 2**30:.1f} GiB (weights, gradients, Adam's moments) of the {there / 2**30:.1f} GiB of this "
            "machine. Lower encoder.log2_table_size (one less halves it), encoder.num_levels or "
            "encoder.features_per_level."
        )
