"""A page of pages: what several runs have learnt beside each other, each a click away from being walked around in.

Names and settings may come from anybody's run folder: they are escaped, and no script runs at all.
"""

import base64
import binascii
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup
from PIL import Image

from nerf_lightning.config.key_meanings import meaning_of
from nerf_lightning.data.pixels.images import MOST_SCANS, jpeg_scans
from nerf_lightning.export.base import RunsExport
from nerf_lightning.export.page import QUALITIES, Quality, require_no_other
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.html import data_address, own_policy, rendered
from nerf_lightning.files.regular import open_regular
from nerf_lightning.messages.console import StageProgress, say, spoken
from nerf_lightning.messages.errors import InputError, require_one_of
from nerf_lightning.messages.escaping import for_terminal, listed
from nerf_lightning.report.pages import address_from, page_of_run
from nerf_lightning.runs.summary import RunSummary, differing_keys, read_run

FOLDER = Path(__file__).parent
MARK = "<!-- nerf_lightning gallery 1 -->"
STILL = re.compile(rb'<img id="still" src="data:image/jpeg;base64,([A-Za-z0-9+/=]+)"')
# A page's still picture stands in its first bytes; and what a picture of ours cannot exceed.
MOST_HEAD, MOST_PIXELS = 1 << 20, 1 << 22
THUMBNAIL, JPEG_QUALITY = 480, 82
MOST_SETTINGS = 12
"""Of those by which runs differ, on each card."""


@dataclass(frozen=True)
class Card:
    """A run of the gallery."""

    name: str
    address: str
    """Of its page, relative to the gallery; empty where there is none."""
    picture: str
    facts: list[str]
    settings: list[tuple[str, str]]
    """Those by which the runs differ."""
    note: str = ""
    """Why it has no page."""


class GalleryExport(RunsExport):
    """Write `gallery.html`: of each run a picture, what differs, how good it is, and a link to its page.

    Args:
        quality: of the pages of runs that have none yet; None: make none.
        max_runs: at most so many, those of the highest PSNR; the others are left out, and that is said.
    """

    def __init__(self, quality: Quality | None = "medium", max_runs: int = 60):
        if quality is not None:
            require_one_of(QUALITIES, **{"what.quality": quality})
        if max_runs < 1:
            raise InputError(f"what.max_runs={max_runs}: give 1 or more.")
        self.quality, self.max_runs = quality, max_runs

    def export(self, runs: Sequence[Path], target: Path, page_of: Callable[[Path, Quality], Path]) -> list[Path]:
        """Write the gallery, and the pages that are missing."""
        file = target / "gallery.html"
        require_no_other(file, MARK.encode())
        ranked = sorted(map(read_run, runs), key=_rank)
        shown, left_out = ranked[: self.max_runs], ranked[self.max_runs :]
        differing = differing_keys([_settings(run) for run in shown])[:MOST_SETTINGS]
        cards = []
        with StageProgress({"pages": 1.0}) as report:
            for number, run in enumerate(shown):
                page, note = self._page(run, page_of)
                cards.append(_card(run, differing, page, note, target))
                report("pages", (number + 1) / len(shown))
        _write(cards, f"{target.absolute().name}: {len(shown)} run{'s' if len(shown) > 1 else ''}", file)
        say(*(f"no page      {for_terminal(card.name)}: {card.note}" for card in cards if card.note))
        if left_out:
            names = listed((str(run.folder) for run in left_out), cap=5)
            say(f"left out     {len(left_out)} runs (more with what.max_runs=N): {names}")
        return [file]

    def _page(self, run: RunSummary, page_of: Callable[[Path, Quality], Path]) -> tuple[Path | None, str]:
        """Return a run's page, made if it is wished, or why there is none."""
        found = page_of_run(run.folder)
        if found is not None or self.quality is None:
            return found, "" if found is not None else "it has none (what.quality=null)"
        try:
            return page_of(run.folder, self.quality), ""
        except InputError as error:
            return None, str(error)


def _rank(run: RunSummary) -> tuple[bool, float, str]:
    return run.psnr is None, -(run.psnr or 0.0), str(run.folder)


def _settings(run: RunSummary) -> dict[str, str]:
    """Return what makes it another run than others, of what was given on the command line."""
    meanings = {key: meaning_of(key.lstrip("+~").partition("@")[0]) for key in run.overrides}
    return {key: run.overrides[key] for key, each in meanings.items() if each.identity or each.shown}


def _card(run: RunSummary, differing: list[str], page: Path | None, note: str, target: Path) -> Card:
    given = _settings(run)
    facts = [] if run.psnr is None else [f"{run.psnr:.2f} dB PSNR"]
    facts += [] if run.steps is None else [f"{run.steps:,} steps"]
    facts += [] if run.seconds is None else [spoken(run.seconds)]
    facts += [] if page is None else [f"page of {page.stat().st_size / 1e6:.1f} MB"]
    return Card(
        name=run.folder.absolute().name,
        address="" if page is None else address_from(page.absolute(), target.absolute()),
        picture="" if page is None else _thumbnail(page),
        facts=facts,
        settings=[(key, given[key][:200]) for key in differing if key in given],
        note=note,
    )


def _thumbnail(page: Path) -> str:
    """Return the still picture of a page, decoded and encoded anew; empty where there is none that can be read."""
    with open_regular(page, None) as file:
        found = STILL.search(file.read(MOST_HEAD))
    try:
        if not found:
            return ""
        still = base64.b64decode(found[1], validate=True)
        image = Image.open(io.BytesIO(still), formats=["JPEG"])
        if image.width * image.height > MOST_PIXELS or jpeg_scans(still) > MOST_SCANS:
            return ""
        image.thumbnail((THUMBNAIL, THUMBNAIL))
        content = io.BytesIO()
        image.convert("RGB").save(content, format="JPEG", quality=JPEG_QUALITY)
    except (OSError, ValueError, binascii.Error, Image.DecompressionBombError):
        return ""
    return data_address("image/jpeg", content.getvalue())


def _write(cards: list[Card], title: str, target: Path) -> None:
    style = (FOLDER / "gallery.css").read_text(encoding="utf-8")
    text = rendered(
        FOLDER / "gallery.html",
        mark=Markup(MARK),
        title=title,
        cards=cards,
        policy=own_policy("", style),
        style=Markup(style),
    )
    with whole_file(target) as part:
        part.write_text(text, encoding="utf-8")
