"""The same cameras in the Blender format, and points in PLY files."""

import json
from pathlib import Path

import numpy as np
from PIL import Image
from support.posed_captures import Known, photograph

SPLIT_AT = 6
"""The first views are learned from where a format has splits."""


def put(path: Path, view: int, known: Known) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(photograph(view, *known.size)).save(path)


def write_blender(root: Path, known: Known, opaque: bool, folder: str = "", top: dict | None = None) -> Path:
    """Write transforms_train.json and transforms_test.json, whose pictures are called alike."""
    angle = 2 * np.arctan(known.size[0] / 2 / known.focal[0])
    for split, views in (("train", range(SPLIT_AT)), ("test", range(SPLIT_AT, len(known.c2w)))):
        frames = []
        for view in views:
            path = root / split / folder / f"r_{view % SPLIT_AT}.png"
            put(path, view, known)
            if not opaque:
                picture = Image.open(path).convert("RGBA")
                picture.putpixel((0, 0), (*picture.getpixel((0, 0))[:3], 254))
                picture.save(path)
            pose = np.concatenate([known.c2w[view], [[0.0, 0.0, 0.0, 1.0]]]).tolist()
            name = path.relative_to(root).with_suffix("").as_posix()
            frames.append({"file_path": f"./{name}", "transform_matrix": pose, "time": view / 8})
        content = {"camera_angle_x": angle, "frames": frames} | (top or {})
        (root / f"transforms_{split}.json").write_text(json.dumps(content))
    return root


def write_ply(path: Path, points: np.ndarray, form: str, extra: bool = False, kind: str = "float") -> Path:
    """Write points, behind a normal and before colors where `extra` says so."""
    names = ["nx", "x", "y", "z", "red"] if extra else ["x", "y", "z"]
    types = ["float", kind, kind, kind, "uchar"] if extra else [kind] * 3
    code = {"float": "f4", "double": "f8", "uchar": "u1"}
    order = ">" if "big" in form else "<"
    table = np.zeros(len(points), [(name, order + code[each]) for name, each in zip(names, types, strict=True)])
    for column, axis in enumerate("xyz"):
        table[axis] = points[:, column]
    header = ["ply", f"format {form} 1.0", "comment ours", f"element vertex {len(points)}"]
    header += [f"property {each} {name}" for name, each in zip(names, types, strict=True)]
    header += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    face = b"3 0 1 2\n" if form == "ascii" else b"\3" + bytes(12)
    rows = "".join(" ".join(map(str, row)) + "\n" for row in table.tolist()).encode()
    path.write_bytes("\n".join(header).encode() + (rows if form == "ascii" else table.tobytes()) + face)
    return path
