"""How a check is judged, and what is said of machines that say little of themselves."""

import math
from types import SimpleNamespace

import pytest
import torch

from nerf_lightning.extensions.selftest.check import (
    CannotRun,
    Check,
    carried_out,
    gradient_bound,
    norm_apart,
    relative,
    remarks,
    value_bound,
)
from nerf_lightning.extensions.selftest.commands import selftest as module
from nerf_lightning.extensions.selftest.commands.selftest import machine


def a_check(difference, bound=0.1):
    def found():
        if isinstance(difference, Exception):
            raise difference
        return difference

    return Check("a thing", bound, "so it is", found)


@pytest.mark.parametrize(
    ("difference", "outcome", "note"),
    [
        (0.1, "ok", "so it is"),
        (0.11, "wrong", "so it is"),
        (math.nan, "wrong", "so it is"),
        (math.inf, "wrong", "so it is"),
        (CannotRun("no triton"), "not run", "no triton"),
        (ZeroDivisionError("by\nnothing"), "wrong", "ZeroDivisionError: by nothing"),
        (torch.OutOfMemoryError("CUDA out of memory"), "wrong", "OutOfMemoryError: CUDA out of memory"),
    ],
)
def test_a_check_is_judged_by_its_bound_and_whatever_it_raises_is_an_answer(difference, outcome, note):
    row = carried_out(a_check(difference))
    assert (row.outcome, row.note) == (outcome, note)


def test_what_is_not_right_is_told_in_words():
    rows = [carried_out(a_check(each)) for each in (0.0, 0.5, CannotRun("no triton"), ValueError("bad"))]
    assert remarks(rows) == [
        "not run: a thing: no triton",
        "WRONG: a thing: 0.5 exceeds 0.1 (so it is)",
        "WRONG: a thing: ValueError: bad",
    ]


def test_a_number_that_is_not_finite_is_never_hidden_by_others():
    bad = torch.tensor([1.0, math.nan])
    assert math.isnan(relative(bad, torch.ones(2)))
    assert math.isnan(norm_apart(bad, torch.ones(2)))
    with pytest.raises(ValueError, match="shape"):
        relative(torch.ones(2), torch.ones(3))


def test_bounds_grow_with_layers_and_with_rounding_which_stays_within_them(generator):
    for bound in (value_bound, gradient_bound):
        assert bound("float32", 3) < bound("tf32", 3) < bound("bfloat16", 3) < bound("bfloat16", 6) < 0.3
    """The formulas against perceptrons whose factors are rounded, with nothing of the kernels in between."""
    layers = 5
    weights = [(torch.randn(64, 64, generator=generator) / 32**0.5).double() for _ in range(layers)]
    points = torch.randn(2000, 64, generator=generator).double()
    results = []
    for rounded in (lambda x: x, lambda x: x.bfloat16().double()):
        hidden = points
        for weight in weights:
            hidden = rounded((rounded(hidden) @ rounded(weight).t()).relu())
        results.append(hidden)
    assert 1e-3 < norm_apart(results[1], results[0]) < value_bound("bfloat16", layers)


CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("text", "flags"),
    [
        ("Flags:   fpu avx2 fma avx512_bf16 wp\n", "avx2 avx512_bf16 fma"),
        ("Flags:   fp asimd bf16 sve2 crc32\n", "asimd bf16 sve2"),
        ("Model name: some\n", "unknown"),
    ],
)
def test_instruction_sets_are_read_where_linux_lists_them(text, flags, monkeypatch):
    monkeypatch.setattr(module.collect_env, "get_cpu_info", lambda run: text)
    assert machine(CPU)["cpu_flags"] == flags


def test_a_gpu_is_described_with_its_driver(monkeypatch):
    properties = SimpleNamespace(name="Some GPU", major=9, minor=0, multi_processor_count=132)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: properties)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (1_000_000_000, 2_000_000_000))
    monkeypatch.setattr(module.collect_env, "get_nvidia_driver_version", lambda run: "570.1.2")
    known = machine(torch.device("cuda"))
    assert "Some GPU" in known["gpu"]
    assert known["driver"] == "570.1.2"
    assert known["gpu_memory_gigabytes"] == {"total": 2.0, "free": 1.0}
