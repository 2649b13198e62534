"""One page that holds all of a run and loads nothing: pictures, films, curves and texts, opened from the disk.

All texts may come from anybody's run folder. They are escaped, and the page's policy lets no script run but its own,
and nothing be fetched.
"""

import io
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from nerf_lightning.data.pixels.picture_files import read_rgba
from nerf_lightning.doctor.check import Check
from nerf_lightning.extensions.report.charts import Drawing
from nerf_lightning.extensions.report.coverage import CoverageMap
from nerf_lightning.files.html import data_address, json_in_page, write_page
from nerf_lightning.files.regular import read_bytes
from nerf_lightning.messages.errors import InputError
from nerf_lightning.visualization.pictures import ERROR_SCALE

LONGEST_SIDE = 1600
LOSSLESS_PIXELS = 1 << 18
"""Up to 512 x 512 pixels are kept exactly, larger pictures at `QUALITY`."""
QUALITY = 92


def embedded_file(path: Path) -> str:
    """Return a picture file, decoded and encoded anew: nothing of the file but its pixels comes into the page."""
    return embedded(read_rgba(path)[..., :3])


def embedded(picture: UInt8[np.ndarray, "height width 3"]) -> str:
    """Return a picture as the address of a WebP, shrunk where it is larger than a page."""
    image = Image.fromarray(np.ascontiguousarray(picture))
    if max(image.size) > LONGEST_SIDE:
        image.thumbnail((LONGEST_SIDE, LONGEST_SIDE))
    lossless = image.width * image.height <= LOSSLESS_PIXELS
    buffer = io.BytesIO()
    image.save(buffer, format="WEBP", lossless=lossless, quality=QUALITY)
    return data_address("image/webp", buffer.getvalue())


def embedded_video(path: Path, most_bytes: int) -> str:
    """Return an mp4 as an address."""
    content = read_bytes(path, most_bytes, "Larger films need a larger max_megabytes.")
    if content[4:8] != b"ftyp":
        raise InputError(f"{path.name} is not an mp4")
    return data_address("video/mp4", content)


FOLDER = Path(__file__).parent
Pairs = list[tuple[str, str]]


@dataclass(frozen=True)
class ViewOnPage:
    """A scored view."""

    name: str
    numbers: str
    truth: str
    """The pictures' addresses."""
    render: str
    depth: str
    error: str
    true_depth: str | None = None


@dataclass
class Report:
    """What a page says; what a run lacks stays empty."""

    title: str
    subtitle: str = ""
    scene_page: str = ""
    """The address of the page of the scene (`nerf export what=page`)."""
    scene_page_age: str = ""
    """Which step the page shows and which training has reached; empty: the same, or unknown."""
    exports: Pairs = field(default_factory=list)
    """Files for other programs: label and address."""
    result: str = ""
    """The result in a sentence, with what would improve it most; empty: unknown."""
    command: str = ""
    """The command that improves it; empty: none does."""
    facts: Pairs = field(default_factory=list)
    """The main numbers: label and value."""
    meanings: str = ""
    """What the main numbers mean."""
    more_facts: Pairs = field(default_factory=list)
    """Further numbers, folded."""
    missing: list[str] = field(default_factory=list)
    """What could not be shown, and why."""
    depth_scale: str = ""
    """What the brightest and the darkest color of depth stand for; empty: unknown."""
    worst: list[ViewOnPage] = field(default_factory=list)
    views: list[ViewOnPage] = field(default_factory=list)
    steps: Pairs = field(default_factory=list)
    """Pictures of one view during training: label and address."""
    charts: list[Drawing] = field(default_factory=list)
    videos: Pairs = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)
    """What the doctor found."""
    coverage: CoverageMap | None = None
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
    charts = [chart._asdict() for chart in report.charts]
    error_scale = f"{100 * ERROR_SCALE:g} %"
    write_page(FOLDER / "page.html", target, report=report, charts=json_in_page(charts), error_scale=error_scale)
