"""What a page shows of metrics.json, which may be anybody's: what does not fit is left out."""

import pytest

from nerf_lightning.report.metrics import WITHOUT_LPIPS, tables, views_on_page


@pytest.mark.parametrize("name", [[], {}, "x" * 5000, "a\x00", 10**400], ids=lambda name: str(name)[:9])
def test_views_of_no_name_are_missing(tmp_path, name):
    metrics = {"per_image": [{"name": name}], "worst_views": [name], "pictures": [name]}
    worst, spread, missing = views_on_page(metrics, tmp_path)
    assert (worst, spread) == ([], [])
    assert len(missing) == 2


def test_the_page_says_what_lpips_needs_where_it_was_not_computed():
    protocol = {"protocol": {"split": "test"}}
    assert ("LPIPS", WITHOUT_LPIPS) in dict(tables(protocol | {"lpips": None}))["Protocol"]
    assert ("LPIPS", WITHOUT_LPIPS) not in dict(tables(protocol | {"lpips": 0.1}))["Protocol"]
    assert dict(tables({}))["Protocol"] == []
