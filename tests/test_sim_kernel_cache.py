"""Compiled kernels where the home folder cannot be written."""

import os
import stat
import subprocess
import sys
import tempfile
import warnings

import pytest

from sim.errors import InputError
from sim.runtime.kernel_cache import ensure_writable_cache


@pytest.fixture
def homeless(monkeypatch, tmp_path):
    """A home that cannot be written, and a temporary folder of the test's own."""
    for name in ("WARP_CACHE_PATH", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", "/proc")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / f"sulcus-kernels-{os.getuid()}"


@pytest.mark.parametrize(
    ("name", "value"),
    [("HOME", "/proc"), ("XDG_CACHE_HOME", "/proc/a"), ("WARP_CACHE_PATH", "/proc/b"), ("HOME", "relative")],
)
def test_unwritable_cache_is_replaced_with_one_warning(homeless, monkeypatch, name, value):
    monkeypatch.setenv(name, value)
    with pytest.warns(UserWarning, match="cannot be written: kernels are compiled into") as said:
        ensure_writable_cache()
    assert len(said) == 1 and os.environ["WARP_CACHE_PATH"] == str(homeless)
    assert stat.S_IMODE(homeless.stat().st_mode) == 0o700
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ensure_writable_cache()  # as a process that is started later
        monkeypatch.delenv("WARP_CACHE_PATH")
        monkeypatch.setenv("XDG_CACHE_HOME", str(homeless.parent))
        ensure_writable_cache()
    assert "WARP_CACHE_PATH" not in os.environ


@pytest.mark.parametrize("taken", ["link", "open", "file"])
def test_unsafe_cache_path_is_not_used(homeless, tmp_path, taken):
    if taken == "link":
        homeless.symlink_to(tmp_path / "theirs")
    elif taken == "open":
        homeless.mkdir()
        homeless.chmod(0o777)
    else:
        homeless.touch()
    with pytest.warns(UserWarning, match="kernels are compiled into"):
        ensure_writable_cache()
    chosen = os.environ["WARP_CACHE_PATH"]
    assert chosen.startswith(f"{tmp_path}/sulcus-kernels-") and chosen != str(homeless)
    assert stat.S_IMODE(os.stat(chosen).st_mode) == 0o700


def test_missing_writable_cache_folder_is_rejected(homeless, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", "/proc")
    with pytest.raises(InputError, match="Set WARP_CACHE_PATH"):
        ensure_writable_cache()


def test_command_runs_with_unwritable_home_folder(homeless, tmp_path):
    command = [sys.executable, "-m", "scenes.cli", "scenes", "--device", "cpu"]
    done = subprocess.run(command, env=os.environ | {"TMPDIR": str(tmp_path)}, capture_output=True, text=True)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert done.stderr.count("kernels are compiled into") == 1 and homeless.is_dir()
