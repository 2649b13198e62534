"""Cameras that may move: all that it takes is a parameter, and other cameras."""

from dataclasses import replace

import torch

from nerf_lightning.nerf.models.ray_generator import RayGenerator


class LearntShifts(RayGenerator):
    """Moves each camera; with a rate of its own, and a penalty, where it is given them."""

    def __init__(self, *given, learning_rate=None, weight=0.0):
        super().__init__(*given)
        self.shift = torch.nn.Parameter(torch.zeros(len(self.near), 3))
        self.learning_rate, self.weight = learning_rate, weight

    @property
    def cameras(self):
        given = super().cameras
        return replace(given, c2w=torch.cat([given.c2w[..., :3], given.c2w[..., 3:] + self.shift[..., None]], dim=-1))

    def penalty(self):
        return self.weight * (self.shift - 1.0).square().sum() if self.weight else None

    def reset_parameters(self):
        torch.nn.init.zeros_(self.shift)
