"""The page as a file: what stands in it, what it refuses, and that a stranger's texts stay texts."""

import os
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from support.baked_ball import all_around, baked_ball, beside, quiet, read_baked, record_of, shiny_model
from support.contracted_hall import hall_model, hall_record, hall_scene
from support.running import refused

from nerf_lightning.export.baking.cost import over
from nerf_lightning.export.baking.fitting import _TrainingRays, _Values, fitted
from nerf_lightning.export.baking.marcher import Marcher
from nerf_lightning.export.page import HARMONICS, PageExport
from nerf_lightning.export.page_file import is_page
from nerf_lightning.nerf.geometry.cameras import all_pixels
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import view_rays

NAME = '</script><script>alert(1)</script><img src=x onerror="alert(2)">'


def exported(folder, scene=None, facts=(), **settings):
    scene = scene or all_around()
    what = PageExport(**({"resolution": 24, "photographs": 4, "max_views": 1, "fit_steps": 0} | settings))
    what.beside = beside(scene, *facts)
    with torch.no_grad():
        return what.export(shiny_model(), record_of(scene), folder, 4096)[0]


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


def test_the_page_holds_the_field_the_cameras_and_the_photographs(page):
    about, baked = read_baked(page)
    assert baked.num_harmonics == HARMONICS["bounded"]["medium"] == about["harmonics"]
    assert max(baked.shape) <= 4
    assert len(about["cameras"]) == 4
    eye = np.array(about["cameras"][0]["eye"])
    np.testing.assert_allclose(eye, record_of(all_around()).cameras.c2w[0, :, 3], atol=1e-6)
    elements = Elements(page.read_text())
    pictures = [attrs["src"] for tag, attrs in elements.found if tag == "img" and "src" in attrs]
    assert len(pictures) == 1 + 4
    assert all(each.startswith("data:image/jpeg;base64,") for each in pictures)


def test_nothing_is_loaded_and_no_script_runs_but_the_pages_own(page):
    elements = Elements(page.read_text())
    policy = next(attrs["content"] for tag, attrs in elements.found if tag == "meta" and "http-equiv" in attrs)
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert "unsafe" not in policy
    assert not [attrs for _, attrs in elements.found if attrs.get("src", "data:")[:5] != "data:" or "href" in attrs]
    assert [attrs.get("type") for tag, attrs in elements.found if tag == "script"].count(None) == 1


def test_what_it_costs_is_printed_and_stands_in_the_page(page, tmp_path, capsys):
    target = exported(tmp_path)
    out = capsys.readouterr().out
    assert "size" in out
    assert "dB against the photographs of 1 test view, the model" in out
    assert "of density and" in out
    assert "dB against the photographs of 1 test view" in target.read_text()
    exported(tmp_path, max_views=0)  # over our own page
    assert "dB" not in capsys.readouterr().out


def test_texts_of_a_stranger_stay_texts(page, tmp_path):
    names = tuple(f"{NAME}{view}\x1b\u202e" for view in range(6))
    planted = exported(tmp_path, replace(all_around(), name=NAME, view_names=names), facts=[(NAME, NAME)])
    ours, theirs = Elements(page.read_text()), Elements(planted.read_text())
    # A fact more is a row more.
    assert [tag for tag, _ in theirs.found if tag not in ("tr", "th", "td")] == [
        tag for tag, _ in ours.found if tag not in ("tr", "th", "td")
    ]
    assert theirs.texts.count(NAME) >= 4
    assert not {"onerror", "onload"} & {name for _, attrs in theirs.found for name in attrs}
    assert not {"\x1b", "\u202e"} & set(planted.read_text())


def test_without_photographs_the_cameras_are_still_there(tmp_path):
    what = PageExport(resolution=24, photographs=3)
    with torch.no_grad():
        (target,) = what.export(shiny_model(), record_of(all_around()), tmp_path, 4096)
    text = target.read_text()
    assert text.count('class="without"') == 3
    assert "between their pictures of 6 test views" in text
    assert "against the photographs" not in text


def test_what_is_no_page_of_ours_is_not_written_over(tmp_path):
    model, record = shiny_model(), record_of(all_around())
    target = tmp_path / "page.html"
    target.write_text("<html>somebody's own</html>")
    refused(PageExport().export, model, record, tmp_path, 4096, parts=("page.html", "would be lost", "Move it away"))
    assert target.read_text() == "<html>somebody's own</html>"
    target.unlink()
    target.mkdir()
    refused(PageExport().export, model, record, tmp_path, 4096, parts=("page.html is a folder",))


def test_a_page_is_known_by_its_beginning(page, tmp_path):
    assert is_page(page)
    other = tmp_path / "other.html"
    other.write_text("<html></html>")
    assert not is_page(other)
    os.mkfifo(tmp_path / "pipe.html")
    assert not is_page(tmp_path / "pipe.html")  # nobody writes: it would wait for ever


WHITE, BLACK = (replace(all_around(), background=behind) for behind in ("white", "black"))


def error_of(baked, scene, view):
    """The squared error of a view, through what the page shows."""
    wanted = scene.pixels.view(view).float() / 255.0
    return float((shown(baked, scene, view) - wanted[..., :3]).double().square().sum())


def shown(baked, scene, view):
    rays = view_rays(RayGenerator(scene.cameras, scene.near, scene.far), all_pixels(scene.cameras, view))[0]
    return over(Marcher(baked).render(rays), scene.background)


def opaque(scene):
    rgba = scene.pixels.rgba.clone()
    rgba[:, 3] = 255
    return replace(scene, pixels=replace(scene.pixels, rgba=rgba))


@pytest.fixture(scope="module")
def ball():
    return baked_ball(24, 9)


@pytest.fixture(scope="module")
def hall():
    return baked_ball(48, 4, hall_model(), hall_record())


CASES = {
    "a box, before white": lambda ball, hall: (ball, opaque(WHITE), (90, 150)),
    # Of which no ray meets all: what is missing is as what is met.
    "a thin box, closed": lambda ball, hall: (replace(ball, closed=True), opaque(BLACK), (70, 95)),
    "all of space": lambda ball, hall: (hall, opaque(hall_scene()), (90, 150)),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_gradients_are_those_of_what_the_page_shows(ball, hall, case):
    """PageExtras differences of the marcher's errors, many bytes moved at once."""
    baked, scene, depths = case(ball, hall)
    # Nothing is clamped, and little so thin that it is left out, which no gradient knows of: without that rule, 3 %.
    baked = replace(baked, density=np.clip(baked.density, *depths), colors=np.clip(baked.colors, 90, 160))
    scene = replace(scene, splits={**scene.splits, "train": (0,)})
    values = _Values(baked)
    found = values.look_at(_TrainingRays(scene, [0]).of_step(0, values.marcher))
    assert found == pytest.approx(error_of(baked, scene, 0), rel=1e-4)
    gradient = 2.0 * values.gradient.sum(dim=0).double().numpy()
    random = np.random.default_rng(0)
    for column in (0, 1, 5, len(baked.colors)):
        # Half of them, so that a gradient at a wrong place is told from one at the right place.
        way = np.sign(gradient[:, column]) * random.choice([0, 1], len(gradient))
        way = way.astype(int)
        ends = [error_of(moved(baked, column, sign * way), scene, 0) for sign in (1, -1)]
        assert gradient[:, column] @ way > 0
        assert gradient[:, column] @ way == pytest.approx((ends[0] - ends[1]) / 2.0, rel=0.1)


def moved(baked, column, by):
    """A field one column of whose bytes is another."""
    if column:
        colors = baked.colors.copy()
        colors[column - 1] += by.astype(np.uint8)
        return replace(baked, colors=colors)
    density = baked.density.copy()
    density[baked.colored] += by.astype(np.uint8)
    return replace(baked, density=density)


def test_pictures_come_nearer_to_the_photographs(ball):
    spoilt = replace(ball, colors=np.where(np.arange(27)[:, None] < 3, ball.colors // 2, ball.colors))
    pictures = torch.cat([shown(ball, WHITE, view).flatten(0, 1) for view in range(6)])
    rgba = torch.cat([pictures, torch.ones(len(pictures), 1)], dim=-1)
    scene = replace(WHITE, pixels=replace(WHITE.pixels, rgba=(rgba * 255).round().to(torch.uint8)))
    scene = replace(scene, splits={"train": (0, 1, 2, 4, 5), "test": (3,)})
    found = fitted(spoilt, scene, record_of(scene), 20, quiet)
    assert error_of(found, scene, 0) < 0.2 * error_of(spoilt, scene, 0)
    assert error_of(found, scene, 3) < 0.5 * error_of(spoilt, scene, 3)  # not fitted to
    free = ~ball.colored
    np.testing.assert_array_equal(found.density[free], ball.density[free])
    np.testing.assert_array_equal((found.colors[3:].astype(int) - 128) % 8, 0)


def test_bits_do_not_depend_on_threads(ball):
    scene, threads, found = opaque(WHITE), torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            values = _Values(ball)
            error = values.look_at(_TrainingRays(scene, [0, 1]).of_step(0, values.marcher))
            found.append((error, values.gradient))
    finally:
        torch.set_num_threads(threads)
    assert found[0][0] == found[1][0]
    assert torch.equal(found[0][1], found[1][1])


def test_only_photographs_that_the_model_learnt_from_are_fitted_to(ball):
    scene = replace(WHITE, splits={"train": (0, 1), "test": (2,)})
    other = record_of(replace(scene, splits={"train": (2, 3), "test": ()}))
    assert fitted(ball, scene, other, 5, quiet) is ball
    assert fitted(ball, scene, record_of(scene), 0, quiet) is ball
    # Of the pixels of the others, and of those that a mask leaves out, nothing is asked for.
    mask = torch.zeros(len(scene.pixels.rgba), dtype=torch.uint8)
    mask[:100] = 1
    rays = _TrainingRays(replace(scene, pixels=replace(scene.pixels, mask=mask)), [0])
    assert len(rays.of_step(0, Marcher(ball)).rgb) == 100


def test_each_step_takes_other_pixels_and_all_have_their_turn(ball, monkeypatch):
    monkeypatch.setattr("nerf_lightning.export.baking.fitting.RAYS", 600)
    rays, marcher = _TrainingRays(opaque(WHITE), [1, 4]), Marcher(ball)
    wanted = [rays.of_step(step, marcher) for step in range(9)]
    ways = np.unique(np.concatenate([np.concatenate([each.origins, each.directions], 1) for each in wanted]), axis=0)
    assert len(ways) == 2 * 32 * 32
    assert max(len(each.rgb) for each in wanted) <= 700


def test_a_page_is_fitted_unless_the_cameras_have_corrections(tmp_path, monkeypatch):
    steps = []
    monkeypatch.setattr("nerf_lightning.export.page.fitted", lambda baked, *given: steps.append(given[2]) or baked)
    for corrected in (False, True):
        what = PageExport(resolution=16, photographs=1, max_views=0, fit_steps=7)
        what.beside = replace(beside(all_around()), corrected=corrected)
        with torch.no_grad():
            what.export(shiny_model(), record_of(all_around()), tmp_path, 4096)
    assert steps == [7]
