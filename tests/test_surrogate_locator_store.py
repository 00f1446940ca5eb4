"""Locator files of other versions, or damaged."""

import json

import numpy as np
import pytest

from scenes.script.shipped_files import get_template_path
from sim.bodies.meshfile import read_anatomy
from sim.errors import InputError
from surrogate.locating.locator_store import load_locator, to_locator_path


@pytest.fixture(scope="module")
def locator():
    return load_locator(to_locator_path(get_template_path()), read_anatomy(get_template_path()))


def test_locator_without_patch_sizes_is_rejected(locator, tmp_path):
    """The format in the header is checked before the arrays."""
    with np.load(to_locator_path(get_template_path())) as file:
        arrays = {name: file[name] for name in file.files}
    header = json.loads(str(arrays["header"])) | {"format": "sulcus locator 3"}
    path = tmp_path / "old.npz"
    np.savez(path, **arrays | {"header": np.array(json.dumps(header)), "tried": arrays["tried"][:, 1:]})
    with pytest.raises(InputError, match=r"is no locator of this version\. Move it away, and `sulcus locate` makes it"):
        load_locator(path, locator.anatomy)


@pytest.mark.parametrize("name", ["header", "tried", "shape", "kind", "place", "centre", "nodes"])
def test_locator_file_with_wrong_digest_is_rejected(locator, tmp_path, name):
    with np.load(to_locator_path(get_template_path())) as file:
        arrays = {name: file[name] for name in file.files}
    if name == "header":
        region = {"name": "tumour", "ratio": 3.0}
        arrays["header"] = np.array(json.dumps(json.loads(str(arrays["header"])) | {"regions": [], "more": region}))
    else:
        arrays[name] = np.concatenate([arrays[name][1:], arrays[name][:1]]) if name != "shape" else 10.0 * arrays[name]
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(InputError, match=r"a\.npz: .* not have the digest that it states.* Move it away"):
        load_locator(tmp_path / "a.npz", locator.anatomy)
