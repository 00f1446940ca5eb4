"""Contact of rigid tools against the literature (Hertz, flat punch) and under rotation of the observer."""

import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from boxes import base_held, box, hold
from scipy.spatial.transform import Rotation

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.deformation import Deformation, Outcome, build_start
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, Retraction, ToolContact
from sim.fem import Fem
from sim.geometry.tetmesh import MeshWarning, TetMesh
from sim.loads import Loads, Retracted, Touching
from sim.material import Material
from sim.tools import Ball, Capsule, Spatula, Tool

ROCK = Material("linear", 3000.0, 0.3)
PLANE_MODULUS = ROCK.young / (1.0 - ROCK.poisson**2)
SMALL = 1e-3  # of the contact's half width [m]
SOFT = Material("neo-hookean", 3000.0, 0.45)
SIDE, HEIGHT = 0.06, 0.03
BLOCK = base_held(box((6, 6, 3), SIDE))
TIGHT = Accuracy(tolerance=1e-9)


def coordinates(finest: float, growth: float, far: float, fine_to: float = 0.0) -> np.ndarray:
    """0, then steps of the finest up to `fine_to`, growing beyond until `far`."""
    out, step = [0.0], finest
    while out[-1] < far:
        out.append(out[-1] + step)
        step *= growth if out[-1] > fine_to - 1e-12 else 1.0
    return np.array(out)


def quarter(x: np.ndarray, z: np.ndarray) -> Anatomy:
    """A quarter of a block under z = 0, of these coordinates along x and y and downwards: symmetric, its foot held."""
    n, m = len(x) - 1, len(z) - 1
    cubes = box((n, n, m), 1.0)
    i, j, k = np.rint(cubes.nodes.T * max(n, m)).astype(int)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MeshWarning)  # far from the tool cells are flat
        mesh = TetMesh(np.column_stack([x[i], x[j], -z[m - k]]), cubes.tets, cubes.region)
    held = np.column_stack([i == 0, j == 0, np.zeros(len(i), bool)]) | (k == 0)[:, None]
    return hold(mesh, held)


def at(*place: float, turn: np.ndarray | None = None) -> np.ndarray:
    """T_world_tool (4, 4) at a place [m]."""
    T = np.eye(4)
    T[:3, 3] = place
    T[:3, :3] = np.eye(3) if turn is None else turn
    return T


def touching(*poses: np.ndarray) -> Loads:
    """One load case of these tools' poses (4, 4)."""
    return Loads((Touching(np.stack(poses)[None]),))


def force_on(anatomy: Anatomy, tool: Tool, depth: float, gap: float) -> float:
    """What the tool presses the whole of a quartered block with [N], so deep."""
    effects = [Elasticity(ROCK), Held(), ToolContact((tool,), gap)]
    fem = Fem(anatomy, effects, Accuracy(tolerance=1e-3), "cpu", element="smoothed")
    found = fem.deform(touching(at(0.0, 0.0, -depth)))
    assert found.outcome[0].good
    return -4.0 * float(found.reaction[0, 0, 2])


def test_ball_force_agrees_with_hertz() -> None:
    """F = 4/3 E* sqrt(R) d^(3/2): Johnson 1985, "Contact Mechanics", equation 4.23. Within 5 %, from above, nearing."""
    radius, depth = 10.0 * SMALL, 0.1 * SMALL
    exact = 4.0 / 3.0 * PLANE_MODULUS * np.sqrt(radius) * depth**1.5
    off = []
    for across in (2, 4):
        x = coordinates(SMALL / across, 1.6, 40.0 * SMALL, 1.5 * SMALL)
        off.append(force_on(quarter(x, x), Ball(radius), depth, 5e-7) / exact - 1.0)
    assert 0.0 < off[1] < 0.05
    assert off[1] < 0.6 * off[0]


def test_flat_punch_force_agrees_with_king() -> None:
    """F = 1.012 (2 / sqrt(pi)) E* w d of a square: King 1987, Int. J. Solids Struct. 23:1657-1664. Within 5 %, falling.

    Its pressure is singular at the edges, which need cells that are small beside them.
    """
    width, depth = 2.0 * SMALL, 0.04 * SMALL
    exact = 1.012 * 2.0 / np.sqrt(np.pi) * PLANE_MODULUS * width * depth
    off = []
    for finest in (0.2 * SMALL, 0.07 * SMALL):
        out = coordinates(finest, 1.8, 60.0 * SMALL)
        inner = SMALL - out[(out > 0.0) & (out < SMALL)][::-1]
        x = np.concatenate([[0.0], inner[1:], SMALL + out])
        off.append(force_on(quarter(x, out), Spatula(width, width, 0.02 * width), depth, 1e-6) / exact - 1.0)
    assert 0.0 < off[1] < 0.05
    assert off[1] < 0.7 * off[0]


@cache
def body(tools: tuple[Tool, ...], element: str = "p1", law: str = "neo-hookean", turn: bool = False) -> Fem:
    anatomy = turned(BLOCK) if turn else BLOCK
    return Fem(anatomy, [Elasticity(replace(SOFT, law=law)), Held(), ToolContact(tools)], TIGHT, "cpu", element=element)


TURN = Rotation.from_euler("xyz", [0.7, -1.1, 2.3]).as_matrix()
SHIFT = np.array([0.3, -0.2, 0.1])


def turned(anatomy: Anatomy) -> Anatomy:
    mesh = anatomy.mesh
    return hold(TetMesh(mesh.nodes @ TURN.T + SHIFT, mesh.tets, mesh.region), anatomy.fixed)


BALL, ROD, BLADE = Ball(6e-3), Capsule(3e-3, 0.02), Spatula(0.012, 0.02, 1.5e-3)
TILT = Rotation.from_euler("xyz", [0.3, -0.2, 0.5]).as_matrix()
BESIDE, AWAY = at(0.018, 0.03, HEIGHT - 3e-3), at(0.042, 0.032, HEIGHT - 2e-3, turn=TILT)


def test_rotation_of_body_and_tools_rotates_the_result() -> None:
    """Displacements, forces and moments rotate with the observer."""
    loads = touching(BESIDE, AWAY)
    found = body((BALL, BLADE)).deform(loads)
    T = at(*SHIFT, turn=TURN)
    seen = body((BALL, BLADE), turn=True).deform(touching(T @ BESIDE, T @ AWAY))
    assert found.outcome[0].good
    assert seen.outcome[0].good
    size = np.abs(found.displacement).max()
    np.testing.assert_allclose(seen.displacement[0], found.displacement[0] @ TURN.T, atol=1e-6 * size)
    for part in (slice(0, 3), slice(3, 6)):
        expected = found.reaction[0, :, part] @ TURN.T
        np.testing.assert_allclose(seen.reaction[0, :, part], expected, atol=1e-5 * np.abs(expected).max())


def test_rotation_about_symmetry_axis_has_no_effect() -> None:
    spun = BESIDE @ at(0.0, 0.0, 0.0, turn=Rotation.from_rotvec([0.0, 0.0, 1.3]).as_matrix())
    for tool in (BALL, ROD):
        one, other = body((tool,)).deform(touching(BESIDE)), body((tool,)).deform(touching(spun))
        np.testing.assert_allclose(one.displacement, other.displacement, atol=1e-9)
        assert np.abs(one.reaction[0, 0, 3:]).max() < 0.1 * HEIGHT * np.linalg.norm(one.reaction[0, 0, :3])


def test_ball_has_no_moment_about_its_centre() -> None:
    """Without friction every force passes through the centre: the moment about the origin is that of this force."""
    pose = at(0.031, 0.028, HEIGHT - 3e-3, turn=TILT)
    force, moment = np.split(body((BALL,)).deform(touching(pose)).reaction[0, 0], 2)
    middle = BALL.radius * pose[:3, 2]
    np.testing.assert_allclose(moment, np.cross(middle, force), atol=0.05 * BALL.radius * np.linalg.norm(force) * 1e-3)
    assert np.linalg.norm(np.cross(middle, force)) > 1e-3 * BALL.radius * np.linalg.norm(force)


def test_displacement_by_contact_is_independent_of_stiffness() -> None:
    """Twice the stiffness gives the same displacement and twice the force."""
    stiff = Fem(
        BLOCK,
        [Elasticity(replace(SOFT, young=2.0 * SOFT.young)), Held(), ToolContact((BALL,))],
        TIGHT,
        "cpu",
        element="p1",
    ).deform(touching(BESIDE))
    found = body((BALL,)).deform(touching(BESIDE))
    np.testing.assert_allclose(stiff.displacement, found.displacement, atol=1e-7 * np.abs(found.displacement).max())
    np.testing.assert_allclose(stiff.reaction, 2.0 * found.reaction, atol=1e-6 * np.abs(stiff.reaction).max())


def test_contact_forces_never_pull_on_tissue() -> None:
    """The force on every node near a blade points away from it: down or sideways, never up."""
    fem = body((BLADE,))
    found = fem.deform(touching(BESIDE))
    term = fem.problem.barriers[0]
    u = fem.problem.device.upload(fem.guess(touching(BESIDE), found))
    gradient = fem.problem.device.allocate(*u.shape)
    term.begin(Cases(touching(BESIDE), np.zeros(1)))
    term.add_gradient(u, gradient)
    force = -gradient.numpy().reshape(-1, 3)
    felt = np.abs(force).max(axis=1) > 0.0
    assert felt.sum() > 4
    np.testing.assert_allclose(force.sum(axis=0), found.reaction[0, 0, :3], rtol=1e-12)
    assert force[:, 2].max() <= 0.0


def test_effects_of_distant_tools_add_up() -> None:
    """Small motions of a linear body: forces and displacements of both tools are the sum of each."""
    rock = Fem(BLOCK, [Elasticity(ROCK), Held(), ToolContact((BALL, BLADE), 2e-5)], TIGHT, "cpu", element="p1")
    off = at(0.0, 0.0, 10.0 * HEIGHT)
    left, right = at(0.01, 0.03, HEIGHT - 1e-4), at(0.05, 0.03, HEIGHT - 1e-4)
    both, one, other = (rock.deform(touching(*poses)) for poses in ((left, right), (left, off), (off, right)))
    assert not one.reaction[0, 1].any()
    assert not other.reaction[0, 0].any()
    summed = one.displacement + other.displacement
    assert np.linalg.norm(both.displacement - summed) < 0.03 * np.linalg.norm(summed)
    np.testing.assert_allclose(both.reaction, one.reaction + other.reaction, atol=0.05 * np.abs(both.reaction).max())


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_tool_without_contact_causes_no_displacement(precision: str) -> None:
    """From rest, and lifted after contact: exactly zero."""
    accuracy = Accuracy(tolerance=1e-4, precision=precision)  # pyright: ignore[reportArgumentType]
    fem = Fem(BLOCK, [Elasticity(SOFT), Held(), ToolContact((BALL,))], accuracy, "cpu", element="p1")
    clear = touching(at(0.03, 0.03, HEIGHT + 1.01e-4))
    assert not fem.deform(clear).displacement.any()
    pressed = fem.deform(touching(BESIDE))
    assert pressed.displacement.any()
    lifted = fem.deform(clear, pressed)
    assert lifted.outcome == (Outcome.CONVERGED,)
    assert not lifted.displacement.any()
    assert not lifted.reaction.any()


def test_retractor_agrees_with_contact_tool_after_same_motion() -> None:
    laid, drawn = at(0.03, 0.03, HEIGHT + 1e-3), np.array([2e-3, 0.0, -4e-3])
    retractor = Fem(BLOCK, [Elasticity(SOFT), Held(), Retraction(BLADE)], TIGHT, "cpu", element="p1")
    held = retractor.deform(Loads((Retracted(laid[None], drawn[None]),)))
    moved = laid.copy()
    moved[:3, 3] += drawn
    fem = body((BLADE,))
    pressed = fem.deform(touching(moved), fem.deform(touching(laid)))
    np.testing.assert_array_equal(held.displacement, pressed.displacement)
    np.testing.assert_array_equal(held.reaction, pressed.reaction)
    assert held.reaction[0, 0, 2] < -1e-3


def frames(fem: Fem, poses: list[np.ndarray], start: Deformation | None = None) -> list[Deformation]:
    found = []
    for pose in poses:
        start = fem.deform(touching(pose), start)
        found.append(start)
    return found


def test_contact_result_depends_only_on_loads_and_start() -> None:
    """Clients that alternate at one solver get the same bits as alone; a repetition gives the same bits."""
    fem = body((BALL,))
    ways = [[at(x, 0.03, HEIGHT - depth) for depth in (1e-3, 2e-3, 3e-3)] for x in (0.02, 0.04)]
    alone = [frames(fem, way) for way in ways]
    last: list[Deformation | None] = [None, None]
    for turn in range(3):
        for client, way in enumerate(ways):
            last[client] = one = fem.deform(touching(way[turn]), last[client])
            np.testing.assert_array_equal(one.displacement, alone[client][turn].displacement)
            np.testing.assert_array_equal(one.reaction, alone[client][turn].reaction)


def test_stored_result_is_an_equivalent_start(tmp_path: Path) -> None:
    """Displacement, time and memory are sufficient for the next frame."""
    fem, way = body((BALL,)), [at(x, 0.03, HEIGHT - 2e-3) for x in (0.02, 0.024, 0.028, 0.032)]
    straight = frames(fem, way)
    np.savez(tmp_path / "frame.npz", displacement=straight[1].displacement, **straight[1].memory)  # pyright: ignore[reportArgumentType]
    with np.load(tmp_path / "frame.npz") as file:
        read = {name: file[name] for name in file.files}
    again = replace(build_start(read.pop("displacement")), memory=read)
    size = np.abs(straight[-1].displacement).max()
    found = frames(fem, way[2:], again)[-1].displacement
    np.testing.assert_allclose(found, straight[-1].displacement, atol=1e-7 * size)
    warm = replace(again, warm=straight[1].warm)
    np.testing.assert_array_equal(frames(fem, way[2:], warm)[-1].displacement, straight[-1].displacement)


def test_many_small_contact_steps_agree_with_one_large_step() -> None:
    """A ball pressed straight down has one solution, independent of the path."""
    fem = body((BALL,))
    once = fem.deform(touching(at(0.03, 0.03, HEIGHT - 4e-3)))
    little = frames(fem, [at(0.03, 0.03, HEIGHT - depth) for depth in np.linspace(2e-4, 4e-3, 12)])[-1]
    size = np.abs(once.displacement).max()
    np.testing.assert_allclose(little.displacement, once.displacement, atol=1e-6 * size)
    np.testing.assert_allclose(little.reaction, once.reaction, atol=1e-5 * np.abs(once.reaction).max())
