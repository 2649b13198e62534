"""A table of runs as one page that loads nothing: sorted by a click on a column, and filtered by a word."""

from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.html import own_policy, rendered
from nerf_lightning.runs.table_files import Row, is_number, told_columns

FOLDER = Path(__file__).parent
CURVE_WIDTH, CURVE_HEIGHT = 90, 22


def write_table_page(rows: list[Row], title: str, notes: Sequence[str], target: Path) -> None:
    """Write the rows as one file of HTML, with the notes below."""
    script, style = ((FOLDER / f"table.{ending}").read_text(encoding="utf-8") for ending in ("js", "css"))
    columns = told_columns(rows)
    lines = [{name: cells[number] for name, cells in columns.items()} for number in range(len(rows))]
    page = rendered(
        FOLDER / "table.html",
        title=title,
        columns=[(column, is_number(column)) for column in columns],
        rows=[(bool(row.get("source")), _cells(row, line)) for row, line in zip(rows, lines, strict=True)],
        notes=notes,
        curve_size=(CURVE_WIDTH, CURVE_HEIGHT),
        policy=own_policy(script, style),
        script=Markup(script),
        style=Markup(style),
    )
    with whole_file(target) as part:
        part.write_text(page, encoding="utf-8")


def _cells(row: Row, texts: dict[str, str]) -> list[dict[str, str | bool]]:
    """Return each cell's text, what it is sorted by, and the points of its curve."""
    cells: list[dict[str, str | bool]] = []
    for column, text in texts.items():
        value = row.get("minutes") if column == "time" else row.get(column)
        curve = points(value) if column == "curve" and value else ""
        by = "" if value is None or curve else str(value)
        cells.append({"text": "" if curve else text, "by": by, "curve": curve, "is_number": is_number(column)})
    return cells


def points(curve: Sequence[float]) -> str:
    """Return a curve as the points of an SVG line, its highest value on top.

    >>> points([0.0, 1.0])
    '1.0,21.0 89.0,1.0'
    """
    across = (CURVE_WIDTH - 2) / max(len(curve) - 1, 1)
    up = CURVE_HEIGHT - 2
    return " ".join(f"{1 + place * across:.1f},{1 + (1 - value) * up:.1f}" for place, value in enumerate(curve))
