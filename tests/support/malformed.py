"""Ways to break a good capture, each with what must be said of it."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.posed_captures import Known, read, write_colmap, write_llff, write_transforms

from nerf_lightning.messages.errors import InputError

MODEL = Path("sparse/0")
WRITERS: dict[str, Callable[[Path], Path]] = {
    "llff": lambda root: write_llff(root, Known()),
    "colmap": lambda root: write_colmap(root, Known()),
    "text": lambda root: write_colmap(root, Known(), ".txt"),
    "transforms": lambda root: write_transforms(root, Known()),
}


def refused(kind: str, root: Path, message: str, **settings: object) -> None:
    """Read, and expect one paragraph and no other exception."""
    with pytest.raises(InputError, match=message) as caught:
        read("colmap" if kind == "text" else kind, root, **settings)
    text = str(caught.value)
    assert "\n" not in text
    assert text.endswith((".", ")")), text


def edit_rows(root: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    rows = np.load(root / "poses_bounds.npy")
    np.save(root / "poses_bounds.npy", change(rows))


def edit_bytes(root: Path, name: str, old: bytes, new: bytes) -> None:
    path = root / MODEL / name
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new))


def edit_text(root: Path, name: str, change: Callable[[str], str]) -> None:
    path = root / MODEL / name
    path.write_text(change(path.read_text()))


def edit_json(root: Path, change: Callable[[Any], Any]) -> None:
    path = root / "transforms.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def edit_frame(root: Path, view: int, **changed: object) -> None:
    def change(content: dict) -> dict:
        content["frames"][view] |= changed
        return content

    edit_json(root, change)


def one_picture(root: Path) -> Path:
    return root / "images" / "p_3.png"
