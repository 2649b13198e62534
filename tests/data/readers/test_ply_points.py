"""Points in PLY files of every kind, and files that are none."""

import re

import numpy as np
import pytest
from support.other_formats import write_ply
from support.posed_captures import Known, read, write_transforms

from nerf_lightning.data.readers.ply_points import read_ply_points
from nerf_lightning.messages.errors import InputError

FORMS = ("ascii", "binary_little_endian", "binary_big_endian")
POINTS = Known().points


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("extra", "kind"), [(False, "float"), (True, "float"), (True, "double")])
def test_positions_are_read_in_every_form(tmp_path, form, extra, kind):
    found = read_ply_points(write_ply(tmp_path / "p.ply", POINTS, form, extra, kind))
    np.testing.assert_allclose(found.positions, POINTS, rtol=1e-6 if kind == "float" else 0, atol=1e-7)
    assert np.isnan(found.errors).all()
    assert found.tracks.shape == (0, 2)


@pytest.mark.parametrize("form", FORMS)
def test_a_header_may_have_windows_ends_of_lines_and_no_points(tmp_path, form):
    path = write_ply(tmp_path / "p.ply", POINTS[:0], form)
    head, end, rest = path.read_bytes().partition(b"end_header\n")
    path.write_bytes((head + end).replace(b"\n", b"\r\n") + rest)
    assert read_ply_points(path).positions.shape == (0, 3)


def cut(lines):
    return lambda content: b"".join(content.splitlines(keepends=True)[:-lines])


@pytest.mark.parametrize(
    ("form", "change", "message"),
    [
        ("binary_little_endian", lambda c: c[:-40], r"is cut short: it claims 60 points"),
        ("ascii", cut(5), r"is cut short: it claims 60 points"),
        ("ascii", lambda c: c.replace(b"0.", b"no.", 1), r"p.ply cannot be read \(ValueError"),
        ("ascii", lambda c: c.replace(b"float x", b"list uchar int x"), r"vertices with lists or unknown types"),
        ("ascii", lambda c: c.replace(b"float x", b"half x"), r"vertices with lists or unknown types"),
        ("ascii", lambda c: c.replace(b"float x", b"float a"), r"vertices without x, y and z"),
        ("ascii", lambda c: c.replace(b"vertex 60", b"vertex -1"), r"unknown kind"),
        ("ascii", lambda c: c.replace(b"vertex 60", b"vertex"), r"unknown kind"),
        ("ascii", lambda c: c.replace(b"vertex 60", b"edge 60"), r"does not begin with its vertices"),
        ("ascii", lambda c: c.replace(b"vertex 60", b"vertex 99999999"), r"99,?999,?999 points"),
        ("ascii", lambda c: c.replace(b"ascii", b"binary"), r"unknown kind"),
        ("ascii", lambda _: b"v 1 2 3\n", r"is not a PLY file"),
        ("ascii", lambda _: b"", r"is not a PLY file"),
    ],
)
def test_what_is_no_whole_file_is_refused(tmp_path, form, change, message):
    path = write_ply(tmp_path / "p.ply", POINTS, form)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(InputError, match=message) as caught:
        read_ply_points(path)
    assert re.search(r"p\.ply", str(caught.value))


@pytest.mark.parametrize("name", ["p.ply", "./p.ply", ".\\p.ply", "/home/me/scan/p.ply", "../outside/p.ply"])
def test_points_of_a_json_are_found_in_the_capture_and_never_outside(tmp_path, name, caplog):
    root = write_transforms(tmp_path / "c", Known(), ply_file_path=name)
    (tmp_path / "outside").mkdir()
    write_ply(tmp_path / "outside" / "p.ply", POINTS[:7], "ascii")
    assert len(read("transforms", root).points) == 0
    assert caplog.text.count("the points of ply_file_path=") == 1
    write_ply(root / "p.ply", POINTS, "binary_little_endian")
    scene = read("transforms", root)
    points = scene.points.double() @ scene.to_user[:3, :3].mT + scene.to_user[:3, 3]
    np.testing.assert_allclose(points, POINTS, atol=1e-6)
