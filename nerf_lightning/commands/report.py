"""Write one page of a run: numbers, worst views, truth against render, curves, films, capture, protocol and config.

What cannot be read is left out, and the page says so.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from omegaconf import DictConfig

from nerf_lightning.budgets import allowed
from nerf_lightning.checkpoints.reading import newest_checkpoint
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.scene_overrides import scene_overrides
from nerf_lightning.console import StageProgress, say
from nerf_lightning.doctor.check import Check
from nerf_lightning.doctor.examine import examine
from nerf_lightning.errors import InputError
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.json_files import read_json_object
from nerf_lightning.files.links import require_nothing_from_outside
from nerf_lightning.files.regular import read_text
from nerf_lightning.files.yaml_files import plain_yaml, read_plain_yaml
from nerf_lightning.nerf.types.scene import PixelStore, Scene, SceneRecord
from nerf_lightning.report.curves import curve_drawings, read_curves
from nerf_lightning.report.embedding import Embedded, embedded, embedded_file, embedded_video
from nerf_lightning.report.metrics import facts, per_image, tables, views_on_page
from nerf_lightning.report.page import Report, page
from nerf_lightning.runs.output_folder import output_folder
from nerf_lightning.runs.results import FILES
from nerf_lightning.runs.summary import read_note
from nerf_lightning.visualization.camera_layout import coverage_picture

MOST_STEPS = 24
VIDEOS = {"video.mp4": "new views", "depth.mp4": "their depth", "progress.mp4": "while it was learnt"}
COSTS = {"views": 2.0, "curves": 3.0, "films": 1.0, "capture": 10.0}


def run(config: DictConfig) -> str:
    """Do what the config says; return where the page is."""
    if config.measured not in FILES:
        raise InputError(f"measured={config.measured}: choose one of {', '.join(FILES)}.")
    run = Path(str(config.run))
    if not (run / "run.json").is_file():
        raise InputError(
            f"run={run}: there is no run in it (no run.json). Give the folder of one, such as "
            "outputs/bricks/2026-11-21_10-00-00."
        )
    require_nothing_from_outside(run)
    folder = output_folder(config.paths.output_dir, run)
    gathered = Gathering(run, config).gather()
    target = folder / "report.html"
    with whole_file(target) as part:
        part.write_text(page(gathered), encoding="utf-8")
    lines = [f"left out     {line}" for line in gathered.missing]
    say(*lines, f"report       {target} ({target.stat().st_size / 1e6:.1f} MB)")
    return str(target)


class Gathering:
    """A run folder on its way to a page.

    Args:
        run: the run folder.
        config: the command's.
    """

    def __init__(self, run: Path, config: DictConfig):
        self.run, self.config = run, config
        self.measured = run / FILES[config.measured]
        self.report = Report(title=run.absolute().name)

    def gather(self) -> Report:
        """Return all that can be shown."""
        with StageProgress(COSTS) as progress:
            stages = (self._measured, self._curves, self._films, self._capture)
            for name, stage in zip(COSTS, stages, strict=True):
                progress(name, 0.0)
                stage()
        return self.report

    def _measured(self) -> None:
        page, metrics, note = self.report, read_json_object(self.measured), read_note(self.run)
        page.subtitle = f"{self.run.absolute()}, begun {note.get('started', 'at an unknown time')}"
        page.facts = facts(metrics, note)
        page.columns, page.per_image = per_image(metrics)
        page.tables = tables(metrics)
        if not metrics:
            page.missing.append(f"Numbers: there is no {FILES[self.config.measured]} that can be read.")
        images = self.measured.parent / "images"
        page.worst, page.views, missing = views_on_page(metrics, images)
        page.missing += missing
        files = sorted((self.run / "images" / "validation").glob("step_*.png"))
        chosen = (
            files if len(files) <= MOST_STEPS else [files[-1 - i * len(files) // MOST_STEPS] for i in range(MOST_STEPS)]
        )
        for file in sorted(chosen):
            self._try("A picture of the validation", partial(self._add_step, file))
        self._try("Config", self._add_config)

    def _add_step(self, file: Path) -> None:
        self.report.steps.append((f"step {file.stem.partition('_')[2].lstrip('0')}", embedded_file(file)))

    def _add_config(self) -> None:
        config = self.run / ".hydra" / "config.yaml"
        text = read_text(config, 4 * allowed().yaml_characters)
        plain_yaml(text, str(config))  # a config at all
        self.report.config = text
        overrides = read_plain_yaml(self.run / ".hydra" / "overrides.yaml")
        self.report.overrides = "\n".join(map(str, overrides)) if isinstance(overrides, list) else ""

    def _curves(self) -> None:
        def read() -> None:
            self.report.curves = curve_drawings(read_curves(self.run / "tensorboard"))

        self._try("Curves", read)

    def _films(self) -> None:
        most = int(self.config.max_megabytes * 1e6)
        for name, label in VIDEOS.items():
            if (self.run / name).is_file():
                self._try("Film", partial(self._add_film, name, label, most))

    def _add_film(self, name: str, label: str, most_bytes: int) -> None:
        self.report.videos.append((label, embedded_video(self.run / name, most_bytes)))

    def _capture(self) -> None:
        self._try("Coverage", self._add_coverage)
        if self.config.doctor:
            self._try("The doctor", self._add_checks)

    def _add_coverage(self) -> None:
        checkpoint = newest_checkpoint(self.run / "checkpoints")
        if checkpoint is None:
            raise InputError(f"{self.run} has no checkpoint")
        self.report.title = f"{checkpoint.scene.name}, {checkpoint.choices.get('model', '')}: {self.report.title}"
        self.report.coverage = coverage(checkpoint.scene)

    def _add_checks(self) -> None:
        if self.config.get("scene") is None:
            scene_overrides(str(self.run / "checkpoints" / "last.ckpt"))  # says what is wrong
        checks: list[Check] = examine(build(self.config.scene).read())[1]
        self.report.checks = checks

    def _try(self, what: str, add: Callable[[], None]) -> None:
        """Leave out what cannot be read, and say why."""
        try:
            add()
        except (InputError, OSError) as error:
            self.report.missing.append(f"{what}: {_reason(error)}")


def _reason(error: InputError | OSError) -> str:
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def coverage(record: SceneRecord) -> Embedded:
    """Return the coverage map of a recorded scene."""
    return embedded(coverage_picture(_without_pictures(record)).numpy())


def _without_pictures(record: SceneRecord) -> Scene:
    none = torch.zeros(0, dtype=torch.long)
    pixels = PixelStore(torch.zeros(0, 4, dtype=torch.uint8), none, none, none, has_transparency=False)
    splits = {split: record.splits.get(split, ()) for split in ("train", "val", "test")}
    return Scene(**{**vars(record), "splits": splits}, pixels=pixels, protocol={}, truth=None)
