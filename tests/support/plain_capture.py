"""One capture, and whether a scene that was read of it otherwise is the same: each photograph with its own rays.

A photograph is told by its pixels, so that each is seen to have its own pose whatever it is called.
"""

import re

import numpy as np
import pytest
from support.posed_captures import READERS, Known, photograph, user_rays, write_transforms

from nerf_lightning.data.readers.auto import AutoReader

KNOWN, ALL = Known(), tuple(range(9))
PLACES = [(0.0, 0.0), (0.99, 0.0), (0.5, 0.5), (0.2, 0.9)]
WITHOUT_3 = tuple(view for view in ALL if view != 3)


@pytest.fixture(autouse=True)
def everything_is_said(caplog, monkeypatch, tmp_path):
    caplog.set_level("INFO")
    monkeypatch.setenv("NERF_LIGHTNING_CACHE", str(tmp_path / "cache"))


def read(root, kind="auto", **settings):
    return ({"auto": AutoReader} | READERS)[kind](root=str(root), **settings).read()


@pytest.fixture(name="plain", scope="module")
def plain_rays(tmp_path_factory):
    """The rays of each photograph of the plain capture, in its own frame."""
    folder = tmp_path_factory.mktemp("plain")
    reader = READERS["transforms"](root=str(write_transforms(folder / "c", KNOWN)), cache_dir=str(folder / "cache"))
    scene = reader.read()
    return [user_rays(scene, name, PLACES) for name in scene.view_names]


def shown(scene):
    """Return which photograph each view shows, turned as it may be."""
    turned = {}
    for view in ALL:
        picture = photograph(view, *KNOWN.size)
        turned |= {each.tobytes(): view for each in (picture, np.rot90(picture, 2))}
    return [turned.get(scene.pixels.view(number)[..., :3].numpy().tobytes()) for number in range(len(scene.view_names))]


def assert_plain(scene, plain, views=ALL):
    assert sorted(shown(scene)) == list(views)
    for name, view in zip(scene.view_names, shown(scene), strict=True):
        for found, true in zip(user_rays(scene, name, PLACES), plain[view], strict=True):
            np.testing.assert_allclose(found.numpy(), true.numpy(), atol=1e-4)


def said_once(caplog, words):
    lines = [record.getMessage() for record in caplog.records if re.search(words, record.getMessage())]
    assert len(lines) == 1, caplog.text


def files(root, pattern, change):
    for path in sorted(root.glob(pattern)):
        path.write_bytes(change(path.read_bytes()))


def renamed(old, new):
    return lambda root: (root / old).rename(root / new)


def to_utf_16(text):
    return text.decode().encode("utf-16")
