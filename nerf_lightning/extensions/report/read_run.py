"""From a run folder to what its page shows. What cannot be read is left out, and the page says so."""

import os
import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

from nerf_lightning.checkpoints.reading import Checkpoint, newest_checkpoint
from nerf_lightning.doctor.check import Check
from nerf_lightning.evaluation.main_numbers import main_numbers
from nerf_lightning.extensions.report.charts import drawn
from nerf_lightning.extensions.report.coverage import coverage_map
from nerf_lightning.extensions.report.metrics import depth_scale, per_image, tables, views_on_page
from nerf_lightning.extensions.report.page import Report, embedded_file, embedded_video
from nerf_lightning.files.html import is_scene_page
from nerf_lightning.files.json_files import mapping, read_json_object
from nerf_lightning.files.regular import read_text
from nerf_lightning.files.yaml_files import plain_yaml, read_plain_yaml
from nerf_lightning.messages.console import StageProgress
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.curves import read_curves
from nerf_lightning.runs.file_steps import exported_files, read_steps
from nerf_lightning.runs.summary import read_note, scene_of_run

MOST_STEPS = 24
MAIN = {
    "test views": "Test views were not used for training.",
    "PSNR (mean)": "PSNR: color error on a logarithmic scale; higher is better, and 6 dB more is half the error.",
    "SSIM": "SSIM: similarity of local structure; 1 is identical.",
    "LPIPS": "LPIPS: visible difference, as a neural network judges it; 0 is identical.",
    "views measured": "",
    "training": "",
}
"""Labels of the numbers that are not folded, and what these mean; "": the label says it."""
SPLITS = {"train": "training", "val": "validation", "test": "test"}
MOST_EXPORTS = 20
PAGE_AGE = "Exported at step {step:,}; training has reached step {last:,}."
LONGEST_RESULT = 2000
VIDEOS = {"video.mp4": "New views", "depth.mp4": "Depth", "progress.mp4": "Training progress"}
COSTS = {"views": 2.0, "curves": 3.0, "films": 1.0, "capture": 10.0}


def read_run(
    run: Path,
    metrics: Path,
    most_video_bytes: int,
    examine: Callable[[], list[Check]] | None,
    folder: Path | None = None,
    resume: str = "",
) -> Report:
    """Return all of a run that can be shown.

    Args:
        run: the run folder.
        metrics: the `metrics.json` whose numbers are shown; `images` beside it holds the views.
        most_video_bytes: a film that is larger is left out.
        examine: reads the capture and judges it, as the doctor does; None leaves that out.
        folder: where the page will lie; None: in the run folder.
        resume: the setting that resumes this run, as typed in a shell; empty: no command is shown.
    """
    report = Report(title=run.absolute().name)
    step: int | None = None

    @contextmanager
    def attempt(what: str) -> Iterator[None]:
        """Leave out what cannot be read, and say why."""
        try:
            yield
        except InputError as error:
            report.missing.append(f"{what}: {error}")
        except OSError as error:
            report.missing.append(f"{what}: {f'{error.filename}: {error.strerror}' if error.filename else error}")

    with StageProgress(COSTS) as progress:
        progress("views", 0.0)
        _add_measured(report, run, metrics, resume)
        with attempt("Coverage"):
            checkpoint = _last_checkpoint(run)
            step = checkpoint.step
            _add_capture(report, checkpoint, run)
        _add_exports(report, run / "export", (folder or run).absolute(), step)
        for picture in _validation_pictures(run):
            with attempt("A picture of the validation"):
                taken = int(_step_of(picture))
                label = _age(taken, step) or f"step {taken:,}"
                report.steps.append((label, embedded_file(picture)))
        with attempt("Config"):
            _add_config(report, run)
        progress("curves", 0.0)
        with attempt("Curves"):
            report.charts = drawn(read_curves(run / "tensorboard"))
        progress("films", 0.0)
        for name, label in VIDEOS.items():
            if (run / name).is_file():
                with attempt("Film"):
                    age = _age(read_steps(run).get(name), step)
                    film = embedded_video(run / name, most_video_bytes)
                    report.videos.append((f"{label} ({age})" if age else label, film))
        progress("capture", 0.0)
        if examine is not None:
            with attempt("The doctor"):
                report.checks = examine()
    return report


def address_from(file: Path, folder: Path) -> str:
    """Return a file's address for a page in a folder, relative to it: both may be moved together.

    >>> address_from(Path("/runs/a b/page.html"), Path("/runs/reports"))
    './../a%20b/page.html'
    """
    # Behind a dot, no name is taken for a scheme such as javascript.
    return f"./{quote(os.fsencode(Path(os.path.relpath(file, folder)).as_posix()))}"


def _add_exports(report: Report, exported: Path, folder: Path, step: int | None) -> None:
    """Link what nerf export wrote; of pages, only ours. `step` is the last checkpoint's, None if unknown."""
    steps, files = read_steps(exported), [file for file in exported_files(exported) if file.suffix != ".html"]
    for file in files[:MOST_EXPORTS]:
        note = ", ".join(filter(None, (f"{file.stat().st_size / 1e6:.2g} MB", _age(steps.get(file.name), step))))
        report.exports.append((f"{file.name} ({note})", address_from(file.absolute(), folder)))
    page = exported / "page.html"
    if page.is_file() and is_scene_page(page):
        report.scene_page = address_from(page.absolute(), folder)
        report.scene_page_age = _age(steps.get(page.name), step, PAGE_AGE)


def _age(step: int | None, last: int | None, said: str = "step {step:,} of {last:,}") -> str:
    """Return what to say of a file that shows an earlier step than the last checkpoint; "" where either is unknown."""
    return "" if step is None or last is None or step >= last else said.format(step=step, last=last)


def _add_measured(report: Report, run: Path, file: Path, resume: str) -> None:
    metrics, note = read_json_object(file), read_note(run)
    report.subtitle = f"{run.absolute()}, started {str(note.get('started', 'at an unknown time')).replace('T', ' ')}"
    report.result = str(note.get("result", ""))[:LONGEST_RESULT]
    report.command = _resume_command(resume, str(note.get("resume_with", ""))[:LONGEST_RESULT])
    known = main_numbers(metrics, note)
    report.facts = [pair for pair in known if pair[0] in MAIN]
    report.meanings = " ".join(said for label, said in MAIN.items() if said and label in dict(known))
    report.more_facts = [pair for pair in known if pair[0] not in MAIN]
    report.columns, report.per_image = per_image(metrics)
    report.split = str(mapping(metrics.get("protocol")).get("split", "test"))[:20]
    report.tables = tables(metrics)
    report.depth_scale = depth_scale(metrics)
    if not metrics:
        report.missing.append(f"Numbers: there is no {file.relative_to(run)} that can be read.")
    report.worst, report.views, missing = views_on_page(metrics, file.parent / "images")
    report.missing += missing


def _resume_command(resume: str, settings: str) -> str:
    """Return the command that trains longer, with the settings that `run.json` names."""
    try:
        words = shlex.split(settings)
    except ValueError:  # a quote without its end
        return ""
    # Quoted anew: a stranger's settings do nothing else in a shell.
    return " ".join(["nerf train", resume, *map(shlex.quote, words)]) if resume and words else ""


def _step_of(picture: Path) -> str:
    return picture.stem.removeprefix("step_")


def _validation_pictures(run: Path) -> list[Path]:
    """Return the files in the order of their steps; of very many, an even choice with the last."""
    files = sorted(file for file in (run / "images" / "validation").glob("step_*.png") if _step_of(file).isdecimal())
    if len(files) <= MOST_STEPS:
        return files
    return sorted(files[-1 - i * len(files) // MOST_STEPS] for i in range(MOST_STEPS))


def _add_config(report: Report, run: Path) -> None:
    config = run / ".hydra" / "config.yaml"
    text = read_text(config, "yaml")
    plain_yaml(text, str(config))  # a config at all
    report.config = text
    overrides = read_plain_yaml(run / ".hydra" / "overrides.yaml")
    report.overrides = "\n".join(map(str, overrides)) if isinstance(overrides, list) else ""


def _last_checkpoint(run: Path) -> Checkpoint:
    checkpoint = newest_checkpoint(run / "checkpoints")
    if checkpoint is None:
        raise InputError(f"{run} has no checkpoint")
    return checkpoint


def _add_capture(report: Report, checkpoint: Checkpoint, run: Path) -> None:
    record = checkpoint.scene
    report.title = scene_of_run(record.name, run)
    held = {split: record.splits.get(split, ()) for split in SPLITS}
    if held["val"] == held["test"]:
        del held["val"]
    counts = [f"{len(numbers)} {SPLITS[split]}" for split, numbers in held.items() if numbers]
    views = " and ".join(filter(None, (", ".join(counts[:-1]), *counts[-1:])))
    report.subtitle = f"model {checkpoint.choices.get('model', '')}, {views} views, {report.subtitle}"
    report.coverage = coverage_map(record)
