"""One set of cameras as each program writes it; the last three letters of w2c and c2w say which way a matrix leads."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from other_captures import opencv_pose
from PIL import Image
from support.other_formats import put
from support.posed_captures import Known, quaternion, ring, write_pictures

KNOWN = Known(c2w=ring(9), focal=(20.0, 21.0), center=(7.5, 6.25))
SQUARE = Known(c2w=ring(9), focal=(20.0, 20.0), center=(7.5, 6.25))
MIDDLE = Known(c2w=ring(9), focal=(20.0, 20.0), center=(8.0, 6.0))
VIEWS = range(9)


def c2w(known: Known, view: int) -> np.ndarray:
    return opencv_pose(known, view)


def w2c(known: Known, view: int) -> np.ndarray:
    return np.linalg.inv(opencv_pose(known, view))


def matrix(known: Known) -> list[list[float]]:
    (fx, fy), (cx, cy) = known.focal, known.center
    return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]


def words(numbers: object) -> str:
    return " ".join(repr(float(number)) for number in np.ravel(numbers))


def dump(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1))


def text(path: Path, lines: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def as_text(content: object) -> object:
    """Return json as boost writes it: every number as text."""
    if isinstance(content, dict):
        return {key: as_text(value) for key, value in content.items()}
    return [as_text(each) for each in content] if isinstance(content, list) else str(content)


def write_sdfstudio(root: Path, known: Known) -> None:
    frames = []
    for view in VIEWS:
        put(root / f"{view:06d}_rgb.png", view, known)
        k = np.eye(4)
        k[:3, :3] = matrix(known)
        frames.append(
            {"rgb_path": f"{view:06d}_rgb.png", "camtoworld": c2w(known, view).tolist(), "intrinsics": k.tolist()}
        )
    frames[0]["mono_depth_path"] = "000000_depth.npy"
    top = {"width": 16, "height": 12, "camera_model": "OPENCV", "worldtogt": np.eye(4).tolist()}
    dump(root / "meta_data.json", top | {"frames": frames})


def meshroom(known: Known, intrinsic: dict, version: str = "1.2.8", **view: object) -> dict:
    """Return AliceVision's content: a rotation is that of world to camera, written column by column."""
    views = [
        {"viewId": 70 + number, "poseId": 70 + number, "intrinsicId": 5, "path": f"/home/user/{name}"} | view
        for number, name in enumerate(known.names)
    ]
    poses = []
    for number in VIEWS:
        place = {"rotation": w2c(known, number)[:3, :3].T.ravel().tolist(), "center": known.c2w[number, :, 3].tolist()}
        poses.append({"poseId": 70 + number, "pose": {"transform": place, "locked": 0}})
    shared = {"intrinsicId": 5, "width": 16, "height": 12, "serialNumber": ""}
    content = {"version": version.split("."), "views": views, "intrinsics": [shared | intrinsic], "poses": poses}
    return content | {"structure": [{"landmarkId": 1, "X": [0, 1, 2]}]}


NOW = {
    "sensorWidth": 36,
    "type": "pinhole",
    "focalLength": 20 * 36 / 16,
    "pixelRatio": 21 / 20,
    "principalPoint": [-0.5, 0.25],
    "distortionType": "none",
    "distortionParams": "",
}


def write_meshroom(root: Path, known: Known, intrinsic: dict = NOW, **more: object) -> None:
    write_pictures(root / "images", known.names, known.size)
    dump(root / "cameras.sfm", as_text(meshroom(known, intrinsic, **more)))


def write_openmvg(
    root: Path, known: Known, kind: str = "pinhole", data: dict | None = None, nested: bool = False
) -> None:
    write_pictures(root / "images", known.names, known.size)
    base = {"width": 16, "height": 12, "focal_length": 20.0, "principal_point": [7.5, 6.25]}
    said = ({"value0": base} if nested else base) | (data or {})
    views = [
        {"filename": name, "local_path": "", "id_view": number, "id_intrinsic": number % 2, "id_pose": number}
        for number, name in enumerate(known.names)
    ]
    views.append({"filename": "unposed.png", "id_view": 99, "id_intrinsic": 0, "id_pose": 99})
    extrinsics = [
        {"rotation": w2c(known, number)[:3, :3].tolist(), "center": known.c2w[number, :, 3].tolist()}
        for number in VIEWS
    ]
    intrinsics = [
        {"polymorphic_id": 2147483649, "polymorphic_name": kind, "ptr_wrapper": {"id": 1, "data": said}},
        {"polymorphic_id": 1, "ptr_wrapper": {"id": 2, "data": said}},
    ]

    def keyed(values: list) -> list[dict]:
        return [{"key": key, "value": value} for key, value in enumerate(values)]

    content = {"views": keyed([{"ptr_wrapper": {"data": view}} for view in views]), "extrinsics": keyed(extrinsics)}
    content |= {"sfm_data_version": "0.3", "intrinsics": keyed(intrinsics), "structure": keyed([{"X": [0, 1, 2]}])}
    dump(root / "sfm_data.json", content)


BROWN = {"projection_type": "brown", "focal_x": 20 / 16, "focal_y": 21 / 16, "c_x": -0.5 / 16, "c_y": 0.25 / 16}


def opensfm(known: Known, camera: dict = BROWN) -> dict:
    shots = {}
    for view, name in enumerate(known.names):
        pose = w2c(known, view)
        w, *axis = quaternion(pose[:3, :3])
        vector = 2 * np.arccos(np.clip(w, -1, 1)) * np.array(axis) / np.linalg.norm(axis)
        shots[name] = {"rotation": vector.tolist(), "translation": pose[:3, 3].tolist(), "camera": "a"}
    points = {"7": {"coordinates": [0, 1, 2], "color": [1, 2, 3]}}
    return {"cameras": {"a": {"width": 16, "height": 12} | camera}, "shots": shots, "points": points}


def write_opensfm(root: Path, known: Known, camera: dict = BROWN, place: str = "", images: str = "images") -> None:
    write_pictures(root / images, known.names, known.size)
    dump(root / place / "reconstruction.json", [opensfm(known, camera)])


def write_bundler(root: Path, known: Known, behind: str = "") -> None:
    """Write poses with axes right, up, back, and a camera without pose at the end."""
    write_pictures(root / "images", known.names, known.size)
    lines = ["# Bundle file v0.3", "10 1"]
    for view in VIEWS:
        rotation, center = known.c2w[view, :, :3].T, known.c2w[view, :, 3]
        lines += ["20.0 0.1 -0.02", *map(words, rotation), words(-rotation @ center)]
    lines += ["0 0 0"] * 5 + ["0 1 2", "255 0 0", "1 0 5 1.5 2.5"]
    text(root / "bundle.out", lines)
    text(root / "list.txt", [f"images/{name}{behind}" for name in (*known.names, "unposed.png")])


def write_nerfies(root: Path, known: Known) -> None:
    ids = [f"{view:06d}" for view in VIEWS]
    for view, name in enumerate(ids):
        put(root / "rgb" / "1x" / f"{name}.png", view, known)
        camera = {"orientation": w2c(known, view)[:3, :3].tolist(), "position": known.c2w[view, :, 3].tolist()}
        camera |= {"focal_length": 20.0, "pixel_aspect_ratio": 1.05, "principal_point": [7.5, 6.25], "skew": 0.0}
        camera |= {"radial_distortion": [0.1, 0.2, 0.3], "tangential_distortion": [0.01, 0.02], "image_size": [16, 12]}
        dump(root / "camera" / f"{name}.json", camera)
    dump(root / "dataset.json", {"count": 9, "ids": ids, "train_ids": ids[:6], "val_ids": ids[6:]})
    dump(root / "metadata.json", {name: {"warp_id": view, "camera_id": 0} for view, name in enumerate(ids)})
    dump(root / "scene.json", {"scale": 0.1, "center": [0, 0, 0], "near": 0.2, "far": 0.9})


def write_splat_cameras(root: Path, known: Known) -> None:
    write_pictures(root / "images", known.names, known.size)
    cameras = []
    for view, name in enumerate(known.names):
        pose = c2w(known, view)
        place = {"position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()}
        size = {"width": 16, "height": 12, "fx": 20.0, "fy": 20.0}
        cameras.append({"id": view, "img_name": name.removesuffix(".png")} | size | place)
    dump(root / "cameras.json", cameras)


def write_scannet(root: Path, known: Known) -> None:
    k = np.eye(4)
    k[:3, :3] = matrix(known)
    text(root / "intrinsic" / "intrinsic_color.txt", list(map(words, k)))
    for view in VIEWS:
        put(root / "color" / f"{view}.png", view, known)
        text(root / "pose" / f"{view}.txt", list(map(words, c2w(known, view))))


def write_seven_scenes(root: Path, known: Known, info: bool = True) -> None:
    for view in VIEWS:
        put(root / f"frame-{view:06d}.color.png", view, known)
        text(root / f"frame-{view:06d}.pose.txt", ["\t".join(map(str, row)) for row in c2w(known, view)])
    k = np.eye(4)
    k[:3, :3] = matrix(known)
    lines = ["m_colorWidth = 16", "m_colorHeight = 12", f"m_calibrationColorIntrinsic = {words(k)} "]
    if info:
        text(root / "info.txt", ["m_versionNumber = 4", *lines, "m_frames.size = 9"])


def write_mvsnet(root: Path, known: Known) -> None:
    for view in VIEWS:
        put(root / "images" / f"{view:08d}.png", view, known)
        lines = ["extrinsic", *map(words, w2c(known, view)), "", "intrinsic", *map(words, matrix(known)), ""]
        text(root / "cams" / f"{view:08d}_cam.txt", [*lines, "1.0 0.01 192 3.0"])


def write_scanner_app(root: Path, known: Known) -> None:
    """Write ARKit's axes right, up, back; the last pose has no picture."""
    for view in (*VIEWS, 9):
        pose = np.eye(4)
        pose[:3] = known.c2w[view % 9]
        said = {"cameraPoseARFrame": pose.ravel().tolist(), "intrinsics": np.ravel(matrix(known)).tolist()}
        dump(root / f"frame_{view:05d}.json", said | {"time": view / 30, "frame_index": view})
        if view < 9:
            put(root / f"frame_{view:05d}.png", view, known)
    Image.new("I;16", (4, 3), 2000).save(root / "depth_00002.png")


def write_tum(root: Path, known: Known) -> None:
    rgb, poses = ["# color images"], ["# timestamp tx ty tz qx qy qz qw"]
    for view in VIEWS:
        put(root / "rgb" / f"{view}.png", view, known)
        w, x, y, z = quaternion(c2w(known, view)[:3, :3])
        rgb.append(f"{1305031102.0 + view} rgb/{view}.png")
        poses.append(f"{1305031102.01 + view} {words(known.c2w[view, :, 3])} {words([x, y, z, w])}")
        poses.append(f"{1305031102.5 + view} 0 0 0 0 0 0 1")
    text(root / "rgb.txt", rgb)
    text(root / "groundtruth.txt", poses)


def write_replica(root: Path, known: Known) -> None:
    for view in VIEWS:
        put(root / "results" / f"frame{view:06d}.png", view, known)
        Image.new("I;16", (16, 12), 2000).save(root / "results" / f"depth{view:06d}.png")
    text(root / "traj.txt", [words(c2w(known, view)) for view in VIEWS])
    camera = {"w": 16, "h": 12, "fx": 20, "fy": 21, "cx": 7.5, "cy": 6.25, "scale": 6553.5}
    dump(root / "cam_params.json", {"camera": camera})


def write_tanks(root: Path, known: Known) -> None:
    lines = []
    for view in VIEWS:
        put(root / "images" / f"{view + 1:06d}.png", view, known)
        lines += [f"{view} {view} 0", *map(words, c2w(known, view))]
    text(root / "Truck_COLMAP_SfM.log", lines)


def write_real_estate(root: Path, known: Known) -> None:
    lines = ["https://www.youtube.com/watch?v=x"]
    for view in VIEWS:
        put(root / "images" / f"{1000 * view + 33}.png", view, known)
        shares = [20 / 16, 21 / 12, 7.5 / 16, 6.25 / 12, 0, 0]
        lines.append(f"{1000 * view + 33} {words(shares)} {words(w2c(known, view)[:3])}")
    text(root / "0000cc6d.txt", lines)


def write_stray(root: Path, known: Known, later: bool = False) -> None:
    text(root / "camera_matrix.csv", [", ".join(map(str, row)) for row in matrix(known)])
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw" + ", fx, fy, cx, cy, distortion_center_x" * later]
    for view in VIEWS:
        put(root / "rgb" / f"{view:06d}.png", view, known)
        w, *axis = quaternion(c2w(known, view)[:3, :3])
        row = [*known.c2w[view, :, 3], *axis, w, *([30, 31, 7, 6] * later)]
        lines.append(f"{view / 60}, {view:06d}, " + ", ".join(map(repr, map(float, row))) + ", " * later)
    text(root / "odometry.csv", lines)
    (root / "depth").mkdir()
    (root / "confidence").mkdir()
    Image.new("I;16", (4, 3), 2000).save(root / "depth" / "000002.png")


Writer = Callable[..., None]
