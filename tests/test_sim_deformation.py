"""Warm data of a result only speed up the next solution: without them the results are the same."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box
from openings import EFFECTS, body, loads_of

from sim.accuracy import Accuracy
from sim.bodies.open_cortex import open_cortex
from sim.deformation import Deformation, join_deformations
from sim.effects import Elasticity, Held, Inertia, ToolContact, ToolForce
from sim.fem import Fem
from sim.loads import Loads, Touching, push
from sim.material import Material
from sim.tools import Ball

FINE = Accuracy(1e-7)
BOX = make_box(cells=(5, 5, 3), spacing=14e-3, tumour=18e-3, depth=20e-3, opening=40e-3)
RELAXING = Material("neo-hookean", 3000.0, 0.45, ((0.4, 0.5),))
FRAMES = 4


def ride(fem: Fem, loads: list[Loads], drops: bool) -> list[Deformation]:
    answers: list[Deformation] = []
    for load in loads:
        last = answers[-1] if answers else None
        answers.append(fem.deform(load, replace(last, warm={}) if drops and last else last))
    return answers


def cases() -> dict[str, tuple[Fem, list[Loads]]]:
    steps = 0.1 * np.arange(1, FRAMES + 1)
    place = open_cortex(BOX).place(0.0, 0.0)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1, 1))
    deep = (np.array([1.0, 2.0, 2.5, 1.5]) * 1e-3)[:, None]
    poses[:, 0, :3, 3] = place.point + place.inward * (deep - 9e-3)
    pushes = [
        push(np.array([2e-3 * f, 0.0, 0.0]), np.array([0.0, 0.02, -0.1 - 0.03 * f]), 12e-3) for f in range(FRAMES)
    ]
    timed = [Loads(load.causes, steps[[f]]) for f, load in enumerate(pushes)]
    touched = [Loads((Touching(poses[[f]]),)) for f in range(FRAMES)]
    opened = [loads_of(share * np.array([[0.1, 0.05, -0.3]])) for share in (0.5, 0.8, 1.0, 0.9)]
    plain = (Elasticity(), Held(), ToolForce())
    return {
        "p1": (Fem(BOX, plain, FINE, "cpu", element="p1"), pushes),
        "smoothed": (Fem(BOX, plain, FINE, "cpu", element="smoothed"), pushes),
        "p2": (Fem(BOX, plain, FINE, "cpu", element="p2"), pushes[:2]),
        "patch": (Fem(body()[0], (Elasticity(), *EFFECTS), FINE, "cpu", element="p1", live=True), opened),
        "contact": (Fem(BOX, (Elasticity(), Held(), ToolContact((Ball(9e-3),))), FINE, "cpu", element="p1"), touched),
        "relaxing": (Fem(BOX, (Elasticity(RELAXING), *plain[1:]), FINE, "cpu", element="p1"), timed),
        "inertia": (Fem(BOX, (*plain, Inertia()), FINE, "cpu", element="p1"), timed),
    }


@pytest.mark.parametrize("kind", ["p1", "smoothed", "p2", "patch", "contact", "relaxing", "inertia"])
def test_results_without_warm_data_are_the_same(kind):
    fem, loads = cases()[kind]
    kept, dropped = (ride(fem, loads, drops) for drops in (False, True))
    assert all(answer.outcome[0].good for answer in (*kept, *dropped))
    assert kind == "contact" or any(answer.warm for answer in kept[:-1])  # Newton leaves nothing
    largest = max(np.abs(answer.displacement).max() for answer in kept)
    for one, other in zip(kept, dropped, strict=True):
        np.testing.assert_allclose(other.displacement, one.displacement, atol=2e-5 * largest)
        assert set(one.memory) == set(other.memory)
        for name, value in one.memory.items():
            np.testing.assert_allclose(other.memory[name], value, atol=1e-4 * max(np.abs(value).max(), 1e-12))


def test_memory_and_warm_data_follow_selected_rows():
    fem, loads = cases()["p1"]
    first, second = ride(fem, loads[:2], drops=False)
    both = join_deformations([second, second])
    assert set(both.warm) == set(second.warm) and all(len(value) == 2 for value in both.warm.values())
    again = both.select(np.array([1]))
    np.testing.assert_array_equal(fem.deform(loads[2], again).displacement, fem.deform(loads[2], second).displacement)
    assert not join_deformations([first, replace(second, warm={})]).warm
