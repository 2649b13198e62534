"""Ways to damage what a sound file holds, drawn by hypothesis: trees of json and yaml, bytes, arrays."""

import copy
import io
import math
import struct
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn

NUMBERS = (
    *(0, 1, -1, 2, 2**31, 2**53 + 1, 2**63, -(2**63), 2**64, 10**30, 10**400, -(10**400)),
    *(0.0, -0.0, 0.5, 1e-300, 5e-324, 1e-7, 1e7, 1e10, 3.4e38, 1e39, 1e300, -1e300, math.nan, math.inf, -math.inf),
)
WORDS = (
    *("", " ", ".", "..", "../../elsewhere", "/etc/passwd", "/dev/zero", "~", "~nobody/x", "C:\\x", "a\\..\\..\\b"),
    *("a\0b", "\ud800", "\x1b[2J", "a\nb", "\u202ecod", "\u0663", "\ufeff", "x" * 5000, "é" * 200),
    *("<script>alert(1)</script>", "=cmd|' /C calc'!A0", "[/red]", "${oc.env:HOME}", "${", "{{7*7}}", "%s%n", "{0}"),
    *("nan", "inf", "-1", "1e999", "null", "true", "0x10", "1_000", "9" * 5000, "2001-99-99", "12:30:45"),
)
OTHERS: tuple[Any, ...] = (None, True, False, [], {}, [[]], [None], {"": None}, [{}], [1, "a"], {"a": {"b": [1]}})
KEYS = ("", "_target_", "frames", "near", "lens", "\ud800", "a.b", "__class__", "<b>", "\n", "w", "psnr", "0")
EXTREMES = (
    0,
    1,
    -1,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0x8000,
    0xFFFF,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
    1 << 40,
    (1 << 63) - 1,
)
TYPES = ("?", "i1", "u1", "<i2", ">i4", "<u8", "<f2", "<f4", ">f8", "<c8", "<c16", "S3", "U2", "M8[s]", "m8[ns]", "V4")


def deep(levels: int) -> Any:
    """Return brackets within brackets."""
    tree: Any = []
    for level in range(levels):
        tree = [tree] if level % 2 else {"a": tree}
    return tree


def scalars() -> st.SearchStrategy[Any]:
    """Return numbers and words that a file may hold and nobody expects."""
    return st.one_of(st.sampled_from(NUMBERS), st.sampled_from(WORDS), st.floats(), st.integers(), st.text(max_size=8))


def values() -> st.SearchStrategy[Any]:
    """Return anything that json can say."""
    large = st.sampled_from((30, 60, 200)).map(deep) | st.just([0.0] * 2000) | st.just({str(n): n for n in range(500)})
    return st.one_of(scalars(), scalars(), st.sampled_from(OTHERS).map(copy.deepcopy), large)


@st.composite
def mutated(draw: DrawFn, sound: Any, most: int = 3) -> Any:
    """Return a tree of lists and dictionaries with a few changes."""
    tree = copy.deepcopy(sound)
    for _ in range(draw(st.integers(1, most))):
        tree = _changed(draw, tree)
    return tree


def _changed(draw: DrawFn, tree: Any) -> Any:
    # Down from the top, so that a number of a hundred matrices is not more likely than the list of them.
    parent: Any = None
    key: Any = None
    node = tree
    while isinstance(node, (list, dict)) and node and (parent is None or draw(st.integers(0, 4))):
        parent, key = node, draw(st.sampled_from(range(len(node)) if isinstance(node, list) else sorted(node)))
        node = parent[key]
    if parent is None:
        return draw(values())
    _change(draw, parent, key)
    return tree


def _change(draw: DrawFn, parent: Any, key: Any) -> None:
    node = parent[key]
    kind = draw(
        st.sampled_from(("value", "value", "scalar", "scalar", "remove", "copy", "more", "wrap", "scale", "swap"))
    )
    if kind == "remove":
        del parent[key]
    elif kind == "copy":
        if isinstance(parent, list):
            parent.insert(key, copy.deepcopy(node))
        else:
            parent[draw(st.sampled_from(KEYS) | st.text(max_size=6))] = copy.deepcopy(node)
    elif kind == "more" and isinstance(node, (list, dict)):
        added = draw(values())
        if isinstance(node, list):
            node.append(added)
        else:
            node[draw(st.sampled_from(KEYS) | st.text(max_size=6))] = added
    elif kind == "wrap":
        parent[key] = draw(st.sampled_from(([node], {"a": node}, [node, node], str(node)[:2000])))
    elif kind == "scale" and isinstance(node, (int, float)) and abs(node) < 1e100:
        parent[key] = node * draw(st.sampled_from((-1, 1e-9, 1e9, 1.001, 1e20, 1e200)))
    elif kind == "swap":
        other = draw(st.sampled_from(range(len(parent)) if isinstance(parent, list) else sorted(parent)))
        parent[key], parent[other] = parent[other], node
    else:
        parent[key] = draw(scalars() if kind == "scalar" else values())


@st.composite
def damaged(draw: DrawFn, sound: bytes, most: int = 3) -> bytes:
    """Return bytes with a few changes, half of them near the beginning, where files say what comes."""
    data = bytearray(sound)
    for _ in range(draw(st.integers(1, most))):
        last = max(0, len(data) - 1)
        place = draw(st.integers(0, min(200, last)) | st.integers(0, last))
        size = draw(st.integers(1, 64))
        kind = draw(st.sampled_from(("flip", "number", "number", "cut", "remove", "repeat", "insert", "fill", "move")))
        if kind == "flip" and data:
            data[place] ^= 1 << draw(st.integers(0, 7))
        elif kind == "number":
            form = draw(st.sampled_from(("<B", "<H", ">H", "<I", ">I", "<Q", ">Q")))
            mask = (1 << 8 * struct.calcsize(form)) - 1
            number = struct.pack(form, draw(st.sampled_from(EXTREMES)) & mask)
            data[place : place + len(number)] = number
        elif kind == "cut":
            del data[place:]
        elif kind == "remove":
            del data[place : place + size]
        elif kind == "repeat":
            data[place:place] = data[place : place + size] * draw(st.sampled_from((1, 2, 50)))
        elif kind == "insert":
            data[place:place] = draw(st.binary(min_size=1, max_size=16))
        elif kind == "fill":
            data[place : place + size] = bytes([draw(st.sampled_from((0, 0x20, 0x5B, 0x7F, 0xFF)))]) * size
        else:
            to = draw(st.integers(0, last))
            data[to : to + size] = data[place : place + size]
    return bytes(data)


@st.composite
def damaged_text(draw: DrawFn, sound: str) -> bytes:
    """Return lines of words, of which a few were changed, or their bytes."""
    if draw(st.integers(0, 2)) == 0:
        return draw(damaged(sound.encode()))
    lines = sound.split("\n")
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.integers(0, len(lines) - 1))
        words = lines[place].split(" ")
        kind = draw(st.sampled_from(("word", "word", "word", "remove", "repeat", "swap", "line", "cut")))
        if kind == "word":
            words[draw(st.integers(0, len(words) - 1))] = _printed(draw(scalars()))
            lines[place] = " ".join(words)
        elif kind == "remove":
            del lines[place]
        elif kind == "repeat":
            lines[place:place] = [lines[place]] * draw(st.sampled_from((1, 3, 300)))
        elif kind == "swap":
            other = draw(st.integers(0, len(lines) - 1))
            lines[place], lines[other] = lines[other], lines[place]
        elif kind == "line":
            lines.insert(place, _printed(draw(scalars())))
        else:
            lines[place] = " ".join(words[: draw(st.integers(0, len(words)))])
        lines = lines or [""]
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def _printed(value: Any) -> str:
    return value if isinstance(value, str) else repr(value)


@st.composite
def changed_array(draw: DrawFn, sound: np.ndarray) -> np.ndarray:
    """Return an array of another type, another shape or with other numbers."""
    array = sound.copy()
    for _ in range(draw(st.integers(1, 2))):
        kind = draw(
            st.sampled_from(("number", "number", "number", "type", "object", "shape", "rows", "flat", "order", "scale"))
        )
        if kind == "number" and array.size and array.dtype.kind in "fiu":
            number = draw(st.sampled_from(NUMBERS[12:]) | st.floats())
            with np.errstate(all="ignore"):
                array.reshape(-1)[draw(st.integers(0, array.size - 1))] = np.asarray(number).astype(array.dtype)
        elif kind == "type" and array.dtype.kind in "fiub":
            with np.errstate(all="ignore"):
                dtype = np.dtype(draw(st.sampled_from(TYPES)))
                array = array.astype(dtype) if dtype.kind not in "MmV" else np.zeros(array.shape, dtype)
        elif kind == "object":
            array = np.array([{"a": 1}, None], dtype=object)
        elif kind == "shape":
            array = np.zeros(
                draw(st.sampled_from(((), (0,), (1,), (0, 17), (1, 0, 3), (2, 2, 2, 2, 2), (1,) * 20))), array.dtype
            )
        elif kind == "rows" and array.ndim:
            array = np.concatenate([array] * draw(st.sampled_from((0, 2, 3))) or [array[:0]])
        elif kind == "flat":
            array = array.reshape(-1)
        elif kind == "order":
            array = np.asfortranarray(array.T)
        elif kind == "scale" and array.dtype.kind == "f":
            with np.errstate(all="ignore"):
                array = array * array.dtype.type(draw(st.sampled_from((-1.0, 1e-20, 1e-3, 1e3, 1e20))))
    return array


def saved(array: np.ndarray) -> bytes:
    """Return a .npy file; arrays of objects are pickled in it."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()
