"""What a file may cost: one table, raised by the command line alone."""

import math
import re
from dataclasses import asdict

import pytest
from omegaconf import OmegaConf
from support.configs import loaded
from support.running import REPOSITORY

from nerf_lightning.files.budgets import Budgets, allow_as_typed, limits, require_within, set_limits
from nerf_lightning.messages.errors import InputError


@pytest.fixture(autouse=True)
def _defaults_afterwards():
    yield
    set_limits(Budgets())


def test_the_yaml_and_the_page_on_security_have_the_table_that_the_code_has():
    assert OmegaConf.to_container(loaded("budgets", "default")) == asdict(Budgets())
    rows = re.findall(r"`(\w+)` ([\d,]+)", (REPOSITORY / "SECURITY.md").read_text(encoding="utf-8"))
    assert {name: int(number.rstrip(",").replace(",", "")) for name, number in rows} == asdict(Budgets())


def test_a_limit_is_raised_by_what_is_typed_alone_and_what_is_too_much_is_said_with_its_setting():
    allow_as_typed(["scene=npz", "budgets.views=7", "xbudgets.points=3", "budgets.nothing=4"])
    assert limits() == Budgets(views=7)
    allow_as_typed([])
    assert limits() == Budgets()
    require_within("views", 200_000, "FILE", "views")
    with pytest.raises(InputError, match=r"FILE has 200,001 views, .* add budgets\.views=200001"):
        require_within("views", 200_001, "FILE", "views")
    with pytest.raises(InputError, match=r"FILE has more views than the limit of 200,000\. .* budgets\.views=400000"):
        require_within("views", math.inf, "FILE", "views")


@pytest.mark.parametrize("value", ["0", "-3", "many", "1.5", ""])
def test_a_limit_is_a_whole_number(value):
    with pytest.raises(InputError, match=r"budgets\.views=.*give a whole number above 0"):
        allow_as_typed([f"budgets.views={value}"])
