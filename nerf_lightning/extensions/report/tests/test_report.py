"""`nerf report`: what the page holds, that it works in a browser, and that a stranger's run stays harmless in it."""

import html
import itertools
import json
import re
import shlex
import shutil

import pytest
from support.browser import SIZES, layout_faults, opened
from support.measured_runs import leave_measured_run
from support.running import FAST, done, output_of, said, start
from torch.utils.tensorboard import SummaryWriter

from nerf_lightning.config.help.candidates import candidates
from nerf_lightning.doctor.check import Check
from nerf_lightning.extensions.report.after_training import write_after_training
from nerf_lightning.extensions.report.commands import report
from nerf_lightning.extensions.report.read_run import _resume_command
from nerf_lightning.runs.file_steps import read_steps

TERMS = [f"photo_distortion_{number}" for number in range(7)]  # A legend that needs several lines on phones


@pytest.fixture(scope="module")
def page_of_run(finished_run, tmp_path_factory):
    """The page of a real run, written by a process of its own; with what the command printed."""
    folder = tmp_path_factory.mktemp("page")
    run = shutil.copytree(finished_run, folder / "run")
    with SummaryWriter(run / "tensorboard") as log:
        for term, step in itertools.product(TERMS, (1, 2)):
            log.add_scalar(f"Training loss/{term}", 1.0, step)
    output = output_of(start("report", run, f"paths.output_dir={folder}"))
    return folder / "report.html", output


def sections(text):
    return re.findall(r'<h2 id="(\w+)"', text)


def test_the_page_has_everything_and_loads_nothing(page_of_run, finished_run):
    path, output = page_of_run
    text = path.read_text()
    assert sections(text) == ["video", "worst", "steps", "curves", "capture", "numbers", "config"]
    assert f"report       {path}" in output
    assert "left out" not in output
    metrics = json.loads((finished_run / "metrics.json").read_text())
    result = json.loads((finished_run / "run.json").read_text())["result"]
    assert re.search(r"dB on test views; .+ To improve it, .+\.", result)
    assert html.unescape(re.search(r'<p id="result">(.+)</p>', text)[1]) == result
    # The page was made from a copy: its command names the copy.
    assert f'<pre id="command">nerf train resume={path.parent / "run"} ' in text
    assert str(finished_run) not in text[: text.index("<h2")]
    assert text.count("Depth, on one scale") == 1
    assert "</video>" in text
    assert read_steps(finished_run) == dict.fromkeys(("video.mp4", "depth.mp4", "progress.mp4"), 20)
    assert " of 20)" not in text
    stamps = metrics["protocol"]["split_hash"], metrics["origin"]["checkpoint"], metrics["environment"]["torch"]
    for shown in (f"{metrics['psnr']:.2f} dB", *stamps, "trainer.max_steps=20", "near and far"):
        assert shown in text, shown
    addresses = re.findall(r'(?:src|(?<!<a )href)="([^"]{5})', text)
    assert set(addresses) == {"data:"}
    assert 'http-equiv="Content-Security-Policy" content="default-src &#x27;none&#x27;' in text


@pytest.mark.minutes
def test_sliders_work_videos_play_and_it_fits_desktops_and_phones(page_of_run):
    with opened(page_of_run[0].as_uri(), 1200, 900) as driver:
        run = driver.execute_script
        assert not [entry for entry in driver.get_log("browser") if "favicon" not in entry["message"]]
        sizes = run("return [...document.images].filter(i => !i.hidden).map(i => i.naturalWidth)")
        assert len(sizes) > 6
        assert min(sizes) > 0

        def moved(selector, value):
            script = (
                "const s = document.querySelector(arguments[0] + ' input'); s.value = arguments[1];"
                "s.dispatchEvent(new Event('input'))"
            )
            run(script, selector, value)

        shown = "return [...document.querySelectorAll('.steps img')].filter(i => !i.hidden).map(i => i.alt)"
        assert run(shown) == ["step 20"]
        moved(".steps", 0)
        assert run(shown) == ["step 10 of 20"]
        assert run("return document.querySelector('.steps output').value") == "step 10 of 20"
        ends = "return [...document.querySelectorAll('.steps .ends span')].map(end => end.textContent)"
        assert run(ends) == ["step 10", "step 20"]

        clip = "return getComputedStyle(document.querySelector('.wipe .over')).clipPath"
        before = run(clip)
        moved(".wipe", 10)
        assert run(clip) != before
        # What lies left of the line is the truth: none of it is left at 0, all of it at 100.
        picture = driver.find_element("css selector", ".wipe .layers")
        shots = []
        for value in (0, 100, 0):
            moved(".wipe", value)
            shots.append(picture.screenshot_as_png)
        assert shots[0] == shots[2] != shots[1]

        script = (
            "const done = arguments[0]; const films = [...document.querySelectorAll('video')];"
            "const ready = film => film.readyState > 0 || film.error;"
            "const look = () => films.every(ready) ? done(films.map(f => f.error ? f.error.message : f.videoWidth))"
            " : setTimeout(look, 100); look();"
        )
        driver.set_script_timeout(60)
        color, depth, progress = driver.execute_async_script(script)
        assert color == depth == progress == 16
        gap = "const [a, b] = document.querySelectorAll('.chart:nth-child(2) .legend span');"
        assert run(gap + "return b.getBoundingClientRect().left - a.getBoundingClientRect().right") > 5
        unfold = "document.querySelectorAll('details').forEach(each => { each.open = true; })"
        for size in SIZES:
            assert layout_faults(driver, size) == layout_faults(driver, size, unfold) == []


def test_training_ends_with_it(nerf, capture, tmp_path):
    given = ("scene=npz", f"scene.path={capture}", *FAST, "final.video=false", f"paths.output_dir={tmp_path}")
    result = done(nerf("train", *given, "final.report=true"))
    assert f"result       {tmp_path}/report.html: " in result.out
    assert {"curves", "capture", "config"} <= set(sections((tmp_path / "report.html").read_text()))


def test_what_the_doctor_found_before_a_training_is_shown_after_it(tmp_path):
    run = leave_measured_run(tmp_path / "run")
    path = write_after_training(run, [Check("coverage", "look", "there is a gap", "Take 6 more photographs.")], 20)
    assert path == run / "report.html"
    assert "<p>there is a gap<br>" in path.read_text()
    assert "there is a gap" not in write_after_training(run, None, 20).read_text()


def test_a_folder_is_completed_without_a_key(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run" / ".hydra").mkdir(parents=True)
    assert candidates(["report", "ru"], ["report"]) == ["run/", "run="]


def test_without_its_photographs_the_page_says_so(nerf, finished_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished_run, run)
    result = done(nerf("report", run, f"scene.path={tmp_path}/gone.npz"))
    assert "left out     The doctor" in result.out
    text = (run / "report.html").read_text()
    assert "gone.npz" in text
    assert "capture" in sections(text)


def test_photographs_on_a_disk_that_fails_are_left_out(nerf, finished_run, tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(5, "Input/output error", "photographs/IMG_7.jpg")

    monkeypatch.setattr(report, "examine", fail)
    result = done(nerf("report", finished_run, f"paths.output_dir={tmp_path}"))
    assert "left out     The doctor: photographs/IMG_7.jpg: Input/output error" in result.out
    assert "capture" in sections((tmp_path / "report.html").read_text())


def test_a_bare_run_is_a_page_that_says_what_is_missing(nerf, tmp_path):
    run = leave_measured_run(tmp_path / "run", None)
    done(nerf("report", run))
    text = (run / "report.html").read_text()
    assert sections(text) == ["missing"]
    for what in ("Numbers", "Curves", "Coverage", "The doctor", "Config"):
        assert f"<li>{what}: " in text


@pytest.mark.parametrize("told", ["$(touch evil)", "a;touch evil", "`touch evil`", "a\ntouch evil"])
def test_a_strangers_settings_do_nothing_else_in_a_shell(told):
    words = shlex.split(_resume_command("resume=run", told))
    assert words[:3] == ["nerf", "train", "resume=run"]
    assert "'" in _resume_command("resume=run", told) or "\n" in told
    assert _resume_command("resume=run", "'") == _resume_command("resume=run", "") == ""


def test_what_is_no_run_is_refused(nerf, tmp_path, monkeypatch):
    newest = tmp_path / "outputs" / "bricks" / "old" / "checkpoints" / "last.ckpt"
    newest.parent.mkdir(parents=True)
    newest.touch()
    said(nerf("report", tmp_path), "is not a run folder")
    monkeypatch.chdir(tmp_path)
    said(nerf("report"), "nerf report needs a run", "type: nerf report run=outputs/bricks/old")
    said(nerf("report", tmp_path, tmp_path / "b"), "takes one folder")
    said(nerf("report", leave_measured_run(tmp_path / "run"), "measured=twice"), "measured=twice")


EVIL = (
    "</title></style></script><script>document.title = 'evil'</script><img src=x onerror=\"document.title = 'evil'\">"
)


@pytest.fixture
def evil_run(tmp_path):
    """A run whose every text is markup."""
    texts = {"protocol": {EVIL: EVIL, "scene": EVIL}, "origin": {"model": EVIL, EVIL: [EVIL]}}
    run = leave_measured_run(tmp_path / "run", overrides=(EVIL,), started=EVIL, result=EVIL, **texts)
    metrics = json.loads((run / "metrics.json").read_text())
    metrics |= {"per_image": [{"name": EVIL, "psnr": 20.0}], "worst_views": [EVIL], "pictures": ["../../secret", EVIL]}
    metrics["environment"] = {"torch": EVIL}
    (run / "metrics.json").write_text(json.dumps(metrics))
    (run / ".hydra" / "config.yaml").write_text(json.dumps({"a": EVIL}))
    return run


def test_markup_in_a_strangers_run_is_shown_and_not_obeyed(nerf, evil_run):
    done(nerf("report", evil_run, "doctor=false"))
    text = (evil_run / "report.html").read_text()
    assert text.count("<script>") == 1
    assert 'onerror="' not in text
    page, planted = evil_run / "planted.html", f"<body>{EVIL}<img src='data:,x' onerror=\"document.title = 'evil'\">"
    page.write_text(text.replace("<body>", planted))  # as if a text were put in unescaped
    with opened((evil_run / "report.html").as_uri()) as driver:
        assert driver.title == "run"
        assert not driver.get_log("browser")
        driver.get(page.as_uri())
        assert driver.title == "run", "the policy stops what escaping would miss"


@pytest.mark.parametrize("name", ["metrics.json", ".hydra/config.yaml", "video.mp4", "images/validation"])
def test_a_link_that_leads_out_is_refused(nerf, tmp_path, name):
    run = leave_measured_run(tmp_path / "run")
    (tmp_path / "secret").mkdir()
    link = run / name
    link.unlink(missing_ok=True)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(tmp_path / "secret")
    said(nerf("report", run, f"paths.output_dir={tmp_path}/out"), "symbolic link", "or shown")


def test_what_is_too_large_or_no_film_or_no_log_is_left_out(nerf, tmp_path):
    run = leave_measured_run(tmp_path / "run")
    (run / "video.mp4").write_bytes(b"\0" * 1_200_000)
    (run / "depth.mp4").write_bytes(b"<html>")
    (run / "tensorboard").mkdir()
    (run / "tensorboard" / "events.out.tfevents.0").write_bytes(b"\xff" * 1000)
    (run / "images" / "validation").mkdir(parents=True)
    (run / "images" / "validation" / "step_0000001.png").write_bytes(b"no picture")
    result = done(nerf("report", run, "max_megabytes=1", "doctor=false"))
    assert "video.mp4 has 1,200,000 bytes, more than the limit of 1,000,000" in result.out
    assert "depth.mp4 is not an mp4" in result.out
    assert "left out     A picture of the validation" in result.out
    assert "video" not in sections((run / "report.html").read_text())
