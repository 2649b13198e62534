"""A channel of classes beside density and color: where the photographs are bright (after arXiv 2103.15875)."""

import torch
from torch import nn
from torch.nn.functional import binary_cross_entropy

from nerf_lightning.nerf.fields.nerf_mlp import NerfMLP
from nerf_lightning.nerf.losses.base import Loss


class SemanticMLP(NerfMLP):
    def __init__(self, **settings):
        super().__init__(**settings)
        self.classes = nn.Sequential(nn.Linear(3, 16), nn.ReLU(), nn.Linear(16, 2), nn.Softmax(dim=-1))

    def forward(self, points, features=None):
        output = super().forward(points, features)
        return type(output)(output.density, output.rgb, channels={"bright": self.classes(output.rgb.detach())})

    def reset_parameters(self):
        super().reset_parameters()
        for layer in getattr(self, "classes", ()):
            if isinstance(layer, nn.Linear):
                layer.reset_parameters()


class BrightClass(Loss):
    def forward(self, renderings, target):
        bright = (target.rgb.mean(dim=-1) > 0.5).float()
        errors = [binary_cross_entropy(each.channels["bright"][:, 0].clamp(0, 1), bright) for each in renderings]
        return {"bright": torch.stack(errors)}
