"""The size of a `.vtu` file's arrays before they are unpacked."""

import base64
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from sim.bodies.vtu_size import check_vtu_size
from sim.errors import InputError


def packed_vtu(path: Path, order: str, encoding: str) -> Path:
    """Three numbers behind the XML, packed by zlib."""
    block = zlib.compress(np.zeros(3).tobytes())
    header = struct.pack(f"{'>' if order == 'BigEndian' else '<'}4I", 1, 24, 0, len(block))
    raw = header + block if encoding == "raw" else base64.b64encode(header) + base64.b64encode(block)
    path.write_bytes(
        f'<VTKFile type="UnstructuredGrid" byte_order="{order}" compressor="vtkZLibDataCompressor"><UnstructuredGrid>'
        f'<DataArray format="appended" offset="0"/></UnstructuredGrid><AppendedData encoding="{encoding}">\n_'.encode()
        + raw
        + b"\n</AppendedData></VTKFile>"
    )
    return path


@pytest.mark.parametrize("order", ["LittleEndian", "BigEndian"])
@pytest.mark.parametrize("encoding", ["raw", "base64"])
def test_appended_arrays_count_in_either_order_of_bytes(tmp_path: Path, order: str, encoding: str) -> None:
    path = packed_vtu(tmp_path / "a.vtu", order, encoding)
    assert check_vtu_size(path, 24) is (encoding == "base64")
    with pytest.raises(InputError, match="take more than"):
        check_vtu_size(path, 23)
