"""The file of named views, notes and distances of a page (`what.views`), as the page saves it.

{"views": [{"name": "front", "position": [4, 0, 2], "look_at": [0, 0, 0.5], "up": [0, 0, 1], "fov": 40},
           {"name": "left", "photograph": "0012.jpg"}],
 "notes": [{"text": "a hinge", "position": [0.2, 0.1, 1]}],
 "distances": [{"from": [0, 0, 0], "to": [0, 0, 1.5]}]}

Points are in the frame and the units of the capture's own files; `fov` is in degrees across the width. A view may name
a photograph, whose camera it uses. Each list may be omitted.
"""

import math
from pathlib import Path
from reprlib import repr as brief
from typing import Any

import torch

from nerf_lightning.files.json_files import number, read_json
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.world_frame import directions_to_user, points_to_user
from nerf_lightning.nerf.types.scene import SceneRecord

Marks = dict[str, list[dict[str, Any]]]
KEYS: dict[str, tuple[str, ...]] = {
    "views": ("name", "position", "look_at", "up", "fov"),
    "notes": ("text", "position"),
    "distances": ("from", "to"),
}
LONGEST = 1000  # Characters of a text.


def read_marks(path: Path | None, record: SceneRecord) -> Marks:
    """Read the file of a page's marks; None: no marks. Views of photographs become those of their cameras."""
    content = {} if path is None else read_json(path)
    if not isinstance(content, dict) or not set(content) <= set(KEYS) or not all(map(_is_list, content.values())):
        raise InputError(f"{path} is {brief(content)}, but must be an object of lists of objects: {', '.join(KEYS)}.")
    found: Marks = {kind: [] for kind in KEYS}
    for kind, marks in content.items():
        for count, mark in enumerate(marks, start=1):
            where = f"{path}, {kind} {count}"
            given = _camera(mark["photograph"], record, where) | mark if "photograph" in mark else mark
            for key in KEYS[kind]:
                _require(given.get(key), key, where)
            found[kind].append({key: given[key] for key in KEYS[kind]})
    return found


def _is_list(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(each, dict) for each in value)


def _require(value: Any, key: str, where: str) -> None:
    if key in ("name", "text"):
        good, rule = isinstance(value, str) and 0 < len(value) <= LONGEST, f"a text of 1 to {LONGEST} characters"
    elif key == "fov":
        good, rule = 0 < (number(value) or 0) < 180, "between 0 and 180 degrees"
    else:
        good = isinstance(value, list) and len(value) == 3 and all(number(each) is not None for each in value)
        rule = "three numbers, [x, y, z]"
    if not good:
        raise InputError(f"{where}: {key} is {brief(value)}, but must be {rule}. Save the file from the page again.")


def _camera(name: Any, record: SceneRecord, where: str) -> dict[str, Any]:
    """Return the camera of a photograph in the file's form; it looks at a point as far away as the scene's box."""
    if name not in record.view_names:
        raise InputError(f"{where}: there is no photograph {brief(name)}; the first is {record.view_names[0]!r}.")
    view = record.view_names.index(name)
    c2w, center = record.cameras.c2w[view].double(), record.aabb.double().mean(dim=0)
    eye, back = c2w[:, 3], c2w[:, 2]
    away = torch.clamp((eye - center) @ back, min=0.1 * float((record.aabb[1] - record.aabb[0]).norm()))
    position, look_at = points_to_user(torch.stack([eye, eye - away * back]), record.to_user)
    # The page's window and films have the aspect ratio of the first photograph.
    shape = float(record.cameras.width[0] / record.cameras.height[0])
    half = 0.5 * shape * float(record.cameras.height[view] / record.cameras.focal[view, 1])
    return {
        "name": name,
        "position": position.tolist(),
        "look_at": look_at.tolist(),
        "up": directions_to_user(c2w[:, 1], record.to_user).tolist(),
        "fov": 2 * math.degrees(math.atan(half)),
    }
