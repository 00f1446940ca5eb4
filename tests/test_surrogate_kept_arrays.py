"""Cached arrays of a run in a folder."""

from types import SimpleNamespace

from surrogate.model import kept_arrays
from surrogate.model.kept_arrays import get_cache_path


def test_cache_path_depends_on_version_device_and_inputs(tmp_path, monkeypatch):
    first = get_cache_path(tmp_path, "a-", "cpu", "digest", "smoothed")
    assert (
        first == get_cache_path(tmp_path, "a-", "cpu", "digest", "smoothed")
        and get_cache_path(None, "a-", "cpu") is None
    )
    others = [get_cache_path(tmp_path, "a-", "cpu", "digest", "p2")]
    monkeypatch.setattr(kept_arrays, "get_version", lambda name: "9.9")
    others.append(get_cache_path(tmp_path, "a-", "cpu", "digest", "smoothed"))
    monkeypatch.setattr(kept_arrays, "find_device", lambda name, precision: SimpleNamespace(on_cuda=True))
    others.append(get_cache_path(tmp_path, "a-", "cuda", "digest", "smoothed"))
    assert len({first, *others}) == 4
