"""Versions of packages, and this package's own."""

import re

import pytest
from test_house_names import EXTRAS, PROJECT

from sim.runtime import versions
from sim.runtime.versions import DISTRIBUTION, get_version


def test_project_and_extras_use_the_same_distribution_name():
    assert PROJECT["name"] == DISTRIBUTION and DISTRIBUTION != "sulcus"
    own = [one for extra in EXTRAS.values() for one in extra if re.match(r"sulcus\b", one)]
    assert own == [f"{DISTRIBUTION}[camera,data,docs,gym,onnx,report,slicer]"]


def test_version_without_installation_is_that_of_pyproject(monkeypatch):
    def gone(name):
        raise versions.PackageNotFoundError(name)

    assert get_version("sulcus") == PROJECT["version"]
    monkeypatch.setattr(versions, "version", gone)
    assert get_version.__wrapped__("sulcus") == PROJECT["version"]
    with pytest.raises(versions.PackageNotFoundError):
        get_version.__wrapped__("numpy")
