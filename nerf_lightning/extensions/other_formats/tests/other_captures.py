"""The same cameras in formats of other programs: Polycam, NeuS, NSVF, NeRF++, Metashape."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from support.other_formats import SPLIT_AT, put
from support.posed_captures import FLIP, Known, write_pictures


def opencv_pose(known: Known, view: int) -> np.ndarray:
    """Return a camera-to-world matrix with axes right, down, ahead."""
    pose = np.eye(4)
    pose[:3] = known.c2w[view]
    pose[:3, :3] = pose[:3, :3] @ FLIP
    return pose


def intrinsics(known: Known) -> np.ndarray:
    matrix = np.eye(4)
    matrix[[0, 1], [0, 1]], matrix[:2, 2] = known.focal, known.center
    return matrix


def write_polycam(root: Path, known: Known, kind: str = "", shift: float = 0.0) -> Path:
    """Write keyframes; `kind` is corrected_ for those that the app has refined."""
    (fx, fy), (cx, cy), (width, height) = known.focal, known.center, known.size
    folder = root / "keyframes" / f"{kind}cameras"
    folder.mkdir(parents=True)
    for view, pose in enumerate(known.c2w):
        put(root / "keyframes" / f"{kind}images" / f"{100 + view}.png", view, known)
        numbers = {f"t_{row}{column}": float(pose[row, column]) for row in range(3) for column in range(4)}
        numbers["t_03"] += shift
        camera = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height}
        (folder / f"{100 + view}.json").write_text(json.dumps(numbers | camera))
    return root


def write_neus(root: Path, known: Known, factor: float = 1.0, name: str = "{:03d}.png") -> Path:
    """Write projections, which are known up to a factor."""
    matrices = {}
    for view in range(len(known.c2w)):
        projection = np.eye(4)
        projection[:3] = factor * (intrinsics(known) @ np.linalg.inv(opencv_pose(known, view)))[:3]
        matrices |= {f"world_mat_{view}": projection, f"scale_mat_{view}": np.diag([3.0, 3.0, 3.0, 1.0])}
        put(root / "image" / name.format(view), view, known)
    np.savez(root / "cameras_sphere.npz", **matrices)
    return root


def write_nsvf(root: Path, known: Known, line: str = "20 8 6 0", separator: str = " ") -> Path:
    """Write a split into the first digit of each name."""
    (root / "pose").mkdir(parents=True)
    for view in range(len(known.c2w)):
        stem = f"{0 if view < SPLIT_AT else 2}_{view:04d}"
        put(root / "rgb" / f"{stem}.png", view, known)
        np.savetxt(root / "pose" / f"{stem}.txt", opencv_pose(known, view), delimiter=separator)
    (root / "intrinsics.txt").write_text(line)
    (root / "bbox.txt").write_text("-2 -2 -2 2 2 2 0.4")
    return root


def write_nerfpp(root: Path, known: Known, held: str = "test") -> Path:
    """Write train and one folder that is held out, whose pictures are called alike."""
    for view in range(len(known.c2w)):
        split, number = ("train", view) if view < SPLIT_AT else (held, view - SPLIT_AT)
        put(root / split / "rgb" / f"{number:06d}.png", view, known)
        for part, matrix in (("pose", opencv_pose(known, view)), ("intrinsics", intrinsics(known))):
            (root / split / part).mkdir(exist_ok=True)
            np.savetxt(root / split / part / f"{number:06d}.txt", matrix.reshape(1, 16))
    return root


def write_metashape(root: Path, known: Known, change: Callable[[str], str] = str, chunk: str = "") -> Path:
    """Write Agisoft's xml; the first cameras are in a group."""
    write_pictures(root / "images", known.names, known.size)
    cameras = [
        f'<camera id="{view}" sensor_id="0" label="p_{view}"><transform>'
        f"{' '.join(str(float(number)) for number in opencv_pose(known, view).ravel())}</transform></camera>"
        for view in range(len(known.c2w))
    ]
    size = f'<resolution width="{known.size[0]}" height="{known.size[1]}"/>'
    lens = f'<calibration class="adjusted">{size}<f>{known.focal[0]}</f></calibration>'
    sensor = f'<sensors><sensor id="0" type="frame">{size}{lens}</sensor></sensors>'
    listed = f'<cameras><group id="0">{"".join(cameras[:4])}</group>{"".join(cameras[4:])}</cameras>'
    xml = f'<?xml version="1.0"?><document version="2.0.0"><chunk>{sensor}{listed}{chunk}</chunk></document>'
    (root / "cameras.xml").write_text(change(xml))
    return root
