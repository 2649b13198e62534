"""From a run folder to what its page shows. What cannot be read is left out, and the page says so."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from nerf_lightning.checkpoints.reading import newest_checkpoint
from nerf_lightning.doctor.check import Check
from nerf_lightning.files.budgets import allowed
from nerf_lightning.files.json_files import read_json_object
from nerf_lightning.files.regular import read_text
from nerf_lightning.files.yaml_files import plain_yaml, read_plain_yaml
from nerf_lightning.messages.console import StageProgress
from nerf_lightning.messages.errors import InputError
from nerf_lightning.report.curves import curve_drawings, read_curves
from nerf_lightning.report.embedding import embedded, embedded_file, embedded_video
from nerf_lightning.report.metrics import facts, per_image, tables, views_on_page
from nerf_lightning.report.page import Report
from nerf_lightning.report.pages import address_from, page_of_run
from nerf_lightning.runs.summary import read_note
from nerf_lightning.visualization.camera_layout import coverage_picture

MOST_STEPS = 24
VIDEOS = {"video.mp4": "new views", "depth.mp4": "their depth", "progress.mp4": "while it was learnt"}
COSTS = {"views": 2.0, "curves": 3.0, "films": 1.0, "capture": 10.0}


def read_run(
    run: Path,
    metrics: Path,
    most_video_bytes: int,
    examine: Callable[[], list[Check]] | None,
    folder: Path | None = None,
) -> Report:
    """Return all of a run that can be shown.

    Args:
        run: the run folder.
        metrics: the `metrics.json` whose numbers are shown; `images` beside it holds the views.
        most_video_bytes: a film that is larger is left out.
        examine: reads the capture and judges it, as the doctor does; None leaves that out.
        folder: where the page will lie; None: in the run folder.
    """
    scene = page_of_run(run)
    link = "" if scene is None else address_from(scene.absolute(), (folder or run).absolute())
    reader = _RunReader(run, Report(title=run.absolute().name, scene_page=link))
    stages: tuple[Callable[[], None], ...] = (
        partial(reader.measured, metrics),
        reader.curves,
        partial(reader.films, most_video_bytes),
        partial(reader.capture, examine),
    )
    with StageProgress(COSTS) as progress:
        for name, stage in zip(COSTS, stages, strict=True):
            progress(name, 0.0)
            stage()
    return reader.report


class _RunReader:
    def __init__(self, run: Path, report: Report):
        self.run, self.report = run, report

    def measured(self, file: Path) -> None:
        report, metrics, note = self.report, read_json_object(file), read_note(self.run)
        report.subtitle = f"{self.run.absolute()}, begun {note.get('started', 'at an unknown time')}"
        report.facts = facts(metrics, note)
        report.columns, report.per_image = per_image(metrics)
        report.tables = tables(metrics)
        if not metrics:
            report.missing.append(f"Numbers: there is no {file.relative_to(self.run)} that can be read.")
        report.worst, report.views, missing = views_on_page(metrics, file.parent / "images")
        report.missing += missing
        for step in self._validation_pictures():
            self._try("A picture of the validation", partial(self._add_step, step))
        self._try("Config", self._add_config)

    def curves(self) -> None:
        self._try("Curves", self._add_curves)

    def films(self, most_bytes: int) -> None:
        for name, label in VIDEOS.items():
            if (self.run / name).is_file():
                self._try("Film", partial(self._add_film, name, label, most_bytes))

    def capture(self, examine: Callable[[], list[Check]] | None) -> None:
        self._try("Coverage", self._add_coverage)
        if examine is not None:
            self._try("The doctor", partial(self._add_checks, examine))

    def _try(self, what: str, add: Callable[[], None]) -> None:
        """Leave out what cannot be read, and say why."""
        try:
            add()
        except (InputError, OSError) as error:
            self.report.missing.append(f"{what}: {_reason(error)}")

    def _validation_pictures(self) -> list[Path]:
        """Return the files in the order of their steps; of very many, an even choice with the last."""
        files = sorted((self.run / "images" / "validation").glob("step_*.png"))
        if len(files) <= MOST_STEPS:
            return files
        return sorted(files[-1 - i * len(files) // MOST_STEPS] for i in range(MOST_STEPS))

    def _add_step(self, file: Path) -> None:
        self.report.steps.append((f"step {file.stem.partition('_')[2].lstrip('0')}", embedded_file(file)))

    def _add_config(self) -> None:
        config = self.run / ".hydra" / "config.yaml"
        text = read_text(config, 4 * allowed().yaml_characters)
        plain_yaml(text, str(config))  # a config at all
        self.report.config = text
        overrides = read_plain_yaml(self.run / ".hydra" / "overrides.yaml")
        self.report.overrides = "\n".join(map(str, overrides)) if isinstance(overrides, list) else ""

    def _add_curves(self) -> None:
        self.report.curves = curve_drawings(read_curves(self.run / "tensorboard"))

    def _add_film(self, name: str, label: str, most_bytes: int) -> None:
        self.report.videos.append((label, embedded_video(self.run / name, most_bytes)))

    def _add_coverage(self) -> None:
        checkpoint = newest_checkpoint(self.run / "checkpoints")
        if checkpoint is None:
            raise InputError(f"{self.run} has no checkpoint")
        self.report.title = f"{checkpoint.scene.name}, {checkpoint.choices.get('model', '')}: {self.report.title}"
        self.report.coverage = embedded(coverage_picture(checkpoint.scene).numpy())

    def _add_checks(self, examine: Callable[[], list[Check]]) -> None:
        self.report.checks = examine()


def _reason(error: InputError | OSError) -> str:
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error)
