"""Size limit of the models that ship with the package."""

import pytest

from scenes.script.shipped_files import get_template_path

MOST = 8_000_000  # bytes; see docs/develop/release.md
MODELS = sorted(get_template_path().parent.glob("*.npz"))


@pytest.mark.parametrize("path", MODELS, ids=lambda path: path.name)
def test_shipped_model_file_is_below_the_size_limit(path):
    assert len(MODELS) >= 3 and path.stat().st_size < MOST
