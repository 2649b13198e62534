"""Damaged files of the other kinds: camera paths, caches, curves, weights of LPIPS."""

import io
import json
import shutil
import struct
import zipfile

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from support.fuzzing import fuzzed, harmless
from support.mutations import changed_array, damaged, damaged_text, mutated, saved
from support.posed_captures import Known, read, ring, write_colmap
from support.scenes import ball_scene
from tensorboard.compat.proto.event_pb2 import Event
from torch.utils.tensorboard import SummaryWriter

from nerf_lightning.data.bricks.cache import Rendered, cached
from nerf_lightning.evaluation.lpips import LPIPS, load_lpips
from nerf_lightning.nerf.geometry.poses import is_rigid
from nerf_lightning.report.curves import curve_drawings, read_curves
from nerf_lightning.video.paths.base import frame_of
from nerf_lightning.video.paths.keyframe_path import KeyframePath

KEYFRAMES = {
    "keyframes": [
        {"position": [4.0, 0.0, 1.0], "look_at": [0.0, 0.0, 0.5], "fov": 40.0, "time": 0.0},
        {"position": [0.0, 4.0, 2.0], "direction": [0.0, -4.0, -1.5], "up": [0.0, 0.0, 1.0], "time": 0.5},
        {"position": [-4.0, 0.0, 1.0], "look_at": [0.0, 0.0, 0.5], "focal": 30.0, "time": 1.0},
    ]
}


@fuzzed(30)
@given(data=st.data())
def test_keyframes(tmp_path_factory, data):
    file = tmp_path_factory.getbasetemp() / "keys.yaml"
    without_times = {"keyframes": [{k: v for k, v in each.items() if k != "time"} for each in KEYFRAMES["keyframes"]]}
    sound = data.draw(st.sampled_from((KEYFRAMES, without_times)))
    if data.draw(st.integers(0, 2)):
        content = yaml.dump(data.draw(mutated(sound)), allow_unicode=True).encode("utf-8", "surrogatepass")
    else:
        content = data.draw(damaged_text(yaml.safe_dump(sound)))
    file.write_bytes(content)
    settings = {"num_frames": data.draw(st.sampled_from((None, 5))), "closed": data.draw(st.booleans())}
    harmless(cameras_on_path, str(file), **settings)


def cameras_on_path(file, **settings):
    scene = ball_scene()
    cameras = KeyframePath(file, **settings).cameras(frame_of(scene.cameras, scene.aabb))
    assert bool(torch.isfinite(cameras.c2w).all() and torch.isfinite(cameras.focal).all())
    assert bool(is_rigid(cameras.c2w.double()).all())
    assert bool((cameras.focal > 0).all())


@pytest.fixture(scope="module")
def colmap(tmp_path_factory):
    """A capture that was read before, and the files of the cache in which its pixels lie."""
    root = write_colmap(tmp_path_factory.mktemp("cached") / "capture", Known(c2w=ring(4)))
    pixels = read("colmap", root).pixels
    files = {path.suffix: path for path in (root.parent / "cache").iterdir()}
    return root, pixels.rgba.shape, {kind: (files[kind], files[kind].read_bytes()) for kind in (".json", ".pixels")}


@fuzzed(40)
@given(data=st.data())
def test_the_cache_of_pixels(colmap, data):
    """The user's own cache was written to: the pixels may be others then, but there are as many."""
    root, shape, kept = colmap
    for path, sound in kept.values():
        path.unlink(missing_ok=True)  # it is mapped, perhaps
        path.write_bytes(sound)
        path.chmod(0o600)
    path, sound = kept[data.draw(st.sampled_from((".json", ".pixels")))]
    if path.suffix == ".json" and data.draw(st.booleans()):
        content = json.dumps(data.draw(mutated(json.loads(sound)))).encode()
    else:
        content = data.draw(damaged(sound))
    path.unlink()
    path.write_bytes(content)
    path.chmod(0o600)
    found = harmless(read, "colmap", root)
    if found is not None:
        assert found.pixels.rgba.shape == shape
        assert int(found.pixels.rgba.sum()) >= 0  # all of it can be touched


@fuzzed(25)
@given(data=st.data())
def test_the_cache_of_the_bricks(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("bricks")
    sound = Rendered(np.zeros((6, 4), np.uint8), np.zeros(6, np.float32), np.zeros((6, 3), np.float32))
    arrays = dict(vars(sound))
    key = data.draw(st.sampled_from(sorted(arrays)))
    arrays[key] = data.draw(changed_array(arrays[key]))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, array in arrays.items():
            archive.writestr(f"{name}.npy", saved(array))
    content = data.draw(st.just(stream.getvalue()) | damaged(stream.getvalue()))
    (folder / "a.npz").write_bytes(content)
    found = harmless(cached, folder / "a.npz", 6, lambda: sound)
    assert [array.shape for array in vars(found).values()] == [(6, 4), (6,), (6, 3)]
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def events(tmp_path_factory):
    """The TensorBoard file of a short run."""
    folder = tmp_path_factory.mktemp("events")
    with SummaryWriter(str(folder)) as writer:
        for step in range(5):
            writer.add_scalar("train/psnr_fine", 20.0 + step, step)
            writer.add_scalar("train/loss", 0.1 / (1 + step), step)
        writer.add_histogram("h", torch.zeros(3), 0)
        writer.add_image("i", torch.zeros(3, 2, 2), 0)
    (file,) = folder.iterdir()
    return folder, file, file.read_bytes()


def record(content: bytes) -> bytes:
    """Return an event as it lies in the file."""
    from tensorboard.summary.writer.record_writer import masked_crc32c

    head = struct.pack("<Q", len(content))
    return head + struct.pack("<I", masked_crc32c(head)) + content + struct.pack("<I", masked_crc32c(content))


def drawn_event(draw) -> bytes:
    event = Event(step=draw(st.integers(-(2**63), 2**63 - 1)), wall_time=draw(st.floats()))
    names = st.sampled_from(
        ("train/psnr_fine", "val/psnr", "train/loss", "speed/rays_per_second", "<b>", "", "a" * 9000)
    )
    value = event.summary.value.add(tag=draw(names))
    kind = draw(st.sampled_from(("simple", "tensor", "image")))
    if kind == "simple":
        value.simple_value = draw(st.floats(width=32) | st.sampled_from((3.4e38, -3.4e38, 1e-45)))
    elif kind == "tensor":
        value.metadata.plugin_data.plugin_name = "scalars"
        value.tensor.dtype = draw(st.integers(0, 30))
        value.tensor.tensor_content = draw(st.binary(max_size=16))
        for _ in range(draw(st.integers(0, 3))):
            value.tensor.tensor_shape.dim.add(size=draw(st.sampled_from((0, 1, -1, 1 << 40))))
    return record(event.SerializeToString())


@fuzzed(15)
@given(data=st.data())
def test_curves(events, data):
    folder, file, sound = events
    if data.draw(st.booleans()):
        file.write_bytes(sound + b"".join(drawn_event(data.draw) for _ in range(data.draw(st.integers(1, 4)))))
    else:
        file.write_bytes(data.draw(damaged(sound)))
    harmless(drawn_curves, folder)


def drawn_curves(folder):
    return curve_drawings(read_curves(folder))


@pytest.fixture(scope="module")
def backbone():
    return LPIPS("alex").state_dict()


@fuzzed(15)
@given(data=st.data())
def test_weights_of_lpips(tmp_path_factory, backbone, data):
    file = tmp_path_factory.getbasetemp() / "alexnet.pth"
    state = dict(backbone)
    key = data.draw(st.sampled_from(sorted(state)))
    kind = data.draw(st.sampled_from(("value", "type", "shape", "else", "bytes", "sparse")))
    if kind == "value":
        state[key] = state[key] * data.draw(st.sampled_from((float("nan"), float("inf"), 1e30, 0.0)))
    elif kind == "type":
        state[key] = state[key].to(data.draw(st.sampled_from((torch.int8, torch.complex64, torch.float64, torch.bool))))
    elif kind == "shape":
        state[key] = data.draw(st.sampled_from((torch.zeros(0), torch.zeros(()), torch.zeros(1).expand(10**9))))
    elif kind == "sparse":
        state[key] = state[key].to_sparse()
    elif kind == "else":
        state = data.draw(mutated({name: [1.0] for name in backbone} | {"a": {"b": [1, 2]}}))
    torch.save(state, file)
    if kind == "bytes":
        file.write_bytes(data.draw(damaged(file.read_bytes())))
    harmless(score, str(file))


def score(weights):
    picture = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    found = load_lpips(weights, "alex").score(picture, 1 - picture)
    assert 0 <= found < float("inf")
