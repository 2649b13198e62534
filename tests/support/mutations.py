"""Ways to damage what a sound file holds, drawn by hypothesis: trees of plain values and tensors, and bytes."""

import copy
import math
from typing import Any

import torch
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn
from torch import Tensor

VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, 2**53 + 1, 2**63, 10**400, 0.5, 1e-300, 1e39, math.nan, -math.inf, [], {}, [[]]),
    *({"a": {"b": 1}}, "", "..", "../../elsewhere", "/dev/zero", "~nobody/x", "a\0b", "\ud800", "\x1b[2J", "a\nb"),
    *("x" * 5000, "9" * 5000),
    *("<script>alert(1)</script>", "=cmd|' /C calc'!A0", "${oc.env:HOME}", "${", "{0}", "nan", "2001-99-99"),
)
KEYS = ("", "_target_", "frames", "near", "\ud800", "a.b", "<b>", "w", "psnr", "0")


@st.composite
def mutated(draw: DrawFn, sound: Any, most: int = 3) -> Any:
    """Return nested dictionaries, lists, tuples, plain values and tensors with a few changes."""
    tree = copy.deepcopy(sound)
    for _ in range(draw(st.integers(1, most))):
        tree = _changed(draw, tree)
    return tree


def _changed(draw: DrawFn, node: Any) -> Any:
    if isinstance(node, dict) and node and draw(st.integers(0, 6)):
        key = draw(st.sampled_from(list(node)))
        kind = draw(st.sampled_from(("below", "below", "below", "remove", "add")))
        if kind == "remove":
            return {name: value for name, value in node.items() if name != key}
        return {**node, (draw(st.sampled_from(KEYS)) if kind == "add" else key): _changed(draw, node[key])}
    if isinstance(node, (list, tuple)) and node and draw(st.integers(0, 6)):
        place = draw(st.integers(0, len(node) - 1))
        new = draw(st.sampled_from(([], [node[place]] * 2, None)))
        return type(node)([*node[:place], *([_changed(draw, node[place])] if new is None else new), *node[place + 1 :]])
    if isinstance(node, Tensor) and draw(st.integers(0, 6)):
        return _other_tensor(draw, node)
    if isinstance(node, float) and draw(st.booleans()):
        return node * draw(st.sampled_from((-1, 1e-9, 1e9, 1.001, 1e200)))
    return copy.deepcopy(draw(st.sampled_from(VALUES) | st.text(max_size=8)))


def _other_tensor(draw: DrawFn, tensor: Tensor) -> Tensor:
    """Return a tensor of another shape, type, or with another number."""
    kind = draw(st.sampled_from(("shape", "type", "number", "all")))
    if kind == "shape":
        return draw(
            st.sampled_from((tensor[None], tensor.flatten()[:-1], torch.zeros(1).expand(10**9), torch.zeros(0)))
        )
    if kind == "type":
        return tensor.to(draw(st.sampled_from((torch.float64, torch.float16, torch.int32, torch.complex64))))
    floats, integers = (math.nan, math.inf, -1.0, 0.0, 1e30, 1e-40), (-(2**62), -1, 0, 1, 255, 2**62)
    value = draw(st.sampled_from(floats if tensor.is_floating_point() else integers))
    new = tensor.clone()
    value = value if new.is_floating_point() or new.dtype == torch.int64 else value % 2
    if kind == "all" or not new.numel():
        return new.fill_(value)
    new.view(-1)[draw(st.integers(0, new.numel() - 1))] = value
    return new


@st.composite
def damaged(draw: DrawFn, sound: bytes, most: int = 3) -> bytes:
    """Return bytes with a few changes, half of them near the beginning, where files say what comes."""
    data = bytearray(sound)
    for _ in range(draw(st.integers(1, most))):
        last = max(0, len(data) - 1)
        place = draw(st.integers(0, min(200, last)) | st.integers(0, last))
        size = draw(st.integers(1, 64))
        kind = draw(st.sampled_from(("flip", "number", "number", "cut", "remove", "repeat", "fill")))
        if kind == "flip" and data:
            data[place] ^= 1 << draw(st.integers(0, 7))
        elif kind == "number":
            number = draw(st.sampled_from((0, 1, -1, 0x7F, 0x8000, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1)))
            width = draw(st.sampled_from((1, 2, 4, 8)))
            order = draw(st.sampled_from(("little", "big")))
            data[place : place + width] = (number & ((1 << 8 * width) - 1)).to_bytes(width, order)
        elif kind == "cut":
            del data[place:]
        elif kind == "remove":
            del data[place : place + size]
        elif kind == "repeat":
            data[place:place] = data[place : place + size] * draw(st.sampled_from((1, 2, 50)))
        else:
            data[place : place + size] = bytes([draw(st.sampled_from((0, 0x20, 0x5B, 0xFF)))]) * size
    return bytes(data)
