"""Input files: a one-line message for every defect, and bounded memory."""

import base64
import lzma
import os
import re
import resource
import struct
import zlib
from pathlib import Path

import meshio
import numpy as np
import pytest
from boxes import base_held, box
from limits import memory_below

from sim.anatomy import Anatomy
from sim.bodies.meshfile import read_anatomy, read_mesh, write_anatomy, write_mesh
from sim.bodies.vtu_size import check_vtu_size
from sim.errors import InputError
from sim.geometry.tetmesh import TetMesh
from sim.material import BRAIN, read_tissue_json, to_tissue_json
from sim.runtime.file_limits import MeshSizeLimits
from sim.runtime.outside_files import wrap_errors

BODY = base_held(box((2, 2, 2), 0.02))
FEW = MeshSizeLimits(max_bytes=2**22)


def fattened(path: Path, megabytes: int) -> Path:
    """A .vtu whose points are packed zeros, one block of so many megabytes."""
    block = zlib.compress(bytes(megabytes * 2**20))
    head = base64.b64encode(struct.pack("<4I", 1, megabytes * 2**20, 0, len(block))).decode()
    text = path.read_text()
    start = text.index('NumberOfComponents="3" format="binary">') + len('NumberOfComponents="3" format="binary">')
    path.write_text(text[:start] + head + base64.b64encode(block).decode() + text[text.index("<", start) :])
    return path


def with_raw_bytes(path: Path, packed: bytes) -> Path:
    """A .vtu whose one array lies behind the XML, packed by zlib, as ParaView writes it."""
    path.write_bytes(
        b'<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64" '
        b'compressor="vtkZLibDataCompressor"><UnstructuredGrid><Piece NumberOfPoints="1" NumberOfCells="0"><Points>'
        b'<DataArray type="Float64" NumberOfComponents="3" format="appended" offset="0"/></Points><Cells/></Piece>'
        b'</UnstructuredGrid><AppendedData encoding="raw">\n_' + packed + b"\n</AppendedData></VTKFile>"
    )
    return path


def bomb(path: Path) -> Path:
    """A small file of the kind of its ending that asks for gigabytes."""
    mesh = meshio.Mesh(BODY.mesh.nodes, [("tetra", BODY.mesh.tets)])
    if path.name == "a4.msh":  # 4.1: numbers of blocks and nodes, least and largest tag; then a block's own
        mesh.write(path, "gmsh", binary=True)
        head, body = path.read_bytes().split(b"$Nodes\n")
        many = 900_000_000
        block = struct.pack("<4Q", 1, many, 1, many) + body[32:44] + struct.pack("<Q", many)
        path.write_bytes(head + b"$Nodes\n" + block + body[52:])
    elif path.suffix == ".msh":
        mesh.write(path, "gmsh22")
        head = f"$Nodes\n{len(mesh.points)}\n".encode()
        path.write_bytes(path.read_bytes().replace(head, b"$Nodes\n900000000\n"))
    if path.suffix == ".meshb":
        path.write_bytes(struct.pack("<8i", 1, 2, 3, 20, 3, 4, 0, 900_000_000))
    if path.suffix == ".vtk":
        mesh.write(path)
        path.write_bytes(re.sub(rb"POINTS \d+", b"POINTS 900000000", path.read_bytes()))
    return path


class TestMeshes:
    @pytest.mark.parametrize("name", ["a.msh", "a4.msh", "a.vtk", "a.meshb"])
    def test_mesh_formats_cannot_exhaust_memory(self, tmp_path: Path, name: str) -> None:
        before = resource.getrlimit(resource.RLIMIT_AS)
        with pytest.raises(InputError, match=r"take more than 4\.29 GB"):
            read_mesh(bomb(tmp_path / name))
        assert resource.getrlimit(resource.RLIMIT_AS) == before

    @pytest.mark.parametrize("name", ["a.msh", "a.vtk", "a.xdmf", "a.inp"])
    def test_valid_meshes_of_limited_formats_are_read(self, tmp_path: Path, name: str) -> None:
        meshio.Mesh(BODY.mesh.nodes, [("tetra", BODY.mesh.tets)]).write(tmp_path / name)
        assert np.array_equal(read_mesh(tmp_path / name).mesh.tets, BODY.mesh.tets)

    def test_raw_bytes_behind_the_xml_are_counted(self, tmp_path: Path) -> None:
        block = zlib.compress(bytes(2**23))
        path = with_raw_bytes(tmp_path / "a.vtu", struct.pack("<4Q", 1, 2**23, 0, len(block)) + block)
        with memory_below(2**22), pytest.raises(InputError, match=r"take more than 0\.00419 GB"):
            read_mesh(path, limits=FEW)
        few = zlib.compress(np.zeros(3).tobytes())
        small = with_raw_bytes(tmp_path / "b.vtu", struct.pack("<4Q", 1, 24, 0, len(few)) + few)
        assert not check_vtu_size(small, 24)  # it is small, but meshio's own way through it is bounded besides
        with pytest.raises(InputError):
            check_vtu_size(small, 23)

    def test_small_compressed_mesh_cannot_exhaust_memory(self, tmp_path: Path) -> None:
        write_mesh(tmp_path / "a.vtu", BODY.mesh, {})
        assert read_mesh(tmp_path / "a.vtu", limits=FEW).mesh.digest == BODY.mesh.digest
        fattened(tmp_path / "a.vtu", 64)
        with memory_below(2**24), pytest.raises(InputError, match=r"take more than 0\.00419 GB"):
            read_mesh(tmp_path / "a.vtu", limits=FEW)
        assert MeshSizeLimits().max_bytes > 2**31

    def test_mesh_file_above_size_limit_is_rejected(self, tmp_path: Path) -> None:
        for name in ("a.vtu", "a.inp"):
            (tmp_path / name).touch()
            os.truncate(tmp_path / name, 60 * 10**9)  # of which the disk holds nothing
            with pytest.raises(InputError, match=r"size is 60 GB: at most 4\.29 GB are allowed\. Mesh coarser"):
                read_mesh(tmp_path / name)
        assert MeshSizeLimits().limit_bytes(10) == 2**28 and MeshSizeLimits().limit_bytes(2**23) == 100 * 2**23

    @pytest.mark.parametrize("packing", ["zlib", "lzma"])
    def test_a_bomb_is_refused_before_it_is_inflated(self, tmp_path: Path, packing: str) -> None:
        """Ten gigabytes in 10 MB by what the header says; with a header that lies, its first block shows it."""
        pack = {"zlib": zlib.compress, "lzma": lzma.compress}[packing]
        block = pack(bytes(2**23))
        for size, words in ((2**23, r"take more than 0\.268 GB"), (2**10, "inflates to more than its header says")):
            path = with_raw_bytes(
                tmp_path / "a.vtu", struct.pack("<1203Q", 1200, size, 0, *[len(block)] * 1200) + block
            )
            path.write_bytes(path.read_bytes().replace(b"ZLib", b"ZLib" if packing == "zlib" else b"LZMA"))
            with pytest.raises(InputError, match=words):
                read_mesh(path)

    def test_every_stream_of_a_block_counts(self, tmp_path: Path) -> None:
        """The library that unpacks LZMA continues after the first stream."""
        block = lzma.compress(bytes(24)) + lzma.compress(bytes(2**20))
        path = with_raw_bytes(tmp_path / "a.vtu", struct.pack("<4Q", 1, 24, 0, len(block)) + block)
        path.write_bytes(path.read_bytes().replace(b"ZLib", b"LZMA"))
        with pytest.raises(InputError, match="inflates to more than its header says"):
            check_vtu_size(path, 2**30)

    def test_raw_data_tag_in_comment_does_not_evade_the_limit(self, tmp_path: Path) -> None:
        write_mesh(tmp_path / "a.vtu", BODY.mesh, {})
        text = fattened(tmp_path / "a.vtu", 64).read_text().replace("</VTKFile>", "<!-- </AppendedData> --></VTKFile>")
        (tmp_path / "a.vtu").write_text(text.replace("<Unstr", '<!-- <AppendedData encoding="raw"> --><Unstr', 1))
        with pytest.raises(InputError, match=r"take more than 0\.00419 GB"):
            read_mesh(tmp_path / "a.vtu", limits=FEW)

    @pytest.mark.parametrize("kind", ["Int64", "Float64"])
    def test_vtu_header_of_signed_integers_is_rejected(self, tmp_path: Path, kind: str) -> None:
        """Blocks of -8 bytes would make meshio read the same position for ever."""
        path = with_raw_bytes(tmp_path / "a.vtu", struct.pack("<q", -8) * 4)
        path.write_bytes(path.read_bytes().replace(b"UInt64", kind.encode()).replace(b' compressor="vtkZLib', b' a="'))
        with pytest.raises(InputError, match=f"header_type is '{kind}'. Write it again with UInt32 or UInt64"):
            read_mesh(path)

    @pytest.mark.parametrize("name", ["a.vtu", "a.xdmf"])
    def test_xml_entities_are_rejected_without_expansion(self, tmp_path: Path, name: str) -> None:
        tens = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 12))
        for entities in (f'<!ENTITY a0 "aaaaaaaaaa">{tens}', '<!ENTITY a11 SYSTEM "file:///etc/passwd">'):
            (tmp_path / name).write_text(f"<!DOCTYPE x [{entities}]><Xdmf Version='3.0'>&a11;</Xdmf>")
            with memory_below(2**26), pytest.raises(InputError, match="it is damaged, or of another kind"):
                read_mesh(tmp_path / name)

    @pytest.mark.parametrize("path", [None, 3, b"a.vtu"])
    def test_path_of_wrong_type_is_rejected(self, path: object) -> None:
        with pytest.raises(InputError, match="names no file: give its path as text"):
            read_anatomy(path)  # pyright: ignore[reportArgumentType]

    @pytest.mark.parametrize(("name", "text", "reason"), [
        ("a.vtu", "no xml", None),
        ("a.vtu", "", None),
        ("a.vtu", "<VTKFile", None),
        ("a.vtu", "<VTKFile type='ImageData'/>", "Expected type UnstructuredGrid, found ImageData"),
        ("a.vtu", "<a/>", "Expected tag 'VTKFile', found a"),
        ("a.bdf", "GRID,1,,0.,0.,0.", '"BEGIN BULK" statement not found'),
        ("a.mesh", "MeshVersionFormatted 2\nDimension 3\nFoo", "Unknown keyword 'Foo'"),
        ("a.vtk", "# vtk DataFile Version 3.0\n\nASCII\nDATASET A\x1b[2J\n", "Only VTK .* supported .not A [2J.*"),
        ("a.msh", "$MeshFormat\n5.0 0 8\n$EndMeshFormat", "Need mesh format in .* .got 5.0."),
    ])  # fmt: skip
    def test_mesh_reader_message_includes_reason_of_meshio(
        self, tmp_path: Path, capfd: pytest.CaptureFixture, name: str, text: str, reason: str | None
    ) -> None:
        """meshio's own reason is included; other exceptions mean a damaged file."""
        path = tmp_path / name
        path.write_text(text)
        said = f"meshio reports `{reason}`" if reason else "cannot be read as a mesh: it is damaged, or of another kind"
        sentence = rf"{path}: {said}\. Convert it to \.vtu or \.msh\.".replace("[", r"\[")
        with pytest.raises(InputError, match=f"^{sentence}$"):
            read_mesh(path)
        assert capfd.readouterr() == ("", "")

    def test_anatomy_in_millimetres_is_rejected(self, tmp_path: Path) -> None:
        mesh = TetMesh(BODY.mesh.nodes, BODY.mesh.tets, BODY.mesh.region)
        write_mesh(tmp_path / "m.vtu", mesh, self.fields())
        assert read_anatomy(tmp_path / "m.vtu").digest == BODY.digest
        with pytest.warns(UserWarning, match="with unit mm"):
            large = TetMesh(1e3 * mesh.nodes, mesh.tets, mesh.region)
        write_mesh(tmp_path / "mm.vtu", large, self.fields())
        with pytest.raises(InputError, match=r"measures 2e.04 mm, .*must be metres"):
            read_anatomy(tmp_path / "mm.vtu")

    @pytest.mark.parametrize("name", ["held", "slide_normal", "craniotomy"])
    def test_anatomy_with_nan_fields_is_rejected(self, tmp_path: Path, name: str) -> None:
        field = self.fields()[name].astype(float)
        field[3] = np.nan
        write_mesh(tmp_path / "a.vtu", BODY.mesh, self.fields() | {name: field})
        with pytest.raises(InputError, match=f"`{name}` has values that are no finite numbers"):
            read_anatomy(tmp_path / "a.vtu")

    @staticmethod
    def fields() -> dict[str, np.ndarray]:
        return {
            "held": BODY.fixed.astype(np.uint8),
            "slide_normal": BODY.slide_normal,
            "craniotomy": BODY.craniotomy.astype(np.uint8),
        }

    def test_damaged_anatomy_is_rejected_or_still_valid(self, tmp_path: Path) -> None:
        write_anatomy(tmp_path / "a.vtu", BODY)
        whole = np.frombuffer((tmp_path / "a.vtu").read_bytes(), np.uint8)
        refused = 0
        for seed in range(40):
            random = np.random.default_rng(seed)
            raw = whole.copy()
            raw[random.integers(0, len(raw), 3)] = random.integers(0, 256, 3)
            (tmp_path / "b.vtu").write_bytes(raw.tobytes())
            try:
                assert isinstance(read_anatomy(tmp_path / "b.vtu"), Anatomy)
            except InputError as error:
                refused += 1
                assert str(error).startswith(str(tmp_path / "b.vtu")) and "\n" not in str(error)
        assert refused > 20


@pytest.mark.parametrize(
    "text", ["[]", "3", "null", "{}", "[" * 100_000, '{"law": []}', '{"law": "linear", "young": "a", "poisson": 0.3}']
)
def test_invalid_tissue_json_is_rejected(text: str) -> None:
    assert read_tissue_json(to_tissue_json(BRAIN)) == BRAIN
    with pytest.raises(InputError) as caught:
        read_tissue_json(text)
    assert len(str(caught.value)) < 400 and "object" not in str(caught.value)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (MemoryError("4 GiB"), "more memory than there is"),
        (RecursionError("maximum depth"), "nested too deeply"),
        (zlib.error("Error -3"), "damaged"),
        (NotImplementedError("method 99"), "damaged"),
        (RuntimeError("encrypted"), "damaged"),
        (PermissionError(13, "library text"), "permission denied"),
        (SystemExit(1), "damaged"),
    ],
)
def test_exceptions_of_libraries_become_input_errors(error: BaseException, reason: str) -> None:
    sentence = rf"a\.x: cannot be read as a thing: .*{reason}.*\. Make one\."
    with pytest.raises(InputError, match=sentence) as caught, wrap_errors("a.x", "a thing", "Make one."):
        raise error
    assert not re.search(r"4 GiB|depth|-3|99|encrypted|library", str(caught.value))


def test_keyboard_interrupt_is_not_converted() -> None:
    with pytest.raises(KeyboardInterrupt), wrap_errors("a.x", "a thing", "Make one."):
        raise KeyboardInterrupt
