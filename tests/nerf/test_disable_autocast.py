"""Autocast around any function of these rooms changes no bit of what it returns; new ones are found by themselves.

What a function is given is chosen by the name of its parameter, from `known()`; whoever adds a parameter of another
name says there what it is.
"""

import ast
import copy
import importlib
import inspect
import pkgutil
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from support.configs import composed, loaded, options
from support.scenes import ball_scene, some_rays, tiny_field, tiny_model
from torch import Tensor, nn

import nerf_lightning
from nerf_lightning.evaluation import camera_fit
from nerf_lightning.evaluation.lpips import LPIPS
from nerf_lightning.evaluation.metrics import RayErrors
from nerf_lightning.nerf.geometry.cameras import all_pixels
from nerf_lightning.nerf.geometry.clipping import Clip, CropBox
from nerf_lightning.nerf.geometry.contraction import Contracted
from nerf_lightning.nerf.randomness import batch_random
from nerf_lightning.nerf.rendering.quadrature import composite
from nerf_lightning.nerf.rendering.ragged import composite_ragged
from nerf_lightning.nerf.samplers.base import RaggedSampler, _OneChunk
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.samplers.occupancy_grid import OccupancyGrid
from nerf_lightning.nerf.types.rays import RaggedSamples, RaySamples
from nerf_lightning.nerf.types.renderings import FieldOutput
from nerf_lightning.video.paths.base import frame_of
from nerf_lightning.video.paths.keyframe_curve import KeyframeCurve
from nerf_lightning.video.paths.keyframes import Keyframe, write_keyframes

PACKAGE = Path(nerf_lightning.__file__).parent
ROOMS = ("nerf.geometry", "nerf.rendering", "nerf.samplers", "nerf.encoders", "evaluation", "video.paths")
WRITERS = {"evaluation.evaluator", "evaluation.kept_views", "evaluation.metrics_files", "evaluation.protocol"}
"""Of what was measured: they compute nothing themselves."""
PRODUCTS = {"matmul", "mm", "bmm", "mv", "dot", "einsum", "linear", "addmm", "baddbmm", "conv2d", "tensordot", "inner"}
RAYS = 40
CONTRACTS = {"Encoder", "ConeEncoder", "Sampler", "DenseSampler", "RaggedSampler", "Walk", "CameraPath"}
"""Classes that are tried through those that follow them."""
FORWARD_AGAIN = {"attach_gradients"}
"""Methods that do what `forward` does, with what it returned before."""


def modules() -> Iterator[ModuleType]:
    for room in ROOMS:
        package = importlib.import_module(f"nerf_lightning.{room}")
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if found.name.removeprefix("nerf_lightning.") not in WRITERS:
                yield importlib.import_module(found.name)


def own(module: ModuleType, wanted: Any) -> dict[str, Any]:
    return {
        f"{module.__name__.removeprefix('nerf_lightning.')}.{name}": each
        for name, each in vars(module).items()
        if not name.startswith("_") and wanted(each) and each.__module__ == module.__name__
    }


def takes_tensors(function: Any) -> bool:
    said = " ".join(str(parameter.annotation) for parameter in inspect.signature(function).parameters.values())
    return any(word in said for word in ("Tensor", "nerf_lightning.nerf.types", "RayRandom"))


FUNCTIONS = {
    name: function
    for module in modules()
    for name, function in own(module, inspect.isfunction).items()
    if takes_tensors(function)
}
CLASSES = {name: each for module in modules() for name, each in own(module, inspect.isclass).items()}


@cache
def known() -> dict[str, Any]:
    """Values for parameters, by name. Numbers are drawn: hardly one of them is a number of bfloat16."""
    drawn = torch.Generator().manual_seed(5)
    scene = ball_scene(num_views=4, size=12, lens=(-0.05, 0.01, 0.0, 0.0, 0.001, 0.001), lens_model="radial_tangential")
    to_user = torch.eye(4)
    to_user[:3, :3] = 1.7 * scene.cameras.c2w[1, :, :3]
    to_user[:3, 3] = torch.tensor([0.3, 2.1, -1.7])
    rays = some_rays(RAYS, drawn)
    points = 2 * torch.rand(RAYS, 3, generator=drawn) - 1
    dense = RaySamples(torch.linspace(2, 6, 9) + 0.1 * torch.rand(RAYS, 9, generator=drawn))
    each = torch.arange(RAYS).repeat_interleave(2)
    starts = 2.1 + 0.9 * torch.arange(2).repeat(RAYS) + 0.1 * torch.rand(2 * RAYS, generator=drawn)
    packed = RaggedSamples(each, starts, starts + 0.7, torch.arange(RAYS + 1) * 2, torch.tensor(2 * RAYS))

    def output(*shape: int) -> FieldOutput:
        return FieldOutput(torch.rand(*shape, generator=drawn), torch.rand(*shape, 3, generator=drawn))

    background = torch.rand(RAYS, 3, generator=drawn)
    picture = torch.rand(48, 48, 3, generator=drawn)
    depth = 2 + torch.rand(RAYS, generator=drawn)
    quaternions = nn.functional.normalize(torch.randn(4, 4, generator=drawn), dim=-1)
    return {
        "scene": scene, "record": scene, "cameras": scene.cameras, "c2w": scene.cameras.c2w, "poses": scene.cameras.c2w,
        "view": 1, "width": scene.cameras.width // 2, "height": scene.cameras.height // 2, "per_side": 7,
        "pixels": all_pixels(scene.cameras, 1), "part": slice(3, 40),
        "names": scene.view_names, "view_names": scene.view_names,
        "place": torch.tensor([0.25, -0.25]),
        "near": scene.near, "far": scene.far, "aabb": scene.aabb * 1.1, "to_user": to_user, "up": to_user[:3, 2] / 1.7,
        "rays": rays, "straight": rays, "ndc": False, "points": points, "positions": points, "centers": points,
        "half_diagonal": 0.1, "most_views": 4, "rotation": scene.cameras.c2w[0, :, :3], "center": points[0],
        "unit": 1.7,
        "directions": rays.directions, "azimuth": 3 * torch.rand(4, generator=drawn),
        "lens": torch.tensor([-0.05, 0.01, 0.0, 0.0, 0.001, 0.001]), "model": "radial_tangential",
        "plane": 0.4 * torch.rand(RAYS, 2, generator=drawn), "angle": torch.rand(RAYS, generator=drawn),
        "heading": nn.functional.normalize(torch.randn(RAYS, 2, generator=drawn), dim=-1),
        "scale": torch.rand(RAYS, 2, generator=drawn), "share": torch.rand(RAYS, generator=drawn), "distance": depth,
        "offsets": scene.cameras.c2w[:, :, 3], "knots": torch.tensor([0.0, 0.31, 0.72, 1.0]),
        "at": torch.rand(9, generator=drawn), "values": torch.randn(4, 3, generator=drawn), "radius": 3.9,
        "closed": False, "num_frames": 7, "rotations": scene.cameras.c2w[:, :, :3], "quaternion": quaternions,
        "tolerance": 1e-3, "eye": 4 * torch.randn(5, 3, generator=drawn), "target": 0.1 * points[:5],
        "eyes": 4 * torch.randn(5, 3, generator=drawn), "photographed_from": scene.cameras.c2w[:, :, 3],
        "middle": points[1], "distances": depth, "shares": torch.rand(RAYS, generator=drawn),
        "background": background, "num_rays": RAYS, "device": torch.device("cpu"),
        "random": batch_random(17, RAYS, torch.device("cpu")), "rgba": torch.rand(RAYS, 4, generator=drawn),
        "edges": dense.edges, "weights": torch.rand(RAYS, 8, generator=drawn),
        "u": torch.rand(RAYS, 6, generator=drawn),
        "floor": 1e-5, "density": 2 * torch.rand(RAYS, 8, generator=drawn), "deltas": dense.deltas,
        "output": output(RAYS, 8), "samples": dense, "ragged output": output(2 * RAYS), "ragged samples": packed,
        "counts": torch.full((RAYS,), 2), "bins": 16, "contracted_spacing": False,
        "rendering": composite(output(RAYS, 8), dense, rays, background),
        "packed rendering": composite_ragged(output(2 * RAYS), packed, rays, background),
        "depth": depth, "opacity": torch.rand(RAYS, generator=drawn), "truth_depth": depth + 0.1,
        "alpha": torch.rand(RAYS, generator=drawn).round(), "normals": nn.functional.normalize(picture - 0.4, dim=-1),
        "truth_normals": nn.functional.normalize(picture - 0.5, dim=-1), "mse": 0.01 * background, "render": picture,
        "truth": (picture + 0.05).clamp(max=1), "kept": picture[..., 0] > 0.1, "rgb": background,
        "weight": torch.ones(RAYS), "history": [composite(output(RAYS, 8), dense, rays, background)],
                "step": 0, "key": 3, "alive": torch.arange(0, RAYS, 3), "limit": 4, 
        "around": frame_of(scene.cameras, scene.aabb, to_user=to_user, view_names=scene.view_names),
        "number": torch.arange(64), "found": torch.rand(64, generator=drawn), "decay": 0.95, "cascade": 0,
        "within": torch.rand(64, 3, generator=drawn), "occupied": torch.rand(1, 1, 1, 1, generator=drawn) > 2,
        "before": 8, "lower": (-0.3, -0.2, -0.1), "upper": (0.7, 0.9, 1.1),
        "name": "target", "longest": 12, "given": [0.31, 0.17, -0.93],
        "one": scene.cameras.c2w, "other": 1.3 * scene.cameras.c2w.flip(0), "by": to_user.double(),
        "angles": torch.rand(RAYS, 2, generator=drawn), "vector": 0.3 * points, "light": background,
        "gain": background + 0.5, "tile_points": 500, "fitted": picture[..., 0] > 0.3, "whole_from": 3.0,
        "views": (0, 2, 3),
        "cones": True, "covariance": torch.rand(RAYS, 6, generator=drawn), "along": depth, "across": 0.1 * depth,
        "matrices": torch.rand(RAYS, 3, 3, generator=drawn),
    }  # fmt: skip


class Known(str):
    """The name of a value in `known()`."""


def density_there(positions: Tensor) -> Tensor:
    return positions.square().sum(-1) * 5


def _packed() -> dict[str, Any]:
    sampler = OccupancySampler(resolution=16, num_steps=32)
    sampler.fit_to(known()["scene"])
    return {"sampler": sampler, "field": tiny_field().eval(), "random": None}


PACKED = _packed()
# Where a name means something else.
ELSEWHERE: dict[str, dict[str, Any]] = {
    "nerf.geometry.cameras.pinhole_cameras": {"focal": 19.3, "width": 12, "height": 12},
    "video.paths.base.frame_of": {"up": (0.1, 0.2, 0.97)},
    "video.paths.base.PathFrame.direction": {"given": (0.31, 0.17, -0.93)},
    "video.paths.base.PathFrame.point": {"otherwise": None},
    "video.paths.base.PathFrame.size": {"width": 24, "height": None},
    "nerf.geometry.panoramas.panorama_cameras": {"width": 24, "height": 12},
    "nerf.geometry.cones.pixel_side": {"view": torch.ones(RAYS, dtype=torch.int64)},
    "nerf.geometry.cones.scaled_covariance": {"scale": torch.tensor([0.31, 1.7, 2.3])},
    "nerf.rendering.near_gradients.soften_near_gradients": {"distance": torch.rand(40, 8)},
    "evaluation.camera_fit.fitted_camera": {"model": tiny_model().eval(), "background": "white"},
    "evaluation.color_fit.exposure_fitted": {"opacity": torch.ones(48, 48), "background": torch.ones(1, 3)},
    "nerf.rendering.blending.in_other_light": {"change": torch.square, "foreground": torch.rand(40, 3)},
    "nerf.rendering.blending.background_colors": {"background": "random"},
    "nerf.rendering.blending.photograph": {"background": "white"},
    "nerf.rendering.ragged.composite_ragged": {"output": Known("ragged output"), "samples": Known("ragged samples")},
    "nerf.rendering.sample_points.ragged_points": {"samples": Known("ragged samples"), "first": 0},
    "nerf.rendering.ragged.sum_over_rays": {"samples": Known("ragged samples"), "values": torch.rand(80, 2)},
    "nerf.samplers.early_termination.visible_samples": PACKED,
    "nerf.samplers.early_termination.render_until_opaque": PACKED,
    "nerf.rendering.ragged.first_of_each_ray": {"samples": Known("ragged samples")},
    "nerf.samplers.base.Sampler.update": {"density": density_there},
    "nerf.samplers.base.Sampler.reached_density": {"density": density_there},
    "nerf.samplers.occupancy.OccupancySampler.update": {"density": density_there},
    "nerf.samplers.occupancy.OccupancySampler.reached_density": {"density": density_there},
    "evaluation.geometry_errors.depth_error": {"far": Known("distances")},
    "nerf.geometry.surfaces.surface_depth": {"far": Known("distances")},
    "nerf.geometry.surfaces.normals_from_depth": {"points": Known("render")},
    "evaluation.geometry_errors.normal_error": {"alpha": torch.ones(48, 48)},
    "evaluation.metrics.RayErrors.add": {"target": Known("rgb")},
}


def arguments(name: str, function: Any, bound: bool = False) -> dict[str, Any]:
    chosen, special = {}, ELSEWHERE.get(name, {})
    for parameter in list(inspect.signature(function).parameters)[int(bound) :]:
        value = special.get(parameter, Known(parameter))
        if isinstance(value, Known) and value not in known():
            pytest.fail(f"{name} has a parameter '{parameter}': say in known() of this file what it may be given")
        chosen[parameter] = known()[value] if isinstance(value, Known) else value
    return chosen


def tensors_of(value: Any) -> list[Tensor]:
    """Return every number in a result as tensors, in order."""
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, bool | int | float):
        return [torch.tensor(value, dtype=torch.float64)]
    if isinstance(value, nn.Module):
        return list(value.state_dict().values())
    if is_dataclass(value):
        return [part for field in fields(value) for part in tensors_of(getattr(value, field.name))]
    if isinstance(value, Mapping):
        return [part for each in value.values() for part in tensors_of(each)]
    if isinstance(value, list | tuple):
        return [part for each in value for part in tensors_of(each)]
    if isinstance(value, RayErrors):
        return tensors_of(vars(value))
    return []


def require_same_bits(name: str, call: Any) -> None:
    with torch.no_grad():
        plain = tensors_of(call())
        with torch.autocast("cpu", torch.bfloat16):
            lowered = tensors_of(call())
    assert len(plain) == len(lowered)
    for alone, within in zip(plain, lowered, strict=True):
        assert alone.dtype == within.dtype, f"{name}: autocast around it changes the dtype. Mark it @disable_autocast."
        same = (alone == within) | (alone != alone) & (within != within)
        assert bool(same.all()), (
            f"{name}: autocast around it changes the result. Mark it @disable_autocast (matmul_precision.py)."
        )


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_is_the_same_under_autocast(name, monkeypatch):
    monkeypatch.setattr(camera_fit, "NUM_STEPS", 3)  # all steps are alike
    given = arguments(name, FUNCTIONS[name])
    require_same_bits(name, lambda: FUNCTIONS[name](**copy.deepcopy(given)))


def paths(folder: Path) -> list[Any]:
    keyframes = folder / "keys.yaml"
    near, far = ((-4.3, 0.2, 1.1), (4.1, -1.7, 2.3))
    write_keyframes(keyframes, [Keyframe(place, look_at=(0.1, 0.2, 0.3), up=(0.1, 0.2, 0.9)) for place in (near, far)])
    settings = {"keyframes": {"file": str(keyframes)}, "look_at": {"target": [0.31, 0.17, 0.2]}}
    return [
        instantiate(loaded("path", path), _convert_="all", num_frames=5, **settings.get(path, {}))
        for path in options("path")
    ]


def chosen_sampler(option: str) -> Any:
    return composed("train", "model=fast", f"sampler@model.levels.fine.sampler={option}").model.levels.fine.sampler


@pytest.fixture(scope="module")
def instances(tmp_path_factory) -> list[Any]:
    """One object of every class with methods that take tensors."""
    torch.manual_seed(0)
    small = {"occupancy": {"resolution": 16, "num_steps": 32}}
    samplers = [
        instantiate(chosen_sampler(option), **small.get(option.partition("_")[0], {})) for option in options("sampler")
    ]
    for sampler in samplers:
        sampler.fit_to(known()["scene"])
    packed = [sampler for sampler in samplers if isinstance(sampler, RaggedSampler)]
    walks = [
        part for sampler in packed for part in (sampler.marcher(known()["rays"]), _OneChunk(sampler, known()["rays"]))
    ]
    grid = OccupancyGrid()
    grid.allocate(8, 1)
    crop = CropBox.from_user((-0.5, -0.4, -0.3), (0.6, 0.7, 0.8), known()["to_user"])
    others = [grid, crop, Clip(3.1, crop), Contracted(), RayErrors(), LPIPS(), known()["around"]]
    encoders = [instantiate(composed("train", f"encoder={option}").encoder) for option in options("encoder")]
    passed = [
        Keyframe(place, look_at=(0.1, 0.2, 0.1)) for place in ((2.0, 0.3, 0.4), (0.2, 2.1, 0.5), (-1.9, 0.1, 0.6))
    ]
    others.append(KeyframeCurve(passed, known()["around"], []))
    return [*encoders, *samplers, *walks, *paths(tmp_path_factory.mktemp("paths")), *others]


def methods(instance: Any) -> dict[str, Any]:
    kind = type(instance)
    found = {}
    for owner in kind.__mro__:
        if owner.__module__.startswith("nerf_lightning."):
            prefix = f"{owner.__module__.removeprefix('nerf_lightning.')}.{owner.__name__}"
            for name, method in vars(owner).items():
                public = (not name.startswith("_") or name == "__call__") and name not in FORWARD_AGAIN
                if public and inspect.isfunction(method) and takes_tensors(method):
                    found.setdefault(name, (f"{prefix}.{name}", method))
    return {name: method for name, method in found.values()}


def test_methods_are_the_same_under_autocast(instances):
    for instance in instances:
        for name, method in methods(instance).items():
            if getattr(method, "__isabstractmethod__", False):
                continue
            given = arguments(name, method, bound=True)

            def call(instance=instance, method=method, given=given):
                fresh, using = copy.deepcopy((instance, given))
                return method(fresh, **using), fresh

            require_same_bits(name, call)


def test_every_class_is_tried(instances):
    tried = {owner for instance in instances for owner in type(instance).__mro__}
    for name, kind in CLASSES.items():
        takes = any(inspect.isfunction(each) and takes_tensors(each) for each in vars(kind).values())
        known_by_name = name.rpartition(".")[2] in CONTRACTS or kind in tried
        assert known_by_name or not takes, f"{name} is not tried under autocast: add one to instances() of this file"


def multiplies(node: ast.AST) -> bool:
    if isinstance(node, ast.BinOp | ast.AugAssign):
        return isinstance(node.op, ast.MatMult)
    if not isinstance(node, ast.Call):
        return False
    # Torch's are attributes (torch.mm, functional.linear); a plain name is one of products.py.
    return isinstance(node.func, ast.Attribute) and node.func.attr in PRODUCTS


def test_who_multiplies_matrices_says_in_which_precision():
    """Also where no test asks: in branches, and in private functions."""
    for room in (*ROOMS, "nerf.models", "nerf.losses", "nerf.fields"):
        for file in sorted((PACKAGE / room.replace(".", "/")).rglob("*.py")):
            tree = ast.parse(file.read_text(encoding="utf-8"))
            marked = {
                inner
                for outer in ast.walk(tree)
                if isinstance(outer, ast.FunctionDef)
                and any(getattr(mark, "id", "") == "disable_autocast" for mark in outer.decorator_list)
                for inner in ast.walk(outer)
            }
            for node in ast.walk(tree):
                assert not multiplies(node) or node in marked, (
                    f"{file.relative_to(PACKAGE)}:{node.lineno} multiplies matrices in a function that is not marked "
                    "@disable_autocast"
                )


def test_nothing_opens_autocast():
    for file in sorted(PACKAGE.rglob("*.py")):
        text = file.read_text(encoding="utf-8").replace("disable_autocast", "")
        assert file.name == "matmul_precision.py" or "autocast" not in text, f"{file}: see matmul_precision.py"
