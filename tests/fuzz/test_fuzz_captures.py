"""Damaged captures, format by format: a scene that a checkpoint can keep, or one paragraph."""

import io
import json
import shutil
import zipfile

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.captures import npz_content, write_blender
from support.fuzzing import fuzzed, harmless
from support.mutations import changed_array, damaged, damaged_text, mutated, saved
from support.posed_captures import Known, read, ring, write_colmap, write_llff, write_transforms

from nerf_lightning.checkpoints.format import scene as kept_scene
from nerf_lightning.checkpoints.possible_scenes import require_possible_scene
from nerf_lightning.checkpoints.reading import make_record
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.readers.npz import NpzReader
from nerf_lightning.nerf.geometry.cameras import coarse_pixels, rays_through_pixels

WRITERS = {
    "transforms": write_transforms,
    "llff": write_llff,
    "colmap": write_colmap,
    "text": lambda root, known: write_colmap(root, known, ".txt"),
    "npz": lambda root, known: root.mkdir() or np.savez(root / "a.npz", **npz_content(count=4)),
    "blender": lambda root, known: write_blender(root, {"train": 3, "val": 1, "test": 1}),
}
LENS = {"k1": 0.01, "p1": 0.001, "camera_model": "OPENCV", "aabb_scale": 4, "offset": [0.5, 0.5, 0.5], "scale": 0.33}
APPLIED = {"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 1.0}


class Captures:
    """Sound captures, of which a case replaces single files."""

    def __init__(self, folder):
        self.folder, self.sound = folder, {}
        for kind, write in WRITERS.items():
            write(folder / kind, Known(c2w=ring(4)))
            self.sound[kind] = {path: path.read_bytes() for path in (folder / kind).rglob("*") if path.is_file()}

    def content(self, kind, name):
        return self.sound[kind][self.folder / kind / name]

    def read(self, kind, changed):
        """Read a capture of which some files were changed, and expect no harm."""
        for path, content in self.sound[kind].items():
            name = path.relative_to(self.folder / kind).as_posix()
            wanted = changed.get(name, content)
            if name in changed or path.read_bytes() != wanted:
                path.write_bytes(wanted)
        found = harmless(self._scene, kind)
        assert sorted(path.name for path in self.folder.iterdir()) == sorted([*WRITERS, "cache"])
        shutil.rmtree(self.folder / "cache")
        (self.folder / "cache").mkdir(mode=0o700)
        for path in self.sound[kind].keys() & {self.folder / kind / name for name in changed}:
            path.write_bytes(self.sound[kind][path])
        return found

    def _scene(self, kind):
        root = self.folder / kind
        if kind == "npz":
            scene = NpzReader(str(root / "a.npz"), max_gigabytes=0.1).read()
        elif kind == "blender":
            scene = BlenderReader(str(root)).read()
        else:
            scene = read("colmap" if kind == "text" else kind, root)
        require_sound(scene)
        return scene


def require_sound(scene):
    """Expect that a run on this scene leaves a checkpoint that is read, and that its rays are rays."""
    record = make_record(scene, "", {})["scene"]
    kept_scene().require(record, "scene", {})
    require_possible_scene(record, "the scene")
    cameras = scene.cameras
    rays = rays_through_pixels(cameras, coarse_pixels(cameras), scene.near, scene.far)
    assert bool(torch.isfinite(rays.origins).all() and torch.isfinite(rays.directions).all())


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures")
    (folder / "cache").mkdir(mode=0o700)
    return Captures(folder)


@pytest.mark.parametrize("kind", WRITERS)
def test_a_sound_capture_is_read(captures, kind):
    assert captures.read(kind, {}) is not None


@fuzzed(40)
@given(data=st.data())
def test_transforms(captures, data):
    sound = json.loads(captures.content("transforms", "transforms.json")) | LENS | APPLIED
    names = [frame["file_path"] for frame in sound["frames"]]
    masks = {"mask_path": names[0]}
    sound["frames"][0] |= data.draw(st.sampled_from(({}, {"fl_x": 20.0, "w": 16, "h": 12}, masks)))
    sound |= data.draw(st.sampled_from(({}, {"train_filenames": names[:3], "test_filenames": names[3:]})))
    content = json.dumps(data.draw(mutated(sound))).encode()
    captures.read("transforms", {"transforms.json": content})


@fuzzed(10)
@given(data=st.data())
def test_transforms_of_damaged_bytes(captures, data):
    content = data.draw(damaged(captures.content("transforms", "transforms.json")))
    captures.read("transforms", {"transforms.json": content})


@fuzzed(30)
@given(data=st.data())
def test_blender(captures, data):
    name = data.draw(st.sampled_from(("transforms_train.json", "transforms_test.json")))
    content = json.dumps(data.draw(mutated(json.loads(captures.content("blender", name))))).encode()
    captures.read("blender", {name: content})


@fuzzed(40)
@given(data=st.data())
def test_colmap(captures, data):
    names = ("cameras", "images", "points3D")
    name = f"sparse/0/{data.draw(st.sampled_from(names))}.bin"
    captures.read("colmap", {name: data.draw(damaged(captures.content("colmap", name)))})


@fuzzed(30)
@given(data=st.data())
def test_colmap_texts(captures, data):
    names = ("cameras", "images", "points3D")
    name = f"sparse/0/{data.draw(st.sampled_from(names))}.txt"
    captures.read("text", {name: data.draw(damaged_text(captures.content("text", name).decode()))})


@fuzzed(25)
@given(data=st.data())
def test_llff(captures, data):
    rows = np.load(io.BytesIO(captures.content("llff", "poses_bounds.npy")))
    content = saved(data.draw(changed_array(rows)))
    if data.draw(st.integers(0, 2)) == 0:
        content = data.draw(damaged(content))
    captures.read("llff", {"poses_bounds.npy": content})


@fuzzed(25)
@given(data=st.data())
def test_npz(captures, data):
    arrays = {key: np.asarray(array) for key, array in npz_content(count=4).items()}
    key = data.draw(st.sampled_from(sorted(arrays)))
    arrays[key] = data.draw(changed_array(arrays[key]))
    stream = io.BytesIO()
    with zipfile.ZipFile(
        stream, "w", data.draw(st.sampled_from((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
    ) as archive:
        for name, array in arrays.items():
            content = saved(array)
            archive.writestr(f"{name}.npy", content)
    content = stream.getvalue()
    if data.draw(st.booleans()):
        content = data.draw(damaged(content))
    captures.read("npz", {"a.npz": content})


@fuzzed(10)
@given(data=st.data())
def test_a_photograph_of_a_capture(captures, data):
    kind = data.draw(st.sampled_from(("llff", "blender")))
    name = "images/p_2.png" if kind == "llff" else "train/r_1.png"
    captures.read(kind, {name: data.draw(damaged(captures.content(kind, name)))})
