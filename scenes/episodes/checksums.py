"""Checksums of the data sets and attributes of an HDF5 file."""

from hashlib import sha256

import h5py
import numpy as np

CHECKSUM_ATTRIBUTE = "sha256"
"""Attribute that contains the checksum of a data set or of the file."""
ARRAYS_ATTRIBUTE = "arrays"
"""Attribute of the file that lists the names of all written data sets."""


def compute_digest(data: h5py.Dataset) -> str:
    """Compute the hexadecimal digest of a data set's type, shape and content."""
    found = sha256(f"{data.shape} {data.dtype.str if data.dtype.kind != 'O' else 'objects'}".encode())
    values = np.asarray(data[()])
    if values.dtype.kind != "O":
        found.update(np.ascontiguousarray(values).tobytes())
        return found.hexdigest()
    for each in values.ravel():
        raw = each if isinstance(each, bytes) else str(each).encode() if isinstance(each, str) else each.tobytes()
        found.update(len(raw).to_bytes(8, "little") + raw)
    return found.hexdigest()


def list_datasets(file: h5py.File) -> list[h5py.Dataset]:
    """List all data sets of a file, sorted by name."""
    found: dict[str, h5py.Dataset] = {}
    file.visititems(lambda name, item: found.update({name: item}) if isinstance(item, h5py.Dataset) else None)
    return [found[name] for name in sorted(found)]


def compute_file_digest(file: h5py.File) -> str:
    """Compute the hexadecimal digest of all attributes of a file, which include the data sets' checksums."""
    found = sha256()
    for item in (file, *list_datasets(file)):
        for name in sorted(item.attrs):
            if item is file and name == CHECKSUM_ATTRIBUTE:
                continue
            value = item.attrs[name]
            said = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
            found.update(f"{item.name}\0{name}\0{said!r}\0".encode())
    return found.hexdigest()


def write_checksums(file: h5py.File) -> None:
    """Write the names of all data sets, their checksums, and the checksum of the file as attributes."""
    for data in list_datasets(file):
        data.attrs[CHECKSUM_ATTRIBUTE] = compute_digest(data)
    file.attrs[ARRAYS_ATTRIBUTE] = " ".join(_list_names(file))
    file.attrs[CHECKSUM_ATTRIBUTE] = compute_file_digest(file)


def find_errors(file: h5py.File) -> list[str]:
    """List the differences from the recorded checksums as sentences; empty for a file without checksums."""
    if CHECKSUM_ATTRIBUTE not in file.attrs:
        return []
    found = [
        f"{data.name}: is not as it was written"
        for data in list_datasets(file)
        if data.attrs.get(CHECKSUM_ATTRIBUTE) != compute_digest(data)
    ]
    if ARRAYS_ATTRIBUTE in file.attrs:
        there, written = _list_names(file), str(file.attrs[ARRAYS_ATTRIBUTE]).split()
        gone = [f"{name}: is gone; it was there when the file was written" for name in written if name not in there]
        gone += [f"{name}: was not there when the file was written" for name in there if name not in written]
        if gone:
            return [*gone, *(words for words in found if words.partition(": ")[0] in written)]
    if file.attrs[CHECKSUM_ATTRIBUTE] != compute_file_digest(file):
        arrays = "" if ARRAYS_ATTRIBUTE in file.attrs else ", or an array is gone: the file does not name those it had"
        found.append(f"attributes are not as they were written{arrays}")
    return found


def _list_names(file: h5py.File) -> list[str]:
    return [str(data.name) for data in list_datasets(file)]
