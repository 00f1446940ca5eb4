"""Keys of a plan: their meaning in the table of the docs, and their limits in messages."""

import importlib.util
import sys
from pathlib import Path

import pytest

from scenes.episodes.draws import ValueLimits
from scenes.episodes.families import FamilyMotions
from scenes.episodes.plan import PlanContents, parse_plan
from sim.errors import InputError


def load_table():
    """Extension that writes the table of docs/reference/plan_keys.md."""
    path = Path(__file__).parents[1] / "docs/extensions/plan_keys.py"
    spec = importlib.util.spec_from_file_location("plan_keys", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["plan_keys"] = module
    spec.loader.exec_module(module)
    return module


TABLE = load_table()
KEYS = list(TABLE.list_keys(PlanContents))
LIMITED = [key for key in KEYS if isinstance(key.about, ValueLimits)]


def test_plan_table_has_a_meaning_for_every_key():
    assert len(KEYS) > 70 and {key.name.split(".")[1] for key in KEYS if "motion." in key.name} == set(
        FamilyMotions.__struct_fields__
    )
    assert list(TABLE.MEANINGS) == [key.name for key in KEYS] and all(TABLE.MEANINGS.values())
    rows = TABLE.plan_table().splitlines()[2:]
    assert len(rows) == len(KEYS)
    assert rows[1] == "| `motion.press.weight` |  | 0 to 100,000 | 1 | relative frequency of the scenario |"


def with_value(key, value):
    """A plan with one value."""
    *tables, last = key.name.split(".")
    size = f"[{value}, 64]" if last == "size" else str(value)
    kinds = {"tumour": "drawn", "tissue": "own.vtu"} if tables[:1] == ["bodies"] else {}
    more = f'anatomies = "{kinds[tables[1]]}"\n' if tables[1:] and tables[1] in kinds else ""
    own = f"[{'.'.join(tables)}]\n{last} = {size}\n" if tables else ""
    play = "" if key.name.startswith("motion.") else "[motion.press]\n"
    return f'title = "x"\n{"" if tables else f"{last} = {size}"}\n{play}{"[bodies]" if more else ""}\n{more}{own}'


@pytest.mark.parametrize("key", LIMITED, ids=lambda key: key.name)
def test_plan_value_beyond_limits_is_rejected_with_its_limits(key):
    step = max(1, round(1e-3 * key.about.high)) if isinstance(key.default, int) or key.name == "size" else 1e-3
    for value in (key.about.low - step, key.about.high + step):
        with pytest.raises(InputError) as refused:
            parse_plan(with_value(key, value), "mine")
        assert f"{key.name}: {value}" in str(refused.value) and f"{key.about}" in str(refused.value)
    parse_plan(with_value(key, key.about.high), "mine")  # what is possible is taken
