"""Sparse points in a PLY file, as COLMAP, nerfstudio and splat trainers write them: only positions are read."""

import os
from pathlib import Path

import numpy as np

from nerf_lightning.data.readers.colmap_files import ColmapPoints
from nerf_lightning.files.budgets import require_within
from nerf_lightning.files.regular import open_regular, read_lines
from nerf_lightning.files.trust import reading
from nerf_lightning.messages.errors import InputError

HEADER_BYTES = 1 << 16
ROWS = 1 << 14
"""Rows read at a time: splats have 248 bytes per point, of which 24 are kept."""
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float32": "f4", "float64": "f8"},
}
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
CURE = "Export the points again."


def read_ply_points(path: Path) -> ColmapPoints:
    """Return the vertices' positions; where they were seen is unknown.

    Raises:
        InputError: the file is not a PLY file, is truncated, or has more points than the user allows.
    """
    with reading(path, CURE), open_regular(path, "ply", CURE) as file:
        head = file.read(HEADER_BYTES)
        end = head.find(b"end_header")
        body = head.find(b"\n", end) + 1
        if not head.startswith(b"ply") or end < 0 or body == 0:
            raise InputError(f"{path} is not a PLY file. {CURE}")
        order, count, kind = _header(head[:end].decode("ascii", "replace"), path)
        require_within("points", count, path, "points")
        file.seek(body)
        if order == "ascii" and count:
            columns = [(kind.names or ()).index(axis) for axis in "xyz"]
            lines = read_lines(file, "ascii")
            positions = np.loadtxt(lines, usecols=columns, max_rows=count, ndmin=2, comments=None)
        else:
            whole = min(count, (os.fstat(file.fileno()).st_size - body) // kind.itemsize)
            positions = np.empty((whole, 3))
            for start in range(0, whole, ROWS):
                part = positions[start : start + ROWS]
                table = np.frombuffer(file.read(len(part) * kind.itemsize), kind)
                part[:] = np.stack([table[axis] for axis in "xyz"], axis=1)
        if len(positions) < count:
            raise InputError(f"{path} is cut short: it claims {count} points. {CURE}")
    return ColmapPoints(positions, np.full(len(positions), np.nan), np.zeros((0, 2), np.int64))


def _header(text: str, path: Path) -> tuple[str, int, np.dtype]:
    """Return the byte order, the number of vertices, and a vertex's dtype; vertices come first in a file."""
    lines = [line.split() for line in text.splitlines()]
    order = next((words[1] for words in lines if words[:1] == ["format"] and len(words) > 1), "")
    elements = [number for number, words in enumerate(lines) if words[:1] == ["element"]]
    first = lines[elements[0]] if elements else []
    if order not in ORDERS or len(first) != 3 or first[1] != "vertex" or not first[2].isdecimal():
        raise InputError(f"{path} is a PLY file of an unknown kind, or does not begin with its vertices. {CURE}")
    of_vertices = lines[elements[0] + 1 : elements[1] if len(elements) > 1 else len(lines)]
    properties = [words for words in of_vertices if words[:1] == ["property"]]
    if any(len(words) != 3 or words[1] not in TYPES for words in properties):
        raise InputError(f"{path} has vertices with lists or unknown types. {CURE}")
    kind = np.dtype([(words[2], ORDERS[order] + TYPES[words[1]]) for words in properties])
    if not {"x", "y", "z"} <= set(kind.names or ()):
        raise InputError(f"{path} has vertices without x, y and z. {CURE}")
    return order, int(first[2]), kind
