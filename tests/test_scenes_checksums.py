"""Checksums of an episode: changed, removed and added arrays are named."""

import h5py

from scenes.episodes.checksums import write_checksums
from scenes.episodes.reading.validation import validate_episode


def test_validation_names_array_with_changed_content(whole, tmp_path):
    path = tmp_path / whole.name
    path.write_bytes(whole.read_bytes())
    with h5py.File(path, "a") as file:
        write_checksums(file)
    assert validate_episode(path).problems == [] and "checksums: it states none" not in validate_episode(path).skipped
    with h5py.File(path, "a") as file:
        file["force"][2, 1] += 1e-9
    assert validate_episode(path).problems == ["/force: is not as it was written."]


def test_validation_names_removed_and_added_arrays(whole, tmp_path):
    path = tmp_path / whole.name
    path.write_bytes(whole.read_bytes())
    with h5py.File(path, "a") as file:
        write_checksums(file)
        del file["force"], file["pictures/depth"]
        file["tip"][2, 1] += 1e-9
        file["late"] = [1.0]
    gone = "is gone; it was there when the file was written."
    assert validate_episode(path).problems == [
        f"/force: {gone}",
        f"/pictures/depth: {gone}",
        "/late: was not there when the file was written.",
        "/tip: is not as it was written.",
    ]
    path.write_bytes(whole.read_bytes())
    with h5py.File(path, "a") as file:
        write_checksums(file)
        file["force"].attrs["note"] = "mine"
    assert validate_episode(path).problems == ["attributes are not as they were written."]
