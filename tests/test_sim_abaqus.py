"""Abaqus input files as Abaqus/CAE, CalculiX and meshers write them."""

from pathlib import Path

import numpy as np
import pytest
from boxes import box

from sim.bodies.meshfile import read_mesh
from sim.errors import InputError

MESH = box((2, 2, 2), 0.1)
TUMOUR = np.arange(48) >= 10


def rows(table: np.ndarray, first: int = 1) -> str:
    return "\n".join(", ".join(map(str, [n, *row])) for n, row in enumerate(table.tolist(), first))


NODES, MORE = rows(MESH.nodes[:20]), rows(MESH.nodes[20:], 21)
NODE, TETS = f"*NODE\n{NODES}\n{MORE}", rows(MESH.tets + 1)
BRAIN, REST = rows(MESH.tets[:10] + 1), rows(MESH.tets[10:] + 1, 11)
HALF = rows(MESH.tets[20:] + 1, 21)
SETS = f"*ELEMENT, TYPE=C3D4, ELSET=BRAIN\n{BRAIN}\n*ELEMENT, TYPE=C3D4, ELSET=TUMOR\n{REST}"
TET = f"*ELEMENT, TYPE=C3D4\n{TETS}"
ASSEMBLY = f"*PART, NAME=P\n{NODE}\n{TET}\n*END PART\n*ASSEMBLY, NAME=A\n*INSTANCE, NAME=I, PART=P\n"


@pytest.mark.parametrize("text", [
    f"*NODE\n{NODES}\n*NODE\n{MORE}\n{SETS}",
    f"*NODE, NSET=A\n{NODES}\n{SETS}\n*NODE, NSET=B\n{MORE}",
    f"{NODE}\n{SETS}\n*ELSET, ELSET=ALL\nBRAIN, TUMOR",
    f"{NODE}\n" + SETS.replace(HALF, f"*ELEMENT, TYPE=C3D4, ELSET=TUMOR\n{HALF}"),
    f"{NODE}\n*ELEMENT, TYPE=CPS3\n99, 1, 2, 3\n{SETS}",
    f"{NODE}\n*ELEMENT, TYPE=C3D4\n{BRAIN}\n*ELSET, ELSET=BRAIN, GENERATE\n1, 10, 1\n*ELEMENT, TYPE=C3D4\n{REST}\n"
    "*ELSET, ELSET=Tumor, GENERATE\n11, 30\n31, 48, 1",
    f"\ufeff** \u00df\n*Node\n{NODES},\n{MORE}\n*Element, type=c3d4h,\nelset=brain\n{BRAIN}\n"
    f"*Element, type=c3d4h, elset=tumor\n{REST}",
    f"*PART, NAME=P\n{NODE}\n{SETS}\n*END PART\n*ASSEMBLY, NAME=A\n*INSTANCE, NAME=I, PART=P\n*END INSTANCE\n*NODE\n"
    "1, 9., 9., 9.\n*ELSET, ELSET=_PICK, INTERNAL\n3, 12\n*END ASSEMBLY",
])  # fmt: skip
def test_abaqus_blocks_in_any_order_give_the_same_mesh(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.inp").write_text(f"*HEADING\n{text}\n")
    mesh = read_mesh(tmp_path / "a.inp").mesh
    np.testing.assert_array_equal(mesh.nodes, MESH.nodes)
    np.testing.assert_array_equal(mesh.tets, MESH.tets)
    np.testing.assert_array_equal(mesh.region, np.where(TUMOUR, 2, 1))


@pytest.mark.parametrize(("text", "reason"), [
    (f"{NODE}\n*ELEMENT, TYPE=CPS3\n1, 1, 2, 3", "holds CPS3, but no tetrahedra.*Mesh its volume first"),
    (f"{NODE}\n*ELEMENT, TYPE=CPE4\n1, 1, 2, 3, 4", "holds CPE4, but no tetrahedra"),
    (f"{NODE}\n{TET}\n*ELEMENT, TYPE=C3D20R\n99, 1, 2, 3,\n4, 5", "its volume is 1 hexahedron20: .* must be tetra"),
    (f"{NODE}\n{TET}\n*NODE\n1, 9, 9, 9", "node 1 is listed at two places, as in a file of several parts: save it"),
    (f"*NODE\n{NODES}\n{TET}", r"names node 2\d, which no \*NODE lists"),
    (f"{NODE}\n*ELEMENT\n{TETS}", r"no TYPE: state it, such as TYPE=C3D4"),
    (f"{NODE}\n*NGEN\n1, 5, 1\n{TET}", r"its \*NGEN computes coordinates or elements: save it with all"),
    (f"*NODE, SYSTEM=C\n{NODES}\n{MORE}\n{TET}", r"its \*NODE computes coordinates"),
    (f"*NODE, INPUT=b.inp\n{TET}", r"includes another file\. Merge both"),
    (f"{NODE}\n{TET}\n*ELSET, ELSET=A, GENERATE\n1, 1000000000000, 1", "arrays take more than 4.29 GB"),
    (f"{ASSEMBLY}0., 0., 0.\n0., 0., 0., 0., 0., 1., 90.", r"\*INSTANCE is rotated: its nodes must be listed where"),
    (f"{ASSEMBLY}*END INSTANCE\n*INSTANCE, NAME=J, PART=Q\n0, 1, 0", "moved apart, or several of one part: every node"),
    (f"{ASSEMBLY}*END INSTANCE\n*INSTANCE, NAME=J, PART=P", "moved apart, or several of one part: every node"),
    ("*NODE\n1, 0, 0, x", "it is damaged, or of another kind"),
])  # fmt: skip
def test_unsupported_abaqus_input_is_rejected_with_reason(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "a.inp").write_text(text)
    with pytest.raises(InputError, match=reason):
        read_mesh(tmp_path / "a.inp")


@pytest.mark.parametrize(("line", "moved"), [("0.1, 0, -2.", (0.1, 0, -2)), (", 3,", (0, 3, 0)), ("", (0, 0, 0))])
def test_translation_of_abaqus_instance_moves_nodes(tmp_path: Path, line: str, moved: tuple[float, ...]) -> None:
    (tmp_path / "a.inp").write_text(f"{ASSEMBLY}{line}\n*END INSTANCE\n*END ASSEMBLY\n")
    np.testing.assert_allclose(read_mesh(tmp_path / "a.inp").mesh.nodes, MESH.nodes + moved, atol=1e-15)
