"""Products of the features of three planes, kept smooth by their total variation (K-Planes, arXiv 2301.10241)."""

import torch
from torch import nn
from torch.nn.functional import grid_sample

from nerf_lightning.nerf.encoders.base import Encoder

PLANES = ((0, 1), (0, 2), (1, 2))


class KPlanesEncoder(Encoder):
    needs_unit_cube = True

    def __init__(self, resolution: int = 32, features: int = 8, total_variation: float = 1e-2):
        super().__init__()
        self.features, self.total_variation = features, total_variation
        self.planes = nn.Parameter(torch.empty(3, features, resolution, resolution))
        self.reset_parameters()

    @property
    def out_dim(self) -> int:
        return self.features

    def forward(self, points):
        cube = 2.0 * points.reshape(-1, 3) - 1.0
        places = torch.stack([cube[:, axes] for axes in PLANES])[:, None]
        found = grid_sample(self.planes, places, align_corners=True)[:, :, 0].prod(dim=0)
        return found.T.reshape(*points.shape[:-1], self.features)

    def penalty(self):
        steps = self.planes.diff(dim=2).square().mean() + self.planes.diff(dim=3).square().mean()
        return self.total_variation * steps if self.total_variation else None

    def reset_parameters(self):
        nn.init.uniform_(self.planes, 0.1, 0.5)
