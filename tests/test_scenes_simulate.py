"""Command that solves loads: selected element, bodies without tumour, quadratic anatomies."""

import numpy as np
import pytest
from boxes import quadratic
from conftest import make_box
from programs import simulated
from theatres import small

from scenes.cli import main
from sim.accuracy import TRAIN
from sim.anatomy import Anatomy
from sim.effects import Elasticity
from sim.fem import Fem
from surrogate.data.dataset import read_dataset


@pytest.fixture(scope="module")
def body() -> Anatomy:
    return make_box(cells=(6, 6, 4), spacing=12e-3, tumour=14e-3)


@pytest.mark.parametrize("element", ["p1", "p2", "smoothed"])
def test_simulate_uses_and_states_the_given_element(body, tmp_path, capsys, element) -> None:
    data = read_dataset(simulated(body, tmp_path, "--element", element))
    assert data.provenance["element"] == element and data.good.all()
    effects = (Elasticity(), *(effect for effect in small().effects if not isinstance(effect, Elasticity)))
    truth = Fem(body, effects, TRAIN, "cpu", element=element).deform(data.loads).displacement
    stored = data.read_displacement(np.arange(len(body.mesh.nodes)))
    assert np.linalg.norm(stored - truth) < 1e-3 * np.linalg.norm(truth)
    # The same command goes on where it stopped; with another element it would mix two sets.
    other = "p1" if element != "p1" else "smoothed"
    again = ["simulate", str(tmp_path / "body.vtu"), "--out", str(tmp_path / "data.h5"), "--count", "2"]
    assert main([*again, "--device", "cpu", "--element", other]) == 2
    assert f"element {element}, but now element is {other}" in capsys.readouterr().err


def test_simulate_warns_of_body_without_tumour(tmp_path, capsys) -> None:
    simulated(make_box(cells=(6, 6, 4), spacing=12e-3, tumour=0.0), tmp_path)
    assert "has no tumour: `sulcus train` will reject the data." in capsys.readouterr().err


def test_simulate_keeps_quadratic_anatomy_and_uses_p2(body, tmp_path, capsys) -> None:
    mesh = quadratic(body.mesh)
    more = len(mesh.nodes) - len(body.mesh.nodes)
    wall = mesh.nodes[:, 2] < body.mesh.nodes[:, 2].min() + 1e-9
    held = np.repeat(wall[:, None], 3, axis=1)
    anatomy = Anatomy(mesh, held, np.zeros_like(mesh.nodes), np.append(body.craniotomy, np.zeros(more, bool)))
    data = read_dataset(simulated(anatomy, tmp_path))
    assert data.provenance["element"] == "p2" and data.anatomy.digest == anatomy.digest
    assert data.read_displacement(anatomy.tumour_nodes).shape == (2, len(anatomy.tumour_nodes), 3) and data.good.all()
    assert len(anatomy.tumour_nodes) > len(body.tumour_nodes)
    capsys.readouterr()
    assert main(["simulate", str(tmp_path / "body.vtu"), "--out", str(tmp_path / "no.h5"), "--element", "p1"]) == 2
    assert "use p2" in capsys.readouterr().err and not (tmp_path / "no.h5").exists()
