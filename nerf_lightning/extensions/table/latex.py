"""Rows of a table for papers: LaTeX with the best numbers in bold."""

import re
from pathlib import Path
from typing import Any

from nerf_lightning.extensions.table.rows import HIGH_FIRST, PLAIN, SPREAD
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.runs.table_columns import Row, shown_columns

HIGHEST = tuple((SPREAD | PLAIN)[key] for key in HIGH_FIRST)
LOWEST = tuple(column for column in SPREAD.values() if column not in HIGHEST)
"""Columns whose best value is the highest, or the lowest."""
NOT_IN_PAPERS = ("job", "state", "folder", "source", "seeds")
SPECIAL = {letter: f"\\{letter}" for letter in "&%$#_{}"} | {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$",
}  # fmt: skip


def write_latex(rows: list[Row], path: Path, protocol: dict[str, Any]) -> None:
    r"""Write a table for `\usepackage{booktabs}`; the caption states the runs' `protocol`."""
    told = {name: cells for name, cells in shown_columns(rows).items() if name not in NOT_IN_PAPERS}
    columns = {name: cells for name, cells in told.items() if name == "model" or len(set(cells)) > 1 or name in HIGHEST}
    cells = {
        name: _with_best_bold(name, [for_latex(cell) for cell in column], rows) for name, column in columns.items()
    }
    kinds = "".join("r" if name in (*HIGHEST, *LOWEST) else "l" for name in columns)
    lines = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{for_latex(_caption(told, columns, protocol))}}}",
        rf"\begin{{tabular}}{{{kinds}}}",
        r"\toprule",
        " & ".join(map(for_latex, columns)) + r" \\",
        r"\midrule",
        *(" & ".join(column[row] for column in cells.values()) + r" \\" for row in range(len(rows))),
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    with whole_file(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def for_latex(text: str) -> str:
    r"""Return a text escaped for LaTeX, on one line.

    >>> for_latex("a_b & 50% \\ {")
    'a\\_b \\& 50\\% \\textbackslash{} \\{'
    """
    return " ".join("".join(SPECIAL.get(letter, letter) for letter in text if letter.isprintable()).split())


def _with_best_bold(name: str, cells: list[str], rows: list[Row]) -> list[str]:
    known = [row[name] for row in rows if isinstance(row.get(name), int | float)]
    if name not in (*HIGHEST, *LOWEST) or len(known) < 2:
        return cells
    best = max(known) if name in HIGHEST else min(known)
    return [rf"\textbf{{{cell}}}" if row.get(name) == best else cell for cell, row in zip(cells, rows, strict=True)]


def _caption(texts: dict[str, list[str]], columns: dict[str, list[str]], protocol: dict[str, Any]) -> str:
    """Return what all rows have in common, and how their pictures were compared."""
    same = [f"{name} {cells[0]}" for name, cells in texts.items() if name not in columns and cells[0]]
    told = f"{protocol.get('split', '')} views, {protocol.get('background', '')} background"
    how = [f"PSNR: {protocol['psnr']}"] if "psnr" in protocol and "PSNR" in columns else []
    how += [f"SSIM: {protocol['ssim']}"] if "ssim" in protocol and "SSIM" in columns else []
    is_spread = any("±" in cell for column in columns.values() for cell in column)
    spread = ["mean ± standard deviation over seeds"] if is_spread else []
    return f"{'. '.join(re.sub(r'[.]$', '', part) for part in (', '.join([*same, told]), *how, *spread))}."
