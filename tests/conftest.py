"""A body that many tests share, and a deformer that answers in microseconds."""

import gc
import os
import threading
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest

from sim.anatomy import Anatomy
from sim.deformation import Deformation, Outcome
from sim.discretisation.footprint import compute_footprint_weights
from sim.geometry.tetmesh import TetMesh, orient_tetrahedra
from sim.loads import Nodal, Pushed
from surrogate.regressors.baselines import Ann

pytest_plugins = ["empty_comparisons", "expected_skips"]
# Files that take longest on two cores, with a few long tests each: begun last, they would leave a core idle at the end.
LONGEST = (
    "engine_kills", "cli", "check", "locating", "effects", "play", "docs", "wheel", "examples", "series", "sight",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    """Files of long tests come first, all others as they were."""

    def place(item):
        name = item.path.stem.removeprefix("test_").removeprefix("scenes_").removeprefix("surrogate_")
        return LONGEST.index(name) if name in LONGEST else len(LONGEST)

    items.sort(key=place)


def pytest_collection_finish():
    """What was imported and collected stays."""
    copy_to_host()


@pytest.fixture(scope="module")
def ours_alone():
    """What other tests left is not looked through: for tests that ask again and again what lives."""
    copy_to_host()


def copy_to_host():
    """No search for garbage walks again through what lives now."""
    gc.collect()
    gc.freeze()


def make_box(cells=(12, 12, 7), spacing=6e-3, tumour=10e-3, depth=22e-3, opening=25e-3):
    """A box with its top at z = 0: a disc of the top is open, the rest of the surface held, a tumour under the disc."""
    axes = [spacing * (np.arange(n + 1) - n / 2) for n in cells[:2]] + [spacing * np.arange(-cells[2], 1)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape([n + 1 for n in cells])
    corner = [
        number[i : cells[0] + i, j : cells[1] + j, k : cells[2] + k].ravel()
        for i in (0, 1)
        for j in (0, 1)
        for k in (0, 1)
    ]
    paths = [(0, 1, 3, 7), (0, 1, 5, 7), (0, 2, 3, 7), (0, 2, 6, 7), (0, 4, 5, 7), (0, 4, 6, 7)]
    tets, _ = orient_tetrahedra(nodes, np.concatenate([np.stack([corner[c] for c in path], axis=1) for path in paths]))
    inside = np.linalg.norm(nodes[tets].mean(axis=1) + [0.0, 0.0, depth], axis=1) < tumour
    mesh = TetMesh(nodes, tets, np.where(inside, 2, 1))
    surface = np.zeros(len(nodes), bool)
    surface[mesh.surface] = True
    opened = surface & (np.linalg.norm(nodes, axis=1) < opening)
    return Anatomy(mesh, np.repeat((surface & ~opened)[:, None], 3, axis=1), np.zeros_like(nodes), opened)


@dataclass(frozen=True, eq=False)
class Pretender:
    """A Deformer by formula: Kelvin's solution, softer the smaller the force; fails above a force."""

    anatomy: Anatomy
    fails_above: float = np.inf

    @cached_property
    def _loaded(self):
        return np.flatnonzero(self.anatomy.craniotomy)

    @cached_property
    def _kelvin(self):
        """(V, m, 3, 3) [m/N] from the open nodes to every node."""
        arm = self.anatomy.mesh.nodes[:, None] - self.anatomy.mesh.nodes[self._loaded]
        length = np.sqrt(np.einsum("vmi,vmi->vm", arm, arm) + (4e-3) ** 2)[:, :, None, None]
        return (np.eye(3) / length + arm[..., :, None] * arm[..., None, :] / length**3) / (8.0 * np.pi * 1000.0)

    def deform(self, loads, start=None, at=None):
        mesh = self.anatomy.mesh
        pushed, nodal = loads.get(Pushed), loads.get(Nodal)
        force = np.zeros((len(loads), len(mesh.nodes), 3)) if nodal is None else nodal.force
        if pushed is not None:
            weights = compute_footprint_weights(mesh.nodes, mesh.surface, pushed.point, pushed.footprint).toarray()
            force = force + weights[:, :, None] * pushed.force[:, None]
        size = np.linalg.norm(force.sum(axis=1), axis=1)
        linear = np.einsum("vmij,bmj->bvi", self._kelvin, force[:, self._loaded], optimize=True)
        # Shallow nodes soften more than deep ones: no linear map and no common factor reproduces it.
        shape = np.exp(mesh.nodes[:, 2] / 30e-3)
        displacement = linear / (1.0 + size[:, None] * shape)[:, :, None]
        good = size <= self.fails_above
        answer = Deformation(
            displacement,
            np.arange(len(mesh.nodes)),
            tuple(Outcome.CONVERGED if fine else Outcome.BUDGET for fine in good),
            np.where(good, 4, 60),
            np.where(good, 1e-5, 1e-2),
            loads.times,
            np.zeros((len(loads), 0, 6)),
        )
        return answer if at is None else answer.restrict(at)


@pytest.fixture(scope="session", autouse=True)
def shared(tmp_path_factory):
    """Where processes of one run keep what each of them would make anew; nowhere if there is but one."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        os.environ["SULCUS_TESTS_SHARED"] = str(tmp_path_factory.getbasetemp().parent)


@pytest.fixture(scope="session")
def box():
    return make_box()


@pytest.fixture(scope="session")
def small_box():
    """Half as large, for commands that solve for a body many times."""
    return make_box((9, 9, 5), opening=20e-3, depth=18e-3)


@pytest.fixture(scope="session")
def pretender(box):
    return Pretender(box)


@pytest.fixture(scope="module")
def theatre(box):
    from theatres import theatre_of

    return theatre_of(box)


@pytest.fixture(scope="module")
def stage():
    from theatres import find_scene, template_theatre

    return template_theatre().build_stage(find_scene("palpate"))


@pytest.fixture(scope="module")
def follower(stage):
    from films import follower_of

    return follower_of(stage)


@pytest.fixture(scope="module")
def patch(box):
    from surrogate.data.cortex_patch import open_patch

    return open_patch(box)


@pytest.fixture(scope="module")
def device():
    from sim.runtime.device import find_device

    return find_device("cpu", "float64")


@pytest.fixture(scope="module")
def short_fits():
    """Networks are fitted in 120 steps, not in 1000: they are less exact, and nothing else."""
    fit = Ann.fit
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(
            Ann, "fit", lambda ann, X, Y: fit(replace(ann, max_iterations=min(ann.max_iterations, 120)), X, Y)
        )
        yield


@pytest.fixture(scope="module")
def truth(stage):
    from films import solve_reference_frames

    return solve_reference_frames(stage)


@pytest.fixture(scope="module")
def registration():
    from films import FILM

    from scenes.tracked.registration_file import read_registration

    return read_registration(FILM / "registration.json")


@pytest.fixture(scope="module")
def beside(follower, truth):
    """T_reference_cube (4, 4) [mm] of the film's poses, as a tracker would send it."""
    from links import in_mm

    return in_mm(follower.registration.T_patient_scan @ truth.T_scan_tool @ np.linalg.inv(follower.tool.T_cube_tool))


@pytest.fixture
def scene():
    """Two seconds, of which the first half presses harder and harder; cheap frames, quickly."""
    from theatres import small

    from scenes.script.tool_paths import press

    return small(path=press(0.3, rise=1.0, hold=1.0), duration=2.0, frames_per_second=60.0)


@pytest.fixture
def demo(theatre, scene):
    from visitor import free_port, wait_for

    from scenes.page.demo import Demo

    before = set(threading.enumerate())
    demo = Demo(theatre, scene, "linear", "127.0.0.1", free_port())
    yield demo
    demo.close()
    assert wait_for(lambda: not [t for t in set(threading.enumerate()) - before if t.name in ("page", "fem", "busy")])


@pytest.fixture(scope="module")
def study_box():
    return make_box((6, 6, 4), tumour=9e-3, depth=14e-3, opening=20e-3)


@pytest.fixture(scope="module")
def study(tmp_path_factory, study_box):
    from studies import study_of

    return study_of(tmp_path_factory.mktemp("report"), study_box, 280)


@pytest.fixture(scope="module")
def study_rows(study):
    from studies import SPECS

    from scenes.report.rows import measure_row, measure_rows

    return tuple(measure_rows(study, SPECS, measure_row))


@pytest.fixture(scope="module")
def site(box):
    from scenes.script.craniotomy_frame import build_craniotomy_frame

    return build_craniotomy_frame(box)


@pytest.fixture(scope="module")
def box_folder(box, tmp_path_factory):
    """A folder of box.vtu and its models."""
    from theatres import put, theatre_of

    folder = tmp_path_factory.mktemp("box")
    put(theatre_of(box), folder / "box.vtu")
    return folder


@pytest.fixture(scope="module")
def template():
    from theatres import template_theatre

    return template_theatre()


@pytest.fixture(scope="module", params=["linear", "svr", "fem"])
def play(request, theatre):
    from theatres import player, small

    return player(theatre, small(), request.param)


@pytest.fixture(scope="module")
def still(box):
    """An observer and the body at rest, with errors as they are by default, and many points."""
    from scenes.play.deformers import PatientSetup
    from scenes.play.observer import PointObserver
    from scenes.script.observation_models import PointObservation

    return PointObserver(PatientSetup(box, None, {}, "cpu").site, None, PointObservation(points=400)), box.mesh.nodes


@pytest.fixture(scope="session")
def warp_folder(tmp_path_factory, box):
    from warped import write_warp

    folder = tmp_path_factory.mktemp("warp")
    write_warp(folder, box)
    return folder


@pytest.fixture(scope="session")
def warp_out(warp_folder):
    return warp_folder / "out"


@pytest.fixture(scope="module")
def boxed(box, tmp_path_factory):
    """The box as a file."""
    from sim.bodies.meshfile import write_anatomy

    path = tmp_path_factory.mktemp("box") / "box.vtu"
    write_anatomy(path, box)
    return str(path)


@pytest.fixture(scope="module")
def body():
    """A small box in a skull."""
    from locators import in_a_skull

    return in_a_skull()


@pytest.fixture(scope="module")
def folder(box, tmp_path_factory):
    """Episodes of 7 and 9 frames; of the second every third frame was solved."""
    from tiny_episodes import Wanted, write_episode

    folder = tmp_path_factory.mktemp("set")
    write_episode(folder / "episode_000000.h5", box, Wanted(7))
    write_episode(folder / "episode_000001.h5", box, Wanted(9, every=3, seed=1, family="slide"))
    return folder


@pytest.fixture(scope="module")
def whole(box, tmp_path_factory):
    from tiny_episodes import Wanted, write_episode

    return write_episode(tmp_path_factory.mktemp("whole") / "episode_000000.h5", box, Wanted(7, every=2))
