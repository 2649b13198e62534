"""A table of runs as one page that loads nothing: sorted by a click on a column, and filtered by a word."""

from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.html import own_policy, rendered
from nerf_lightning.runs.table_files import DECIMALS, Row, shown_columns

FOLDER = Path(__file__).parent


def write_table_page(rows: list[Row], title: str, notes: Sequence[str], target: Path) -> None:
    """Write the rows as one file of HTML, with the notes below."""
    script, style = ((FOLDER / f"table.{ending}").read_text(encoding="utf-8") for ending in ("js", "css"))
    page = rendered(
        FOLDER / "table.html",
        title=title,
        columns=shown_columns(rows),
        numbers=[*DECIMALS],
        rows=rows,
        notes=notes,
        policy=own_policy(script, style),
        script=Markup(script),
        style=Markup(style),
    )
    with whole_file(target) as part:
        part.write_text(page, encoding="utf-8")
