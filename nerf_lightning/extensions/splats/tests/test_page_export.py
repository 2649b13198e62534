"""The page as a file: its content, what it refuses, and that untrusted texts stay texts."""

import os
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from support.running import refused
from support.shiny_ball import RADIUS, all_around, record_of, run_of, shiny_model
from support.splat_page import read_page

from nerf_lightning.extensions.splats.page import PageExport
from nerf_lightning.files.html import is_scene_page
from nerf_lightning.nerf.geometry.clipping import CropBox

NAME = '</script><script>alert(1)</script><img src=x onerror="alert(2)">'


def exported(folder, scene=None, facts=(), **settings):
    scene = scene or all_around()
    what = PageExport(**({"num_splats": 300, "seconds": 0.0, "photographs": 4, "max_views": 1} | settings))
    with torch.no_grad():
        return what.export(shiny_model(), record_of(scene), folder, 65_536, run_of(scene, *facts))[0]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return exported(tmp_path_factory.mktemp("page"))


class Elements(HTMLParser):
    """Every element of a page with its attributes, and the text of those that hold some."""

    def __init__(self, text):
        super().__init__()
        self.found, self.texts = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.texts.append(data)


def test_the_page_holds_the_splats_the_cameras_and_the_photographs(page):
    about, splats = read_page(page)
    assert len(splats) == about["splats"] == 300
    assert float((splats.means.norm(dim=-1) - RADIUS).abs().median()) < 0.15  # the ball is soft
    assert len(about["cameras"]) == 4
    eye = np.array(about["cameras"][0]["eye"])
    np.testing.assert_allclose(eye, record_of(all_around()).cameras.c2w[0, :, 3], atol=1e-6)
    elements = Elements(page.read_text())
    pictures = [attrs["src"] for tag, attrs in elements.found if tag == "img" and "src" in attrs]
    assert len(pictures) == 1 + 4
    assert all(each.startswith("data:image/webp;base64,") for each in pictures)


def test_nothing_is_loaded_and_no_script_runs_but_the_pages_own(page):
    elements = Elements(page.read_text())
    policy = next(attrs["content"] for tag, attrs in elements.found if tag == "meta" and "http-equiv" in attrs)
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert "unsafe" not in policy
    assert not [attrs for _, attrs in elements.found if attrs.get("src", "data:")[:5] != "data:" or "href" in attrs]
    assert [attrs.get("type") for tag, attrs in elements.found if tag == "script"].count(None) == 1


def test_what_it_shows_of_the_model_is_printed_and_stands_in_the_page(tmp_path, capsys):
    target = exported(tmp_path, seconds=0.5)
    out = capsys.readouterr().out
    assert "size" in out
    assert "dB on 1 test view; the model, compared in the same way" in out
    assert "fitted to photographs for 0.5 s" in out
    text = target.read_text()
    assert " on 1 test view without lens distortion<" in text
    assert "without lens distortion" in text
    exported(tmp_path, max_views=0)  # over our own page
    assert "dB" not in capsys.readouterr().out


def test_texts_of_a_stranger_stay_texts(page, tmp_path):
    names = tuple(f"{NAME}{view}\x1b\u202e" for view in range(6))
    planted = exported(tmp_path, replace(all_around(), name=NAME, view_names=names), facts=[(NAME, NAME)])
    ours, theirs = Elements(page.read_text()), Elements(planted.read_text())
    # A fact about the model is a table more.
    table = ("h3", "table", "tr", "th", "td")
    assert [tag for tag, _ in theirs.found if tag not in table] == [tag for tag, _ in ours.found if tag not in table]
    assert theirs.texts.count(NAME) >= 4
    assert not {"onerror", "onload"} & {name for _, attrs in theirs.found for name in attrs}
    assert not {"\x1b", "\u202e"} & set(planted.read_text())


def test_one_turns_around_the_middle_of_a_crop_box(tmp_path):
    box = CropBox.from_user((0.2, -1.0, -1.0), (1.0, 1.0, 1.0), torch.eye(4))
    with torch.no_grad():
        what, run = PageExport(300, 0.0, photographs=3), replace(run_of(all_around()), crop=box)
        record = record_of(all_around(), space="contracted")  # else the middle is that of the splats anyway
        (target,) = what.export(shiny_model(), record, tmp_path, 65_536, run)
    about, splats = read_page(target)
    assert splats.means[:, 0].min() > 0.2
    assert about["middle"][0] > 0.25
    assert "(of the whole scene)" in target.read_text()


def test_without_photographs_the_cameras_are_still_there(tmp_path):
    what = PageExport(300, 0.0, photographs=3)
    with torch.no_grad():
        (target,) = what.export(shiny_model(), record_of(all_around()), tmp_path, 65_536)
    text = target.read_text()
    assert text.count('class="without"') == 3
    assert " on 6 test views" in text


def test_what_is_no_page_of_ours_is_not_written_over(tmp_path):
    model, record = shiny_model(), record_of(all_around())
    target = tmp_path / "page.html"
    target.write_text("<html>somebody's own</html>")
    refused(PageExport().export, model, record, tmp_path, 65_536, parts=("page.html", "would be lost", "Move it away"))
    assert target.read_text() == "<html>somebody's own</html>"
    target.unlink()
    target.mkdir()
    refused(PageExport().export, model, record, tmp_path, 65_536, parts=("page.html is a folder",))


def test_a_page_is_known_by_its_beginning(page, tmp_path):
    assert is_scene_page(page)
    other = tmp_path / "other.html"
    other.write_text("<html></html>")
    assert not is_scene_page(other)
    if hasattr(os, "mkfifo"):  # not on Windows
        os.mkfifo(tmp_path / "pipe.html")
        assert not is_scene_page(tmp_path / "pipe.html")  # nobody writes: it would wait for ever


def test_a_negative_number_of_photographs_is_refused():
    refused(lambda: PageExport(photographs=-1), parts=("what.photographs=-1: give 0 or more",))
