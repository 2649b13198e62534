"""`nerf export what=gallery`: a card for each run, its page linked or made, and a stranger's texts stay texts."""

import base64
import io
import re
from html.parser import HTMLParser
from urllib.parse import unquote

import pytest
from PIL import Image
from support.measured_runs import leave_measured_run
from support.running import said

from nerf_lightning.export.page import PageExport
from nerf_lightning.export.page_file import MARK

NAME = "<img src=x onerror=alert(1)>"


class Elements(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.found, self.texts = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.texts.append(data)


def leave_page(file, color="red", size=(64, 48)):
    content = io.BytesIO()
    Image.new("RGB", size, color).save(content, format="JPEG")
    still = f'<img id="still" src="data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}">'
    file.parent.mkdir(exist_ok=True)
    file.write_text(f"<!doctype html>\n{MARK.decode()}\n{still}")


@pytest.fixture
def sweep(tmp_path):
    """Three runs, two with a page; the one of the highest PSNR has a planted name and a planted setting."""
    folder = tmp_path / "sweep"
    leave_measured_run(folder / "0", 28.5, overrides=("model=nerf_tiny", "optimizer.lr=0.001"))
    leave_measured_run(folder / NAME, 31.0, overrides=("model=nerf_tiny", f'optimizer.lr="{NAME}"'))
    leave_measured_run(folder / "2", None, overrides=("model=nerf_tiny", "trainer.max_steps=7", "logger=none"))
    leave_page(folder / "0" / "export" / "page.html")
    leave_page(folder / NAME / "page.html", "blue")
    return folder


def test_each_run_has_a_card_with_its_picture_and_a_link_and_the_best_is_first(nerf, sweep):
    result = nerf("export", f"ckpt={sweep}", "what=gallery", "what.quality=null")
    assert result.code == 0, result.err
    assert f"no page      2: it has none (what.quality=null)\n{sweep}/gallery.html" in result.out
    elements = Elements((sweep / "gallery.html").read_text())
    links = [unquote(attrs["href"]) for tag, attrs in elements.found if tag == "a"]
    assert links == [f"./{NAME}/page.html"] * 2 + ["./0/export/page.html"] * 2
    for link in links:
        assert (sweep / link).is_file()
    pictures = [attrs["src"] for tag, attrs in elements.found if tag == "img"]
    assert len(pictures) == 2
    text = " ".join(elements.texts)
    assert re.search(r"31\.00 dB PSNR .* 28\.50 dB PSNR", text, re.DOTALL)
    assert "10 steps" in text
    assert "page of 0.0 MB" in text
    assert {"optimizer.lr", "trainer.max_steps"} < set(elements.texts)
    assert not {"model", "logger"} & set(elements.texts)


def test_texts_of_a_stranger_stay_texts_and_no_script_runs(nerf, sweep):
    assert nerf("export", f"ckpt={sweep}", "what=gallery", "what.quality=null").code == 0
    text = (sweep / "gallery.html").read_text()
    elements = Elements(text)
    assert NAME in elements.texts
    assert not [tag for tag, attrs in elements.found if tag == "script" or "onerror" in attrs]
    assert all(attrs["src"].startswith("data:image/jpeg;base64,") for tag, attrs in elements.found if tag == "img")
    assert all(attrs["href"].startswith("./") for tag, attrs in elements.found if tag == "a")
    policy = next(attrs["content"] for tag, attrs in elements.found if "http-equiv" in attrs)
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert "unsafe" not in policy


def endless():
    """Return a JPEG that goes over its pixels again and again."""
    content = io.BytesIO()
    Image.effect_noise((64, 64), 50).save(content, format="JPEG", progressive=True)
    last = content.getvalue().rfind(b"\xff\xda")
    return content.getvalue()[:last] + 200 * content.getvalue()[last:-2] + b"\xff\xd9"


@pytest.mark.parametrize("planted", ["AAAA", "/9j/", "", base64.b64encode(endless()).decode()])
def test_a_page_whose_picture_is_none_is_linked_without(nerf, sweep, planted):
    (sweep / "0" / "export" / "page.html").write_text(
        f'{MARK.decode()}<img id="still" src="data:image/jpeg;base64,{planted}"'
    )
    assert nerf("export", f"ckpt={sweep / '0'}", "what=gallery").code == 0
    text = (sweep / "0" / "gallery.html").read_text()
    assert "<img" not in text
    assert 'href="./export/page.html"' in text


def test_pages_that_are_missing_are_made_and_what_cannot_be_made_is_said(
    nerf, sweep, finished_run, tmp_path, monkeypatch
):
    asked = []

    def export(self, model, record, folder, tile_points):
        asked.append((self.quality, self.beside.photographs is not None))
        leave_page(folder / "page.html")
        return [folder / "page.html"]

    monkeypatch.setattr(PageExport, "export", export)
    where = f"paths.output_dir={tmp_path / 'out'}"
    made = finished_run / "export" / "page.html"
    try:
        result = nerf("export", f"ckpt=[{finished_run},{sweep / '2'}]", "what=gallery", "what.quality=small", where)
        assert result.code == 0, result.err
        assert asked == [("small", True)]
        assert made.is_file()
    finally:
        made.unlink(missing_ok=True)
    assert "no page      2: There is no checkpoint" in result.out
    text = (tmp_path / "out" / "gallery.html").read_text()
    assert "There is no checkpoint" in text
    assert "/run/export/page.html" in text


def test_runs_beyond_the_most_are_left_out_and_said(nerf, sweep):
    result = nerf("export", f"ckpt={sweep}", "what=gallery", "what.max_runs=1")
    assert "left out     2 runs (more with what.max_runs=N)" in result.out
    assert "sweep: 1 run" in Elements((sweep / "gallery.html").read_text()).texts


def test_bad_input_is_one_paragraph(nerf, sweep, tmp_path):
    said(nerf("export", f"ckpt={tmp_path / 'absent'}", "what=gallery"), "ckpt=", "there is no such folder")
    said(nerf("export", f"ckpt={sweep / '0' / 'export'}", "what=gallery"), "There is no run in")
    said(nerf("export", f"ckpt={sweep}", "what=gallery", "what.max_runs=0"), "what.max_runs=0", "1 or more")
    said(nerf("export", f"ckpt={sweep}", "what=gallery", "what.quality=huge"), "what.quality=huge", "small")
    (sweep / "gallery.html").write_text("somebody's own")
    said(nerf("export", f"ckpt={sweep}", "what=gallery"), "gallery.html", "would be lost")
    assert (sweep / "gallery.html").read_text() == "somebody's own"
