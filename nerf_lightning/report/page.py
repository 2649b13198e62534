"""One page that holds all of a run and loads nothing: pictures, films, curves and texts, opened from the disk.

All texts may come from anybody's run folder. They are escaped, and the page's policy lets no script run but its own,
and nothing be fetched.
"""

from dataclasses import dataclass, field
from pathlib import Path

from nerf_lightning.doctor.check import Check
from nerf_lightning.files.html import json_in_page, write_page
from nerf_lightning.report.curves import Drawing
from nerf_lightning.report.embedding import Embedded

FOLDER = Path(__file__).parent
Pairs = list[tuple[str, str]]


@dataclass(frozen=True)
class ViewOnPage:
    """A scored view."""

    name: str
    numbers: str
    truth: Embedded
    render: Embedded
    depth: Embedded
    error: Embedded
    true_depth: Embedded | None = None


@dataclass
class Report:
    """What a page says; what a run lacks stays empty."""

    title: str
    subtitle: str = ""
    scene_page: str = ""
    """The address of the page of the scene (`nerf export what=page`)."""
    scene_page_age: str = ""
    """What is said of a page that is older than the last checkpoint."""
    exports: Pairs = field(default_factory=list)
    """Files for other programs: label and address."""
    result: str = ""
    """The result in a sentence, with what would improve it most; empty: unknown."""
    facts: Pairs = field(default_factory=list)
    """The main numbers: label and value."""
    more_facts: Pairs = field(default_factory=list)
    """Further numbers, folded."""
    missing: list[str] = field(default_factory=list)
    """What could not be shown, and why."""
    worst: list[ViewOnPage] = field(default_factory=list)
    views: list[ViewOnPage] = field(default_factory=list)
    steps: list[tuple[str, Embedded]] = field(default_factory=list)
    """Pictures of one view during training."""
    curves: list[Drawing] = field(default_factory=list)
    videos: Pairs = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)
    """What the doctor found."""
    coverage: Embedded | None = None
    split: str = "test"
    """Whose views `per_image` lists."""
    columns: list[str] = field(default_factory=list)
    per_image: list[list[str]] = field(default_factory=list)
    tables: list[tuple[str, Pairs]] = field(default_factory=list)
    """Protocol, origin, environment."""
    overrides: str = ""
    config: str = ""


def write_report(report: Report, target: Path) -> None:
    """Write the report as one file of HTML."""
    charts = [chart._asdict() for chart in report.curves]
    write_page(FOLDER / "page.html", target, report=report, charts=json_in_page(charts))
