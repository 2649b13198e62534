"""A small training of each kind of model, in every precision of the device, against the same on the CPU in float32."""

from functools import cache

import torch
from torch import Tensor

from nerf_lightning.data.pixels.placement import on_device
from nerf_lightning.data.ray_batches import FixedRays, RayBatches
from nerf_lightning.evaluation.metrics import RayErrors
from nerf_lightning.nerf.encoders.base import tables_of
from nerf_lightning.nerf.kernels.backends import CPU_TWINS, can_compile, without
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.optimizers.schedule import ExponentialDecay
from nerf_lightning.nerf.products import Products
from nerf_lightning.nerf.types.progress import Progress
from nerf_lightning.selftest.check import CannotRun, Check, gradient_bound, norm_apart, relative
from nerf_lightning.selftest.models import METHODS
from nerf_lightning.selftest.place import Place
from nerf_lightning.selftest.scene import ball_scene
from nerf_lightning.training.step import TrainStep

SEED, STEPS, BATCH_RAYS, TILE_POINTS = 7, 60, 192, 4096
# Over 8 seeds, which change rays, jitter and weights at once, the PSNR of these trainings has a standard deviation of
# 0.5 to 0.75 dB. What rounding does to a run must be less than that: all of 0.5 dB where products have 8 bits, half
# where they have 11, and a tenth where only the order of sums differs.
PSNR_APART: dict[Products, float] = {"float32": 0.05, "tf32": 0.25, "bfloat16": 0.5}
LEARNT = 1e4
"""Tables begin between -1e-4 and 1e-4, and learn to be about 1."""
CPU = torch.device("cpu")
TORCH_ALONE = CPU_TWINS


class Training:
    """A training in the making."""

    def __init__(self, method: str, device: torch.device, products: Products, tile_points: int | None):
        scene, progress, chosen = ball_scene(), Progress(), METHODS[method]
        model = chosen.model()
        model.fit_to(scene)
        self.step = TrainStep(
            model=model,
            rays=RayGenerator(scene.cameras, scene.near, scene.far),
            loss=chosen.loss(),
            optimizer=chosen.optimizer,
            schedule=ExponentialDecay(decay_rate=0.1),
            progress=progress,
            num_steps=STEPS,
            seed=SEED,
            background=scene.background,
            tile_points=tile_points,
        ).to(device)
        model.multiply_in(products)
        here = scene if device.type == "cpu" else on_device(scene, device)
        self.loader = RayBatches(here, progress, SEED, BATCH_RAYS)
        self.held_out = FixedRays(scene, "val", 10**6, 400)
        self.optimizer = self.step.new_optimizer()

    def gradients(self) -> dict[str, Tensor]:
        """Return the gradients of the first batch, with tables as large as trained ones are."""
        # Fresh ones are all but zero: whatever is done with them would hardly matter.
        with torch.no_grad():
            for table in tables_of(self.step.model):
                table.mul_(LEARNT)
        self.optimizer.zero_grad()
        self.step.gradients(self.loader.at(0, 0).to(self.step.device))
        named = self.step.model.named_parameters()
        return {name: value.grad.clone() for name, value in named if value.grad is not None}

    def psnr(self) -> float:
        """Train, and return the PSNR of the held-out views."""
        step, errors = self.step, RayErrors()
        for _ in range(STEPS):
            step(self.loader.at(0, step.progress.rays_seen).to(step.device), self.optimizer)
        with torch.no_grad():
            for batch in self.held_out:
                step.validate(batch.to(step.device), errors)
        if step.guard.skipped:
            raise ValueError(f"{step.guard.skipped} of {STEPS} steps had gradients that are not finite")
        return errors.summary()["val/psnr"]


def checks(place: Place) -> list[Check]:
    """Return the checks of gradients and of whole trainings."""
    found = [check for method in METHODS for products in place.products for check in _trained(place, method, products)]
    return [*found, _compiled(place), _resident(place)]


def _trained(place: Place, method: str, products: Products) -> list[Check]:
    layers, reference = METHODS[method].layers, METHODS[method].same_as or method

    def gradients() -> float:
        found = Training(method, place.device, products, TILE_POINTS).gradients()
        return gradients_apart(found, _reference_gradients(reference))

    def psnr() -> float:
        return abs(Training(method, place.device, products, TILE_POINTS).psnr() - _reference_psnr(reference))

    return [
        Check(
            f"{method}, {products}: gradients of a batch",
            gradient_bound(products, layers),
            f"{layers} layers of {products} products, and ReLUs within rounding of zero, which switch",
            gradients,
        ),
        Check(
            f"{method}, {products}: PSNR after {STEPS} steps, dB",
            PSNR_APART[products],
            "rounding moves a training less than another seed does, whose standard deviation is 0.5 dB",
            psnr,
        ),
    ]


@cache
def _reference_gradients(method: str) -> dict[str, Tensor]:
    """Return the gradients of the first batch, by plain torch on the CPU, in float32, without tiles."""
    with without(*TORCH_ALONE):
        return Training(method, CPU, "float32", None).gradients()


@cache
def _reference_psnr(method: str) -> float:
    """Return the PSNR of a training by the same."""
    with without(*TORCH_ALONE):
        return Training(method, CPU, "float32", None).psnr()


def gradients_apart(found: dict[str, Tensor], expected: dict[str, Tensor]) -> float:
    """Return how far the gradients of a model are apart, all in one, over the norm of what is expected."""
    if found.keys() != expected.keys():
        raise ValueError(f"gradients of {sorted(found.keys() ^ expected.keys())} are there in one and not in the other")
    ours, theirs = (torch.cat([each[name].cpu().flatten() for name in expected]) for each in (found, expected))
    return norm_apart(ours, theirs)


def _compiled(place: Place) -> Check:
    method = "coarse and fine MLP"

    def difference() -> float:
        if not place.compiles:
            raise CannotRun("torch.compile is tried on GPUs, and on the CPU with trainer.compile=true")
        if not can_compile(place.device):
            raise CannotRun("there is no C++ compiler, which torch.compile needs on the CPU")
        training = Training(method, place.device, place.chosen, None)
        if not training.step.model.compile_fields():
            raise ValueError("no level was compiled")
        return gradients_apart(training.gradients(), _reference_gradients(method))

    return Check(
        f"{method}, {place.chosen}, compiled: gradients of a batch",
        gradient_bound(place.chosen, METHODS[method].layers),
        "as without torch.compile",
        difference,
    )


def _resident(place: Place) -> Check:
    def difference() -> float:
        if not place.is_cuda:
            raise CannotRun("pixels move to GPUs, and the device here is none")
        scene = ball_scene()
        loaders = [RayBatches(each, Progress(), SEED, BATCH_RAYS) for each in (on_device(scene, place.device), scene)]
        there, here = (loader.at(0, 1000) for loader in loaders)
        if not all(torch.equal(value.cpu(), vars(here.pixels)[name]) for name, value in vars(there.pixels).items()):
            raise ValueError("other pixels are chosen")
        rays_of = RayGenerator(scene.cameras, scene.near, scene.far)
        expected = rays_of(here.pixels)
        found = rays_of.to(place.device)(there.pixels)
        pairs = [(there.rgba, here.rgba), (found.origins, expected.origins), (found.directions, expected.directions)]
        return max(relative(ours, theirs) for ours, theirs in pairs)

    return Check(
        "batches made of pixels on the device",
        16 * 2.0**-24,
        "the same pixels; a ray's direction takes some 10 roundings",
        difference,
    )
