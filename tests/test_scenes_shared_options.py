"""Lines of JSON."""

import json
import math

from scenes.options.shared_options import to_json_line


def test_non_finite_numbers_are_null_in_json():
    """JSON has no NaN or Infinity, although Python writes them."""
    said = {"rows": [{"bond": math.nan, "worst": (1.5, -math.inf)}], "good": True, "name": "nan"}
    assert json.loads(to_json_line(said)) == {
        "rows": [{"bond": None, "worst": [1.5, None]}],
        "good": True,
        "name": "nan",
    }
