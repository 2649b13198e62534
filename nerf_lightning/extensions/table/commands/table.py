"""Compare runs in one table, with mean and deviation over seeds, and published results."""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig

from nerf_lightning.extensions.table.find_results import find_results
from nerf_lightning.extensions.table.latex import write_latex
from nerf_lightning.extensions.table.rows import ORDERS, result_table
from nerf_lightning.files.html import write_page
from nerf_lightning.files.json_files import print_json
from nerf_lightning.messages.console import say, say_written
from nerf_lightning.messages.errors import InputError, require_one_of
from nerf_lightning.runs.command_folder import output_folder
from nerf_lightning.runs.summary import FILES
from nerf_lightning.runs.table_columns import DECIMALS, Row, shown_columns
from nerf_lightning.runs.table_files import write_csv, write_markdown
from nerf_lightning.runs.table_screen import print_rows

ENDINGS = (".md", ".csv", ".html", ".tex")
TEMPLATE = Path(__file__).parent.parent / "page.html"


def run(config: DictConfig) -> int:
    """Write the table and return the number of rows."""
    require_one_of(FILES, measured=config.measured)
    require_one_of(ORDERS, sort=config.sort)
    folders = [Path(name) for name in _names(config.runs)]
    scenes, models = (None if names is None else _names(names) for names in (config.scenes, config.models))
    found = find_results(folders, config.measured, scenes, models)
    rows, notes = result_table(found, config.sort, bool(config.published), bool(config.force))
    count = len(found.measured)
    title = f"{count} run{'' if count == 1 else 's'}, sorted by {config.sort}"
    out = config.out or config.paths.output_dir
    written = _write(rows, notes, title, Path(str(out)), found.measured[0].protocol) if out else []
    if config.json:
        print_json({"title": title, "rows": rows, "notes": notes, "written": written})
        return len(rows)
    print_rows(rows, title, "Widen it, or write all columns to files with out=DIR.")
    say(*notes)
    say_written(*written)
    return len(rows)


def _write(rows: list[Row], notes: list[str], title: str, out: Path, protocol: dict[str, Any]) -> list[Path]:
    """Write the requested file, or one of each kind into a folder; return the paths."""
    is_file = out.suffix in ENDINGS
    if out.suffix[1:].isalpha() and not is_file and not out.is_dir():
        raise InputError(f"out={out}: tables are written as {', '.join(ENDINGS)}; a folder gets one of each.")
    folder = output_folder(str(out.parent if is_file else out), Path())
    paths = [folder / out.name] if is_file else [folder / f"table{ending}" for ending in ENDINGS]
    for path in paths:
        if path.suffix == ".csv":
            write_csv(rows, path)
        elif path.suffix == ".md":
            write_markdown(rows, path, notes)
        elif path.suffix == ".tex":
            write_latex(rows, path, protocol)
        else:
            write_table_page(rows, title, notes, path)
    return paths


def write_table_page(rows: list[Row], title: str, notes: list[str], target: Path) -> None:
    """Write the rows as one page, sortable by column and filterable by word, with the notes below."""
    columns, numbers = shown_columns(rows), [*DECIMALS]
    write_page(TEMPLATE, target, title=title, columns=columns, numbers=numbers, rows=rows, notes=notes)


def _names(value: Any) -> list[str]:
    return list(map(str, value)) if isinstance(value, ListConfig) else [str(value)]
