"""The table's page in a real browser: a click on a column sorts the rows, words filter them."""

import pytest
from support.browser import opened

from nerf_lightning.extensions.table.commands.table import write_table_page

pytestmark = pytest.mark.minutes

ROWS = [
    {"scene": "lego", "model": "fast", "PSNR": 31.3, "minutes": 2.0, "source": None},
    {"scene": "lego", "model": "nerf_tiny", "PSNR": 9.5, "minutes": 40.0, "source": None},
    {"scene": "lego", "model": "NeRF", "PSNR": 32.54, "minutes": None, "source": "arXiv 2003.08934"},
    {"scene": "fox", "model": "fast", "PSNR": None, "minutes": 0.5, "source": None},
]
SHOWN = "return [...document.querySelectorAll('tbody tr')].filter((row) => row.checkVisibility())"
MODELS = f"{SHOWN}.map((row) => row.cells[0].textContent + ' ' + row.cells[1].textContent)"


def test_the_rows_are_sorted_and_filtered(tmp_path):
    write_table_page(ROWS, "4 runs", ["A note."], tmp_path / "table.html")
    with opened((tmp_path / "table.html").as_uri(), 900, 500) as driver:

        def models() -> list[str]:
            return driver.execute_script(MODELS)

        def by(column: str) -> list[str]:
            driver.find_element("xpath", f"//th/button[text()='{column}']").click()
            return [name.removesuffix(" (published)") for name in models()]

        assert by("PSNR") == ["lego NeRF", "lego fast", "lego nerf_tiny", "fox fast"]
        assert by("PSNR") == ["lego nerf_tiny", "lego fast", "lego NeRF", "fox fast"]
        # Times by their length and not by their words; what has none comes last either way.
        assert by("time") == ["lego nerf_tiny", "lego fast", "fox fast", "lego NeRF"]
        assert by("model")[0] == "lego nerf_tiny"
        assert driver.execute_script("return document.querySelectorAll('th[aria-sort]').length") == 1
        field = driver.find_element("css selector", "input")
        field.send_keys("fast LEGO")
        assert models() == ["lego fast"]
        field.clear()
        field.send_keys("fox")
        assert models() == ["fox fast"]
        field.clear()
        field.send_keys(" ")
        assert len(models()) == 4
        assert driver.get_log("browser") == []
        assert driver.execute_script("return performance.getEntriesByType('resource').length") == 0
