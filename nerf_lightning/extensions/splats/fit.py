"""Fit splats to pictures: Adam on every number, with rates for each kind, as Kerbl et al. 2023 (arXiv 2308.04079).

They begin on surfaces instead of as a few points, and have a minute instead of an hour: rates are larger and decay
faster, and transparent splats are replaced by splitting those that are too coarse by the gradient on the screen.

How many splats: `fitted.py`. For how long: `seconds` in conf/what/page.yaml and conf/what/splats.yaml.
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.export.base import Report
from nerf_lightning.extensions.splats.gaussians import Gaussians, Pinhole
from nerf_lightning.extensions.splats.rasterizer import rasterize
from nerf_lightning.extensions.splats.views import View, color_behind
from nerf_lightning.nerf.geometry.poses import rotation_from_quaternion
from nerf_lightning.nerf.kernels.table_adam.op import AdamUpdate
from nerf_lightning.nerf.kernels.threads import torch_on_one_thread
from nerf_lightning.nerf.types.scene import DRAWN, Background

BETAS, EPS = (0.9, 0.99), 1e-15
LAST_RATE = 0.05  # Rate of the last step, as a share of the first.
RATES = {"log_scales": 2e-2, "quaternions": 8e-3, "opacity_logits": 1e-1, "sh_dc": 2e-2, "sh_rest": 4e-3}
MEANS_RATE = 6e-4  # In units of the scene's extent.
TAUGHT_EVERY = 3  # Steps.
EVERY = 100  # Steps between rounds of pruning and splitting,
UNTIL = 0.7  # and the share of the time with such rounds.
LEAST_OPACITY = 0.005  # Less opaque splats are removed: the opacity of a splat, not of all that a pixel sees.
GROWTH = 0.1  # Maximum share of splats that are split in one round.
SMALLER = 1.6  # Factor by which the two parts of a splat are smaller.
LEAST_VARIANCE = 0.15
"""Pixels^2 along each axis of a splat (arXiv 2311.16493, Sec. 5.1): thinner ones vanish in larger pictures."""


@dataclass
class Fitting:
    """Settings of the fit."""

    budget: int
    """Maximum number of splats."""
    seconds: float
    """Duration, above 0."""
    background: Background
    extent: float
    """Approximate extent of the cameras (scene units), the unit of the means' steps."""
    seed: int = 0


def fit(
    gaussians: Gaussians, photographs: Sequence[View], taught: Sequence[View], fitting: Fitting, report: Report
) -> Gaussians:
    """Fit splats to the views for some seconds, with one view per step in random order.

    One in `TAUGHT_EVERY` is the field's, which knows what no photograph shows; all are, without photographs.
    """
    cameras = [view.camera for view in photographs or taught]
    state, generator = _State(gaussians, fitting.extent, cameras), torch.Generator().manual_seed(fitting.seed)
    began, step = time.monotonic(), 0
    photographed, shown = _in_random_order(photographs, generator), _in_random_order(taught, generator)
    with torch_on_one_thread():
        while (done := (time.monotonic() - began) / fitting.seconds) < 1.0:
            view = next(shown if step % TAUGHT_EVERY == 0 or not photographs else photographed)
            state.learn(view, _background(fitting.background, generator), LAST_RATE**done)
            step += 1
            if step % EVERY == 0 and done < UNTIL:
                state.refine(fitting.budget, generator)
            report("fitting", done)
    return state.gaussians.map(lambda each: each.detach())


def _in_random_order(views: Sequence[View], generator: torch.Generator) -> Iterator[View]:
    while True:
        for number in torch.randperm(len(views), generator=generator).tolist():
            yield views[number]


def _background(background: Background, generator: torch.Generator) -> Float[Tensor, "3"]:
    if background in DRAWN:  # a haze would take on its color
        return torch.rand(3, generator=generator)
    return color_behind(background)


class _State:
    """Splats in training, with their moments and statistics on the screen."""

    def __init__(self, gaussians: Gaussians, extent: float, cameras: Sequence[Pinhole]):
        self.gaussians = gaussians.map(lambda each: each.clone().requires_grad_())
        self.rates = RATES | {"means": MEANS_RATE * extent}
        self.first, self.second = (gaussians.map(torch.zeros_like) for _ in range(2))
        self.step, self.error = 0, torch.zeros(len(gaussians))
        self.eyes = torch.stack([camera.eye for camera in cameras])
        self.pixels = torch.tensor([1 / camera.focal[0] for camera in cameras])
        self.finest = self._finest()

    def learn(self, view: View, background: Float[Tensor, "3"], rate: float) -> float:
        """Take one Adam step and return the loss."""
        on_screen = torch.zeros(len(self.gaussians), 2, requires_grad=True)
        picture = rasterize(self.gaussians, view.camera, background, on_screen)
        error = picture - view.over(background)
        error = error if view.mask is None else error[view.mask]
        loss = error.square().mean()
        loss.backward()
        assert on_screen.grad is not None
        self.error += on_screen.grad.norm(dim=-1)
        self.step += 1
        b1, b2 = BETAS
        root_scale = (1 - b2**self.step) ** -0.5
        rows, numbers = [], []
        for name, tensor in self.gaussians.tensors().items():
            assert tensor.grad is not None
            rows.append((tensor, tensor.grad, getattr(self.first, name), getattr(self.second, name)))
            numbers.append((rate * self.rates[name] / (1 - b1**self.step), root_scale, b1, b2, EPS))
            tensor.grad = None
        update = AdamUpdate(rows)
        update.set_numbers(numbers)
        update()
        self.gaussians.log_scales.detach().clamp_(min=self.finest[:, None])
        return float(loss.detach())

    def _finest(self) -> Float[Tensor, "n"]:
        """Return the minimum logarithm of each splat's standard deviations: `LEAST_VARIANCE` for the nearest camera."""
        pixels = torch.cdist(self.gaussians.means.detach(), self.eyes) * self.pixels
        return pixels.amin(dim=-1).clamp(min=1e-12).log() + 0.5 * math.log(LEAST_VARIANCE)

    def refine(self, budget: int, generator: torch.Generator) -> None:
        """Prune transparent splats, and split those with the largest gradients on the screen, up to the budget."""
        former = self.gaussians.map(lambda each: each.detach())
        kept = former.opacity_logits.sigmoid() > LEAST_OPACITY
        error = torch.where(kept, self.error, -1.0)
        room = min(budget - int(kept.sum()), int(GROWTH * len(former)))
        split = error.topk(max(room, 0)).indices
        kept[split] = False
        halves = [former.map(lambda each: each[split]) for _ in range(2)]
        offset = torch.randn(len(split), 3, generator=generator) * halves[0].log_scales.exp()
        offset = (rotation_from_quaternion(halves[0].quaternions) @ offset[..., None])[..., 0]
        for half, sign in zip(halves, (0.5, -0.5), strict=True):
            half.means = half.means + sign * offset
            half.log_scales = half.log_scales - math.log(SMALLER)
        parts = [former.map(lambda each: each[kept]), *halves]
        joined = zip(*(part.tensors().values() for part in parts), strict=True)
        self.gaussians = Gaussians(*(torch.cat(each).requires_grad_() for each in joined))

        def with_new(moment: Tensor) -> Tensor:
            return torch.cat([moment[kept], moment.new_zeros(2 * len(split), *moment.shape[1:])])

        self.first, self.second = self.first.map(with_new), self.second.map(with_new)
        self.error, self.finest = torch.zeros(len(self.gaussians)), self._finest()
