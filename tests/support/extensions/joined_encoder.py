"""The features of two encoders, side by side."""

import torch

from nerf_lightning.nerf.encoders.base import Encoder


class JoinedEncoder(Encoder):
    def __init__(self, first: Encoder, second: Encoder):
        super().__init__()
        self.first, self.second = first, second
        self.needs_unit_cube = first.needs_unit_cube or second.needs_unit_cube

    @property
    def out_dim(self) -> int:
        return self.first.out_dim + self.second.out_dim

    def forward(self, points):
        return torch.cat([self.first(points), self.second(points)], dim=-1)

    def attach_gradients(self, points, features):
        sizes = [self.first.out_dim, self.second.out_dim]
        first, second = features.split(sizes, dim=-1)
        return torch.cat([self.first.attach_gradients(points, first), self.second.attach_gradients(points, second)], -1)

    def reset_parameters(self):
        self.first.reset_parameters()
        self.second.reset_parameters()
