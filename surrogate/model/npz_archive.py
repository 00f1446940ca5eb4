"""Arrays of an untrusted `.npz` file: only requested arrays are read, up to a size limit."""

import json
import math
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.lib import format as npy

from sim.errors import InputError
from sim.geometry.tetmesh import compute_digest
from sim.runtime.file_limits import MAX_HEADER_BYTES, MAX_MODEL_BYTES

MAX_NPY_HEADER = 10_000  # Maximum size of an array's header [bytes].


def compute_seal(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    """Compute the digest of all arrays and of a file's header, without the header's entry `seal`."""
    names = sorted(arrays)
    stated = json.dumps([names, {name: value for name, value in header.items() if name != "seal"}], sort_keys=True)
    return compute_digest(np.frombuffer(stated.encode(), np.uint8), *(arrays[name] for name in names))


def write_archive(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays as an `.npz` file compressed by bzip2, which is faster and a quarter smaller than Deflate."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")  # without a time stamp: equal arrays give equal bytes
            entry.compress_type = zipfile.ZIP_BZIP2
            with archive.open(entry, "w", force_zip64=True) as member:
                npy.write_array(member, array, allow_pickle=False)


class Archive:
    """Reader of an open `.npz` file; each call reads at most `max_bytes` bytes of arrays.

    Every error message ends with `remedy`. Files of the wrong kind raise the exceptions of `zipfile` and NumPy.
    """

    def __init__(self, file: BinaryIO, remedy: str = "", max_bytes: int = MAX_MODEL_BYTES) -> None:
        self._zip, self._remedy, self._largest = zipfile.ZipFile(file), remedy, max_bytes

    def read_text(self, name: str) -> str:
        """Read the text that an array stores.

        Raises
        ------
        InputError
            The array is missing, or larger than `MAX_HEADER_BYTES`.
        """
        self._check_names([name], MAX_HEADER_BYTES)
        return str(self._read_array(name))

    def read_arrays(self, names: Iterable[str]) -> dict[str, np.ndarray]:
        """Read arrays by name.

        Raises
        ------
        InputError
            An array is missing, or the total size exceeds `max_bytes`.
        """
        wanted = sorted(set(names))
        self._check_names(wanted, self._largest)
        return {name: self._read_array(name) for name in wanted}

    def read_by_digest(self, digests: Iterable[str]) -> dict[str, np.ndarray]:
        """Read arrays whose names are the digests of their content, and verify the digests.

        Raises
        ------
        InputError
            See `read_arrays`, or an array does not match its digest.
        """
        found = self.read_arrays(digests)
        for name, array in found.items():
            if compute_digest(array) != name:
                raise self._build_error(f"its array {name!r} has another digest")
        return found

    def read_sealed(self, header: Mapping[str, Any], names: Iterable[str]) -> dict[str, np.ndarray]:
        """Read arrays by name, and verify the digest `seal` of header and arrays.

        Raises
        ------
        InputError
            See `read_arrays`, or the header and arrays do not match the seal.
        """
        found = self.read_arrays(names)
        if compute_seal(header, found) != header["seal"]:
            raise self._build_error("its header and arrays do not have the digest that it states")
        return found

    def _build_error(self, reason: str) -> InputError:
        return InputError(f"{reason}: it is damaged. {self._remedy}".rstrip())

    def _check_names(self, names: list[str], max_bytes: int) -> None:
        held = {info.filename: info for info in self._zip.infolist()}
        missing = [name for name in names if f"{name}.npy" not in held]
        if missing:
            raise self._build_error(f"lacks the array {missing[0]!r}")
        size = sum(held[f"{name}.npy"].file_size for name in names)
        if size > max_bytes:
            reason = f"has arrays of {size / 1e6:,.0f} MB: {max_bytes / 1e6:,.0f} MB are the most that are read."
            raise InputError(f"{reason} {self._remedy}".rstrip())

    def _read_array(self, name: str) -> np.ndarray:
        info = self._zip.getinfo(f"{name}.npy")
        with self._zip.open(info) as member:
            # The size is given here and in the archive: memory is allocated only if both agree.
            version = npy.read_magic(member)
            read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            shape, _, kind = read(member, max_header_size=MAX_NPY_HEADER)
            if kind.hasobject or math.prod(shape) * kind.itemsize > info.file_size:
                raise self._build_error(f"its array {name!r} is not what it says")
        with self._zip.open(info) as member:
            return cast(np.ndarray, npy.read_array(member, allow_pickle=False, max_header_size=MAX_NPY_HEADER))
