"""Triton's kernels, compiled for GPUs that are not here: what they need fits, and what does not is left to torch."""

import contextlib
import importlib
import logging
import os
import re
import subprocess
import sys
from itertools import pairwise

import pytest
import torch
from support.configs import composed, options
from support.gpu_targets import DEVICES, OutOfResources, compiled_for
from support.triton_kernels import forced

from nerf_lightning.config.instantiate import build
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.kernels import backends
from nerf_lightning.nerf.kernels.field import cuda as field
from nerf_lightning.nerf.kernels.hash_grid import cuda as hash_grid
from nerf_lightning.nerf.kernels.mlp import cuda as mlp
from nerf_lightning.nerf.kernels.mlp.op import mlp as any_mlp
from nerf_lightning.nerf.kernels.mlp.op import mlp_torch
from nerf_lightning.nerf.kernels.ragged import cuda as ragged

KERNELS = {mlp: ["_forward", "_backward"], hash_grid: ["_forward", "_backward"]}
SMALL = {
    "random.cuda": ["_uniform"],
    "march.cuda": ["_enter", "_march", "_write"],
    "spherical_harmonics.cuda": ["_harmonics"],
    "ragged.cuda": ["_integrate", "_integrate_back", "_num_visible", "_first"],
    "render.cuda": ["_locate", "_join", "_activate", "_activate_back"],
    "field.cuda": ["_forward", "_backward_color", "_backward_density"],
    "histograms.cuda": ["_sample", "_stratified", "_interlevel", "_distortion"],
    "table_adam.cuda": ["_update"],
    "pixels.cuda": ["_batch"],
    "rays.cuda": ["_rays"],
}
"""What `trial` of each other module launches."""
BFLOAT16 = [name for name in DEVICES if name != "sm_75"]  # where float32 is used instead
# The one that the kernels of the default model did not fit into is always tried. Those that differ from another in age
# or in shared memory alone, and the largest of data centers, are left to make test-all.
MINUTES, EXHAUSTIVE = pytest.mark.minutes, pytest.mark.exhaustive
MARKS = {"sm_89": [], **dict.fromkeys(("sm_75", "sm_120", "gfx942"), MINUTES)}
FOR_ALL = [pytest.param(name, marks=MARKS.get(name, EXHAUSTIVE)) for name in DEVICES]
USED = torch.ones(1, dtype=torch.int64)
"""Where padding begins, as kernels get it of rays with different numbers of samples."""
MOST_SPILLED = 152
"""Bytes of a thread that no register had room for, of the kernels below, on sm_120: a change must not add to it."""


@pytest.fixture(scope="module")
def reachable():
    """The widths of perceptrons, the grids, and the widths of fields on grids, that conf/model leads to."""
    sizes, grids, fields = set(), {}, set()
    for model in options("model"):
        with torch.device("meta"):  # their sizes are enough
            built = build(composed("train", f"model={model}").model)
        for part in built.modules():
            if isinstance(part, NGPField):
                both = [
                    (weights[0].shape[1], *(weight.shape[0] for weight in weights))
                    for weights in (part.density_mlp, part.color_mlp)
                ]
                sizes.update(both)
                fields.add(tuple(both))
            if isinstance(part, HashGridEncoder):
                grids[part.layout] = part.features_per_level
    return sizes, grids, fields


@pytest.fixture(autouse=True)
def asked_anew():
    for kernels in (mlp, field):
        kernels.takes.cache_clear()
    yield
    for kernels in (mlp, field):
        kernels.takes.cache_clear()


@pytest.mark.parametrize("name", FOR_ALL)
def test_the_kernels_of_every_model_fit(name, reachable):
    sizes, grids, fields = reachable
    assert (32, 64, 64, 3) in sizes
    assert len(grids) >= 3
    for layout, features in grids.items():
        points, out = torch.zeros(128, 3), torch.zeros(128, len(layout.resolutions) * features)
        with compiled_for(name, KERNELS) as made:
            for used in (None, USED):
                hash_grid.forward(torch.empty(layout.offsets[-1], features), points, layout, used)
                hash_grid.add_table_gradient(torch.empty(layout.offsets[-1], features), points, out, layout, used)
        assert len(made.kernels) == 4
        assert made.spilled() == 0
        # A stricter atomic addition is a fence, and empties the first-level cache.
        assert not any("acq_rel" in kernel.asm.get("ptx", "") for kernel in made.kernels)
    for widths in sizes if name in BFLOAT16 else ():
        with compiled_for(name, KERNELS) as made:
            assert mlp.takes(widths, torch.device("cpu")), widths
            weights = [torch.empty(outer, inner) for inner, outer in pairwise(widths)]
            out, kept = mlp.forward(torch.empty(128, widths[0]), weights, True, USED)
            mlp.backward(out, weights, kept, True, USED)
        assert len(made.kernels) == 4
        assert made.spilled() <= MOST_SPILLED, widths
    assert {((32, 64, 16), (32, 64, 3)), ((32, 64, 16), (32, 64, 64, 3))} <= fields
    for density, color in fields if name in BFLOAT16 else ():
        with compiled_for(name, {field: SMALL["field.cuda"]}) as made:
            assert field.takes(density, color, torch.device("cpu")) == (len(color) in (3, 4))
        assert len(made.kernels) == (3 if len(color) in (3, 4) else 0)
        assert not made.kernels or made.spilled() <= MOST_SPILLED, density


@pytest.mark.parametrize("name", FOR_ALL)
def test_small_kernels_compile_and_keep_all_in_registers(name, monkeypatch):
    assert set(backends.CUDA_BACKENDS) == {*SMALL, "mlp.cuda", "hash_grid.cuda"}
    monkeypatch.setenv(backends.FP_FUSION, "1")
    monkeypatch.setattr(torch, "empty", torch.ones)  # what no kernel writes, but the host reads
    for module, names in SMALL.items():
        kernels = importlib.import_module(f"{backends.KERNELS}.{module}")
        launched = {ragged: SMALL["ragged.cuda"], kernels: names}  # quadrature ends the trial of rendering
        # Nothing is computed, of which a trial complains, or torch that a number with gradients is read.
        with compiled_for(name, launched) as made, forced(), contextlib.suppress(RuntimeError, UserWarning):
            kernels.trial("cpu")
        assert {kernel.metadata.name for kernel in made.kernels} >= set(names)
        assert made.spilled() <= (MOST_SPILLED if module == "field.cuda" else 0), module  # as other MLPs


# The one that takes some and refuses others is tried more often.
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(each, marks=pytest.mark.minutes if each == "sm_100" else pytest.mark.exhaustive)
        for each in BFLOAT16
    ],
)
def test_the_widest_layers_fit_or_are_refused(name, caplog):
    with compiled_for(name, KERNELS), caplog.at_level(logging.WARNING):
        assert mlp.takes((32, 128, 128, 3), torch.device("cpu"))
        assert mlp.takes((128, 128, 128, 128), torch.device("cpu")) == (name != "sm_100")
    assert [each.count("512 bytes of tensor memory") for each in caplog.messages] == [1] * (name == "sm_100")


class TooLarge:
    """A kernel that needs more than there is."""

    def __getitem__(self, grid):
        def launch(*arguments, **options):
            raise OutOfResources(126_976, 101_376, "shared memory")

        return launch


def test_a_kernel_that_does_not_fit_leaves_the_work_to_torch_and_says_so_once(monkeypatch, caplog):
    monkeypatch.setattr(mlp, "_backward", TooLarge())
    monkeypatch.setattr(mlp, "_forward", TooLarge())
    points, weights = torch.rand(5, 32), [torch.rand(64, 32), torch.rand(3, 64)]
    expected = mlp_torch(points, weights, "bfloat16")
    monkeypatch.setattr(torch.Tensor, "is_cuda", True)
    monkeypatch.setattr("nerf_lightning.nerf.kernels.mlp.op.cuda_backend", lambda module, device: mlp)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            assert torch.equal(any_mlp(points, weights, "bfloat16"), expected)
    assert caplog.messages == [
        "cpu has 101376 bytes of shared memory and the fused kernel for layers of widths 32-64-3 needs 126976: torch "
        "computes these layers instead, slower. trainer.precision=32-true or narrower layers avoid this."
    ]


def test_numbers_of_values_may_exceed_32_bits(reachable):
    layout, features = next(iter(reachable[1].items()))
    table, points = torch.empty(layout.offsets[-1], features), torch.zeros(128, 3)
    out = len(layout.resolutions) * features
    with compiled_for("sm_89", KERNELS) as made:
        hash_grid.forward(table, points, layout)
        hash_grid.add_table_gradient(table, points, torch.zeros(128, out), layout)
    for kernel in made.kernels:
        code = kernel.asm["ttir"]
        arrays = re.findall(r"(%\S+) = tt.splat %\S+ : !tt.ptr", code)
        assert arrays
        offsets = [re.findall(rf"tt.addptr {array}, .*tensor<128x(?:1x)?(i\d+)> ", code) for array in arrays]
        assert set().union(*offsets) == {"i64"}


INTERPRETED = """
import sys
import torch
sys.path.insert(0, "tests")
from nerf_lightning.nerf.kernels.mlp import cuda
from support.triton_kernels import check_all
from support.triton_perceptron import check_perceptron
from support.triton_twin import check_against_the_reference

check_all("cpu", torch.Generator().manual_seed(0), names=sys.argv[1:])
"""
LARGE = """
check_against_the_reference("cpu", 140)
cuda.PROGRAMS = 2  # so that one takes several blocks
check_perceptron("cpu", [0, 1, 640])
"""
SLOW = ("render.cuda", "histograms.cuda")


@pytest.mark.minutes
@pytest.mark.parametrize(
    ("code", "names"),
    [
        pytest.param(INTERPRETED, SLOW, id="slow"),
        pytest.param(INTERPRETED + LARGE, sorted({*SMALL} - {*SLOW}), id="others"),
    ],
)
def test_through_the_interpreter(code, names):
    pytest.importorskip("triton", reason="triton is not installed (Linux only)")
    # The interpreter is chosen when the kernels are defined: a process of its own.
    environment = os.environ | {"TRITON_INTERPRET": "1"}
    result = subprocess.run([sys.executable, "-c", code, *names], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
