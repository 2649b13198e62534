"""Things before one plain color: what is found, what is not, and what is made transparent."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage
from support.captures import write_blender, write_npz
from support.posed_captures import Known, read, ring, write_transforms

from nerf_lightning.data.pixels.decoded_photographs import Photograph, read_photographs
from nerf_lightning.data.pixels.plain_background import cut_out, plain_color
from nerf_lightning.data.pixels.store import empty_store
from nerf_lightning.data.readers.blender import BlenderReader
from nerf_lightning.data.readers.npz import NpzReader
from nerf_lightning.nerf.types.scene import UNSURE

WIDTH, HEIGHT, VIEWS = 40, 30, 8
WHITE, BLACK, GREY = (255, 255, 255), (0, 0, 0), (90, 120, 90)


def content(view):
    """Return where a ring stands, which is elsewhere in each view, and where it is filled."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    distance = np.hypot(x - 14 - 0.5 * view, y - 12 - 0.25 * view)
    return (distance < 9) & (distance > 3), distance <= 3


def pictures(color=WHITE, noise=0, count=VIEWS):
    """Return opaque photographs of a colored ring, whose hole shows the plain background, too."""
    rng = np.random.default_rng(0)
    for view in range(count):
        rgb = np.array(color) + rng.integers(-noise, noise + 1, (HEIGHT, WIDTH, 3))
        rgb[content(view)[0]] = (200, 40 + 3 * view, 30)
        yield rgb.clip(0, 255).astype(np.uint8)


def store_of(rgbs):
    rgbs = list(rgbs)
    store = empty_store([(rgb.shape[1], rgb.shape[0]) for rgb in rgbs])
    for view, rgb in enumerate(rgbs):
        store.view(view).numpy()[..., :3] = rgb
        store.view(view)[..., 3] = 255
    return store


@pytest.mark.parametrize(("color", "noise"), [(WHITE, 0), (WHITE, 2), (BLACK, 2), (GREY, 1)])
def test_what_hangs_together_with_the_edge_is_made_transparent(color, noise):
    store = store_of(pictures(color, noise))
    before = store.rgba.clone()
    cut, found = cut_out(store, "rings", wanted=True)
    assert cut.has_transparency
    assert np.abs(np.subtract(found, color)).max() <= noise
    for view in range(VIEWS):
        ring_, hole = content(view)
        alpha = cut.view(view)[..., 3].numpy()
        assert np.array_equal(alpha > 0, ring_ | hole)
        # Holes show the background, and so may pixels that touch it.
        inner = ndimage.binary_erosion(ring_, np.ones((3, 3)))
        assert np.array_equal(alpha == 255, inner)
        assert (alpha[(ring_ | hole) & ~inner] == UNSURE).all()
    assert torch.equal(cut.rgba[:, :3], before[:, :3])


@pytest.mark.parametrize("name", ["noisy", "wanted", "alpha", "masks", "edges of many colors", "a thin margin"])
def test_anything_else_stays_as_it_is(name):
    rgbs = list(pictures(noise=8 if name == "noisy" else 0))
    if name == "edges of many colors":
        rgbs = [rgb if view % 2 else rgb // 2 for view, rgb in enumerate(rgbs)]
    if name == "a thin margin":
        rgbs = [np.full((100, 100, 3), 255, dtype=np.uint8) for _ in rgbs]
        for view, rgb in enumerate(rgbs):
            rgb[1:-1, 1 + view % 2 : -1] = 50 + view
    store = store_of(rgbs)
    if name == "alpha":
        store = replace(store, has_transparency=True)
    if name == "masks":
        store = replace(store, mask=torch.ones(len(store.rgba), dtype=torch.uint8))
    before = store.rgba.clone()
    same, color = cut_out(store, "rings", wanted=name != "wanted")
    assert color is None
    assert same is store
    assert torch.equal(store.rgba, before)


def test_a_frame_that_is_the_same_in_all_photographs_is_no_background():
    def framed(inside):
        for view in range(VIEWS):
            rgb = np.random.default_rng(view).integers(60, 200, (HEIGHT, WIDTH, 3)).astype(np.uint8)
            rgb[~inside(view)] = 0
            yield rgb

    y, x = np.mgrid[:HEIGHT, :WIDTH]
    rim = np.hypot(x - WIDTH / 2, y - HEIGHT / 2) < 14
    assert plain_color(store_of(framed(lambda view: rim))) is None
    moving = store_of(framed(lambda view: np.hypot(x - 10 - 2 * view, y - HEIGHT / 2) < 8))
    assert plain_color(moving) == BLACK


def test_one_photograph_in_ten_may_be_filled_by_the_thing():
    rgbs = list(pictures(count=20))
    rgbs[3][:, 5:] = 70
    cut, color = cut_out(store_of(rgbs), "rings", wanted=True)
    assert color == WHITE
    assert not cut.view(3)[:, :5, 3].any()
    assert (cut.view(3)[:, 5, 3] == UNSURE).all()
    assert (cut.view(3)[:, 6:, 3] == 255).all()
    rgbs[4], rgbs[5] = rgbs[3], rgbs[3]
    assert plain_color(store_of(rgbs)) is None


def test_a_mapped_store_stays_as_it_is_and_another_is_made_once(tmp_path, caplog):
    files = []
    for view, rgb in enumerate(pictures()):
        files.append(Photograph(tmp_path / f"{view}.png"))
        Image.fromarray(rgb).save(files[-1].path)
    opaque = read_photographs(files, 1, tmp_path / "cache", False, "Reading")
    first, _ = cut_out(opaque, "rings", wanted=True)
    second, _ = cut_out(read_photographs(files, 1, tmp_path / "cache", False, "Reading"), "rings", wanted=True)
    assert first.path == second.path != opaque.path
    assert len(list((tmp_path / "cache").glob("*.pixels"))) == 2
    assert (opaque.rgba[:, 3] == 255).all()
    in_memory, _ = cut_out(store_of(pictures()), "rings", wanted=True)
    assert torch.equal(first.rgba, in_memory.rgba)


def capture(root, color=WHITE):
    """Write a capture whose photographs are those rings."""
    known = Known(c2w=ring(VIEWS), size=(WIDTH, HEIGHT))
    write_transforms(root, known)
    for name, rgb in zip(known.names, pictures(color), strict=True):
        Image.fromarray(rgb).save(root / "images" / name)
    return root


def test_a_capture_before_white_stands_in_a_box_on_white(tmp_path, caplog):
    root = capture(tmp_path / "capture")
    with caplog.at_level("INFO"):
        scene = read("transforms", root)
    assert "on a plain white background, which was made transparent (scene.cut_out=false keeps it)" in caplog.text
    assert (scene.space, scene.background, scene.protocol["cut_out"]) == ("bounded", "white_or_random", "white")
    assert read("transforms", root, background="random").background == "random"
    kept = read("transforms", root, cut_out=False)
    assert (kept.space, kept.background, "cut_out" in kept.protocol) == ("contracted", "black", False)
    assert not read("transforms", root, background="none").pixels.has_transparency
    grey = read("transforms", capture(tmp_path / "grey", GREY))
    assert (grey.space, grey.background, grey.protocol["cut_out"]) == ("bounded", "random", "rgb(90, 120, 90)")


def test_blender_and_npz_scenes_are_cut_out_too(tmp_path):
    images = np.stack(list(pictures(BLACK, count=10)))
    scene = NpzReader(str(write_npz(tmp_path / "a.npz", images=images))).read()
    assert (scene.protocol["cut_out"], scene.background) == ("black", "black_or_random")
    assert not NpzReader(str(tmp_path / "a.npz"), cut_out=False).read().pixels.has_transparency
    root = write_blender(tmp_path / "blender", {"train": 6, "test": 2}, WIDTH, HEIGHT)
    for path in root.rglob("*.png"):
        Image.fromarray(images[int(path.stem[2:])]).save(path)
    scene = BlenderReader(str(root)).read()
    assert (scene.protocol["cut_out"], scene.background) == ("black", "black_or_random")
    assert BlenderReader(str(root), background="random").read().background == "random"
    assert not BlenderReader(str(root), cut_out=False).read().pixels.has_transparency
