"""Tissue options of the command line: laws, named tissues, regions and contradictions."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest
from boxes import box, top_forces
from oracle import internal_forces
from programs import main

from scenes.options.tissue_options import add_tissue_arguments, check_stiffness, parse_region_tissues, parse_tissue
from sim.errors import InputError
from sim.geometry.tetmesh import TetMesh
from sim.material import BRAIN, LAWS, MEASURED_BRAIN, Material, Ogden, Tissue
from sim.named_tissues import MATERIALS

MESH = box((2, 2, 3), 0.1, distortion=0.15)
UPPER = (MESH.nodes[MESH.tets].mean(axis=1)[:, 2] > 0.05).astype(int)
BASE = MESH.nodes[:, 2] < 1e-9
FORCE = top_forces(MESH, np.array([0.02, 0.01, -0.04]))[0]
TWO_TERMS = "--material", "ogden", "--ogden", "1340,-19;700,2.5", "--bulk", "2e4"


def asked(*words: str) -> Tissue:
    parser = argparse.ArgumentParser()
    add_tissue_arguments(parser)
    return parse_tissue(parser.parse_args(words))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), BRAIN),
        (("--young", "5000"), Material(BRAIN.law, 5000.0, BRAIN.poisson)),
        (("--material", "linear"), Material("linear", 3000.0, 0.49)),
        (("--material", "corotational", "--poisson", "0.3"), Material("corotational", 3000.0, 0.3)),
        (("--material", "seconds"), Material("neo-hookean", 3000.0, 0.49)),
        (("--material", "seconds", "--young", "9000"), Material("neo-hookean", 9000.0, 0.49)),
        (("--material", "brain", "--young", "9000"), MEASURED_BRAIN.replace_constants(9000.0)),
        (("--material", "minutes"), MATERIALS["minutes"].tissue),
        (TWO_TERMS, Ogden(((1340.0, -19.0), (700.0, 2.5)), 2e4)),
        (("--material", "ogden", "--ogden=-300,2; 1e3 , 4", "--bulk", "2e4"), Ogden(((-300.0, 2.0), (1e3, 4.0)), 2e4)),
    ],
)
def test_tissue_options_give_the_expected_tissue(words: tuple[str, ...], expected: Tissue) -> None:
    assert asked(*words) == expected


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--ogden", "1340,-19"), "--ogden says nothing to --material default"),
        (("--material", "neo-hookean", "--bulk", "1e4"), "--bulk says nothing to --material neo-hookean"),
        (("--material", "minutes", "--bulk", "1e4"), "--bulk says nothing to --material minutes"),
        ((*TWO_TERMS, "--young", "3000"), "--young says nothing to --material ogden"),
        ((*TWO_TERMS, "--poisson", "0.4"), "--poisson says nothing to --material ogden"),
        (("--material", "ogden", "--bulk", "1e4"), "lacks --ogden"),
        (("--material", "ogden", "--ogden", "1340,-19"), "lacks --bulk"),
        (("--material", "ogden", "--ogden", "1340", "--bulk", "1e4"), "write pairs C,M"),
        (("--material", "ogden", "--ogden", "1340,-19;", "--bulk", "1e4"), "write pairs C,M"),
        (("--material", "ogden", "--ogden", "1340,-19,3", "--bulk", "1e4"), "write pairs C,M"),
        (("--material", "ogden", "--ogden", "soft,-19", "--bulk", "1e4"), "write pairs C,M"),
        (("--material", "ogden", "--ogden", "1340,0", "--bulk", "1e4"), "finite, nonzero m"),
        (("--material", "ogden", "--ogden", "nan,2", "--bulk", "1e4"), "finite c"),
        (("--material", "ogden", "--ogden", "1340,2", "--bulk", "-1"), "bulk modulus is -1.0 Pa"),
        (("--poisson", "0.5"), "Poisson's ratio is 0.5"),
    ],
)
def test_contradictory_tissue_options_are_rejected(words: tuple[str, ...], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence.replace("(", r"\(")) as caught:
        asked(*words)
    assert str(caught.value).endswith(".")


def test_region_tissues_have_the_law_of_the_brain() -> None:
    found = parse_region_tissues(["2:9000,0.3", "-1:500,0.49"], MATERIALS["seconds"].tissue)
    assert found == {2: Material("neo-hookean", 9000.0, 0.3), -1: Material("neo-hookean", 500.0, 0.49)}
    found = parse_region_tissues(["7:500,2;300,-4;1e4"], MATERIALS["minutes"].tissue)
    assert found == {7: Ogden(((500.0, 2.0), (300.0, -4.0)), 1e4)}
    one = parse_region_tissues(["2:9000,0.3"], MATERIALS["brain"].tissue)[2]
    assert isinstance(one, Ogden)
    assert (one.young, one.poisson, one.terms[0][1], one.limit) == (9000.0, 0.3, -20.0, 0.11)


@pytest.mark.parametrize(("name", "text"), [("seconds", "2:9000,0.3"), ("minutes", "2:500,2;1e4")])
def test_region_tissues_have_the_relaxation_of_the_brain(name: str, text: str) -> None:
    slow = replace(MATERIALS[name].tissue, prony=((0.3, 2.0),))
    assert parse_region_tissues([text], slow)[2].prony == ((0.3, 2.0),)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("2:500,2,1", "write REGION:YOUNG, as in oedema:2000, or 2:1340,-19;148000"),
        ("2:500;1e4", "write REGION:YOUNG, as in oedema:2000, or 2:1340,-19;148000"),
        ("2:500,2", "Poisson's ratio is 2.0"),
        ("2:500,2;0", "bulk modulus is 0.0 Pa"),
        ("grey:500,2;1e4", "write REGION"),
    ],
)
def test_region_tissue_with_wrong_format_is_rejected(text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        parse_region_tissues([text], MATERIALS["minutes"].tissue)


def solve(folder: Path, *words: str) -> int:
    data = {"fixed": BASE.astype(int), "force": FORCE}
    meshio.Mesh(MESH.nodes, [("tetra", MESH.tets)], data, {"region": [UPPER]}).write(folder / "in.vtu")
    command = ["solve", str(folder / "in.vtu"), "--device", "cpu", "--out", str(folder / "out.vtu"), *words]
    return main([*command, "--tolerance", "1e-9"])


def residual(folder: Path, tissues: dict[int, Tissue]) -> float:
    """Of the free nodes, relative, by the published formulas."""
    u = meshio.read(folder / "out.vtu").point_data["displacement"]
    unbalanced = internal_forces(TetMesh(MESH.nodes, MESH.tets, UPPER), tissues, u) - FORCE
    return float(np.linalg.norm(unbalanced[~BASE]) / np.linalg.norm(unbalanced))


def test_two_term_ogden_and_region_match_published_formula(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert solve(tmp_path, *TWO_TERMS, "--region", "1:5000,3;9e4") == 0
    assert json.loads(capsys.readouterr().out)["outcome"] == "converged"
    tissues: dict[int, Tissue] = {0: Ogden(((1340.0, -19.0), (700.0, 2.5)), 2e4), 1: Ogden(((5000.0, 3.0),), 9e4)}
    assert residual(tmp_path, tissues) < 1e-8
    assert residual(tmp_path, {0: tissues[0], 1: tissues[0]}) > 1e-3


@pytest.mark.parametrize("name", MATERIALS)
def test_named_tissues_match_published_formulas(name: str, tmp_path: Path) -> None:
    tissue = MATERIALS[name].tissue
    assert solve(tmp_path, "--material", name) == 0
    assert residual(tmp_path, {0: tissue, 1: tissue}) < 1e-8


def test_solve_exits_with_2_for_contradictory_tissue_options(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert solve(tmp_path, *TWO_TERMS, "--young", "3000") == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("sulcus solve: --young says nothing")
    assert not (tmp_path / "out.vtu").exists()


def help_on_tissue(capsys: pytest.CaptureFixture, *command: str) -> str:
    """What a command's help says of --material."""
    with pytest.raises(SystemExit):
        main([*command, "--help"])
    options = capsys.readouterr().out.split("\noptions:")[1]
    return options.split("  --material TISSUE")[1].split("  --young PA")[0]


def test_help_of_solve_names_each_tissue_with_its_source(capsys: pytest.CaptureFixture) -> None:
    said = "".join(help_on_tissue(capsys, "solve").split())
    for name, known in MATERIALS.items():
        assert "".join(f"{name} holds for {known.time_scale}. Source: {known.source}".split()) in said
    assert all(law in said for law in LAWS)


@pytest.mark.parametrize("command", ["simulate", "demo", "effects", "benchmarks robust", "benchmarks live"])
def test_help_of_other_commands_names_tissues_and_docs_page(command: str, capsys: pytest.CaptureFixture) -> None:
    said = help_on_tissue(capsys, *command.split())
    words = " ".join(said.replace("-\n", "-").split())
    assert len(said.splitlines()) <= 10 and "docs/notes/tissue.md" in words
    assert all(name in "".join(said.split()) for name in (*MATERIALS, *LAWS))


@pytest.mark.parametrize(
    ("young", "doubted"), [(99.0, "is below 100,"), (101.0, ""), (9.9e5, ""), (1.1e6, "above 1e+06")]
)
def test_implausible_stiffness_gives_a_warning(young, doubted):
    assert doubted in (said := check_stiffness(BRAIN.replace_constants(young))) and bool(said) == bool(doubted)
    if doubted:
        with pytest.warns(UserWarning, match=doubted.replace("+", r"\+")):
            asked("--young", str(young))
