"""Quantized weights: their error, and what untrusted files must not contain."""

import pytest
import torch
from support.budget import budget
from support.planted import write_checkpoint
from support.running import refused

from nerf_lightning.checkpoints.quantization import dequantized
from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.config.load_model import load_model
from nerf_lightning.extensions.pruning.quantize import quantize_rows, quantize_switches

STARTS = (0, 40, 100)


def table(seed=0):
    """Three levels of different scales, the last of them all zeros."""
    rows = torch.randn(150, 4, generator=torch.Generator().manual_seed(seed))
    rows[:40] *= 1e-3
    rows[100:] = 0.0
    return rows


def round_trip(rows, *how, **more):
    packed = quantize_rows(rows, *how, **more)
    return dequantized({"rows": {"model.t": packed}, "switches": {}}, "a file")["model.t"], packed


def test_float32_comes_back_to_the_bit_float16_to_eleven_and_int8_to_half_a_step_of_its_level():
    for rows in (table(), torch.randn(2, 3, 5), torch.randn(7)):
        assert torch.equal(round_trip(rows, "float32")[0], rows)
    rows = table()
    half, packed = round_trip(rows, "float16", STARTS)
    assert packed["values"].dtype == torch.float16
    assert bool(((half - rows).abs() <= rows.abs() * 2.0**-11 + 2.0**-25).all())
    eighth, packed = round_trip(rows, "int8", STARTS)
    assert packed["values"].dtype == torch.int8
    for first, last in ((0, 40), (40, 100), (100, 150)):
        step = rows[first:last].abs().max() / 127
        assert float((eighth - rows)[first:last].abs().max()) <= 0.5001 * float(step)
    assert torch.equal(round_trip(eighth, "int8", STARTS)[0], eighth)  # nothing more is lost the second time


def test_rows_that_are_left_out_come_back_as_their_levels_mean():
    rows, kept = table(), torch.arange(150) % 3 == 0
    back, packed = round_trip(rows, "float32", STARTS, mask=kept)
    assert packed["values"].shape == (50, 4)
    assert torch.equal(back[kept], rows[kept])
    mean = rows[:40][~kept[:40]].mean(dim=0)
    torch.testing.assert_close(back[:40][~kept[:40]], mean.expand(26, 4))


def test_switches_are_bits():
    for switches in (torch.rand(1, 5, 5) > 0.5, (torch.rand(17) > 0.5).to(torch.uint8)):
        packed = quantize_switches(switches)
        assert packed["bits"].numel() == -(-switches.numel() // 8)
        back = dequantized({"rows": {}, "switches": {"model.s": packed}}, "a file")["model.s"]
        assert back.dtype == switches.dtype
        assert torch.equal(back, switches)


def planted(path, change):
    def pack(content):
        state, name = content["state_dict"], "model.levels.coarse.field.feature.weight"
        packed = {"rows": {name: quantize_rows(state.pop(name), "int8", (0, 8), torch.arange(32) < 30)}, "switches": {}}
        change(packed["rows"][name])
        content["nerf_lightning"]["quantized"] = packed

    return write_checkpoint(path / "packed.ckpt", pack)


WRONG = {
    "rows": ({"values": torch.zeros(7, 32, dtype=torch.int8)}, "packed.ckpt cannot be read"),
    "narrow rows": ({"values": torch.zeros(30, 31, dtype=torch.int8)}, "has rows of (30, 31) in a table of [32, 32]"),
    "blocks": ({"starts": [0, 99]}, "packed.ckpt cannot be read"),
    "an index beyond": ({"scales": torch.ones(1)}, "packed.ckpt cannot be read"),
    "infinite": ({"scales": torch.tensor([1.0, float("inf")])}, "scales holds NaN or infinity"),
    "large": ({"scales": torch.full((2,), 3e38)}, "coarse.field.feature.weight holds NaN or infinity"),
    "another shape": ({"shape": [1, 1024]}, "in a table of [1, 1024]"),
    "a bomb": ({"shape": [1 << 30, 32]}, "bytes of quantized weights, once they are unpacked"),
    "a key": ({"more": "words"}, "more belongs to no file of this kind"),
}


@pytest.mark.parametrize(("change", "words"), WRONG.values(), ids=WRONG)
def test_what_no_file_of_ours_says_is_refused(tmp_path, change, words):
    path = planted(tmp_path, lambda packed: packed.update(change))
    refused(lambda: load_model(read_checkpoint(path)), parts=("packed.ckpt", words))


def test_what_is_sound_is_read(tmp_path):
    weights = read_checkpoint(planted(tmp_path, lambda packed: None)).weights
    assert weights["levels.coarse.field.feature.weight"].shape == (32, 32)
    path = planted(tmp_path, lambda packed: None)
    with budget(unpacked_bytes=4 * 32 * 32):
        read_checkpoint(path)
    with budget(unpacked_bytes=4 * 32 * 32 - 1):
        refused(read_checkpoint, path, parts=("4,096 bytes of quantized weights", "budgets.unpacked_bytes=4096"))


def test_a_budget_is_held_before_anything_is_made():
    huge = quantize_switches(torch.ones(8, dtype=torch.bool)) | {"shape": [1 << 40, 1 << 40]}
    refused(dequantized, {"rows": {}, "switches": {"model.s": huge}}, "a file", parts=("budgets.unpacked_bytes",))
