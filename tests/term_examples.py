"""Every term, with load cases and states in which the conformance suite meets it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from boxes import base_held, box
from oracle import EVERY_LAW, tissue
from tiny_terms import Spring, Wall

from sim.compile import compile_problem
from sim.discretisation.space import discretise
from sim.discretisation.term import Cases, Term
from sim.effects import Elasticity, Gravity, Held, Inertia, NodalForce, Pulsation, ToolForce, Wave
from sim.loads import Loads, Nodal, Posture, Pushed
from sim.runtime.device import Device
from sim.runtime.user_script import run_script
from sim.terms.contact.skull_contact import Skull
from sim.terms.contact.skull_surface import Bone

VEINS = run_script(Path(__file__).parents[1] / "examples/veins.py")
MESH = box((2, 2, 2), 0.1, distortion=0.15)
ANATOMY = base_held(MESH)
ROWS = MESH.nodes.size
RNG = np.random.default_rng(11)


@dataclass(frozen=True)
class Example:
    """A term to test, with three load cases and the states (3N, 3) [m] at which they are met.

    `nodes` (N, 3) are the element's; `noise` [m] is how far `u` moves them. `bounded`: the term is infinite beyond a
    limit; `walled`: it goes on beyond one, and steps stop there all the same, and what stands in for its curvature at
    rest is definite; `flung` is a motion (3N, 3) that passes it. `crushed` (3N,) is a state where the
    plain curvature may be indefinite.
    """

    build: Callable[[Device], Term]
    cases: Cases
    bounded: bool = False
    nodes: np.ndarray = field(default_factory=lambda: MESH.nodes)
    noise: float = 4e-3
    walled: bool = False

    @property
    def rows(self) -> int:
        """3N."""
        return self.nodes.size

    @cached_property
    def u(self) -> np.ndarray:
        return self.noise * np.random.default_rng(12).normal(size=(self.rows, 3))

    @property
    def flung(self) -> np.ndarray:
        """Up through the wall, and inside out."""
        mirrored = self.nodes * [0.0, 0.0, -3.0]
        return np.outer(0.3 * np.sin(37.0 * np.arange(self.rows)) + 0.2 + mirrored.ravel(), [1.0, 0.9, 2.0])

    @property
    def crushed(self) -> np.ndarray:
        return (self.nodes * [0.15, 0.15, -0.55]).ravel()


def of_effects(*effects: object) -> Callable[[Device], Term]:
    def build(device: Device) -> Term:
        terms = compile_problem([Elasticity(), Held(), *effects], ANATOMY, device).terms  # pyright: ignore
        return terms[-1]

    return build


def cases() -> Cases:
    forces = Nodal(RNG.normal(size=(3, len(MESH.nodes), 3)))
    pushes = Pushed(np.full((3, 3), [0.05, 0.05, 0.1]), RNG.normal(size=(3, 3)), np.array([0.01, 0.02, 0.03]))
    memory = {name: 1e-3 * RNG.normal(size=(3, len(MESH.nodes), 3)) for name in ("spring", "inertia")}
    start = 1e-3 * RNG.normal(size=(3, len(MESH.nodes), 3))
    return Cases(Loads((forces, pushes), np.array([1.0, 2.0, 3.0])), np.array([0.5, 0.0, 2.9]), memory, start)


def postures() -> Cases:
    directions = np.array([[0.6, -0.3, 0.5], [0.0, 0.0, -1.0], [-1.0, 2.0, 0.1]])
    lying = Posture(directions, np.array([-0.05, 0.03, -0.01]), np.array([0.5, -1.0, 2.0]))
    return Cases(Loads((lying,)), np.zeros(3))


LOGARITHMIC = ("neo-hookean", "ogden")
PARTS = ("shape", "volume")


def of_law(law: str, element: str = "p1", part: int = 0) -> Example:
    """The elasticity of a law; smoothed elements have two, of shape and of volume."""
    effects, space = (Elasticity(tissue(law)), Held()), discretise(MESH, element)

    def build(device: Device) -> Term:
        return compile_problem(effects, ANATOMY, device, space).terms[part]

    return Example(build, cases(), law in LOGARITHMIC, space.nodes, 1e-3 if element == "p2" else 4e-3)


def skull() -> Example:
    """A round wall about the top of the box, that some of its nodes feel and some do not; it ends among them."""
    top = np.flatnonzero(MESH.nodes[:, 2] > MESH.nodes[:, 2].max() - 1e-9)
    normal = MESH.nodes[top] - [0.05, 0.05, -0.02]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    bend = (np.eye(3) - normal[:, :, None] * normal[:, None, :]) / 0.12

    way = np.linspace(-1.0, 1.0, len(top))[:, None] * [0.8, 0.6, 0.0]
    felt, area = np.linspace(5e-3, 7e-3, len(top)), np.linspace(1e-3, 2e-3, len(top))
    bone = Bone(top, normal, bend, np.linspace(-8e-3, 1e-3, len(top)), way, felt, area, gap=6e-3, edge_radius=5e-3)

    def build(device: Device) -> Term:
        return Skull(bone, ROWS // 3, 1000.0, device)

    return Example(build, Cases(Loads((), np.zeros(3)), np.zeros(3)), noise=1e-3, walled=True)


RELAXES = ("neo-hookean", "stable-neo-hookean", "ogden")
SERIES = ((0.3, 0.4), (0.4, 3.0))
STRONG = Pulsation(Wave(1.0, 0.2), Wave(0.2, 0.05))


def relaxing(law: str, element: str = "p1", *effects: object) -> Example:
    """A viscoelastic law amid its memory; the first case is a body at rest so far, at once."""
    space = discretise(MESH, element)
    tissues = replace(tissue(law), prony=SERIES)
    part = space.build_elements(np.ones(len(MESH.tets), bool))[0]
    points = part.elements.weight.size
    name = f"viscoelasticity {law}" + ("" if part.portion == "whole" else f" of {part.portion}")
    past = 50.0 * np.random.default_rng(14).normal(size=(3, points, 18)) * np.array([0.0, 1.0, 1.0])[:, None, None]

    def build(device: Device) -> Term:
        return compile_problem((Elasticity(tissues), Held(), *effects), ANATOMY, device, space).terms[0]  # pyright: ignore

    cases = Cases(Loads((), np.array([0.0, 1.7, 3.1])), np.array([0.0, 1.0, 3.099]), {name: past})
    return Example(build, cases, law in LOGARITHMIC, space.nodes, 1e-3 if element == "p2" else 4e-3)


def swelling(law: str, element: str = "p1", part: int = 0) -> Example:
    """A law that swells and shrinks by a fifth; in the first case not yet."""
    space, effects = discretise(MESH, element), (Elasticity(tissue(law)), Held(), STRONG)

    def build(device: Device) -> Term:
        return compile_problem(effects, ANATOMY, device, space).terms[part]

    cases = Cases(Loads((), np.array([0.0, 0.2, 0.8])), np.zeros(3))
    return Example(build, cases, law in LOGARITHMIC, space.nodes, 1e-3 if element == "p2" else 4e-3)


EXAMPLES = (
    {law: of_law(law) for law in EVERY_LAW}
    | {f"{law} p2": of_law(law, "p2") for law in EVERY_LAW}
    | {f"{law} smoothed {part}": of_law(law, "smoothed", i) for law in EVERY_LAW for i, part in enumerate(PARTS)}
    | {f"relaxing {law}": relaxing(law) for law in RELAXES}
    | {f"relaxing neo-hookean {element}": relaxing("neo-hookean", element) for element in ("p2", "smoothed")}
    | {"relaxing and swelling ogden": relaxing("ogden", "p1", STRONG)}
    | {f"swelling {law}": swelling(law) for law in EVERY_LAW}
    | {"swelling linear p2": swelling("linear", "p2")}
    | {f"swelling neo-hookean smoothed {part}": swelling("neo-hookean", "smoothed", i) for i, part in enumerate(PARTS)}
    | {
        "nodal force": Example(of_effects(NodalForce()), cases()),
        "tool force": Example(of_effects(ToolForce()), cases()),
        "gravity": Example(of_effects(Gravity()), postures()),
        "inertia": Example(of_effects(Inertia(damping=3.0)), cases()),
        "skull contact": skull(),
        "veins": Example(of_effects(VEINS.Veins((1, 5, 20), 30.0, 4e-3)), cases()),
        "spring": Example(lambda device: Spring(device, ROWS, 7.0), cases()),
        "wall": Example(lambda device: Wall(device, MESH.nodes, 0.12, 0.03, 500.0), cases(), bounded=True),
    }
)
