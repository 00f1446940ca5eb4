"""Loads: invalid ones are rejected; selection of rows and scaling."""

from collections.abc import Callable

import numpy as np
import pytest
from boxes import base_held, box

from sim.accuracy import TRAIN
from sim.effects import Elasticity, Held, NodalForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Nodal, Prescribed, Pushed, push, stack

COUNT = 27
FORCE = np.array([[0.0, 0.0, -0.05], [0.02, -0.03, -0.3], [0.1, 0.0, -0.6], [0.0, 0.1, 0.2], [0.0, 0.0, -0.9]])
POINT = np.array([[0.05, 0.05, 0.1], [0.04, 0.06, 0.1], [0.07, 0.05, 0.1], [0.05, 0.03, 0.1], [0.06, 0.06, 0.1]])
LOADS = push(POINT, FORCE, 0.02)


def test_loads_without_or_with_repeated_causes_are_rejected() -> None:
    with pytest.raises(InputError, match="causes none"):
        Loads(())
    with pytest.raises(InputError, match="each kind but Pushed once"):
        Loads((Nodal(np.zeros((5, COUNT, 3))),) * 2)


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: push(POINT, np.where(FORCE == 0.1, np.nan, FORCE), 0.02), r"Pushed\.force .*finite"),
        (lambda: push(POINT, FORCE, 0.0), "positive radii"),
        (lambda: push(POINT, FORCE, -0.01), "positive radii"),
        (lambda: Loads((Pushed(POINT, FORCE[:2], np.full(5, 0.01)),)), r"\[2, 5\] rows"),
        (lambda: Loads((Pushed(POINT[:, :2], FORCE, np.full(5, 0.01)),)), r"point has shape \(5, 2\)"),
        (lambda: Loads((Nodal(np.zeros((COUNT, 3))),)), r"Nodal\.force has shape"),
        (lambda: Loads((Nodal(np.zeros((5, COUNT, 3))),), np.zeros(4)), r"\[4, 5\] rows"),
        (lambda: Loads(()), "at least one, or a time"),
        (lambda: Loads((), np.array([0.1, np.nan])), r"Loads\.time .*finite"),
        (lambda: Loads((), np.array(0.1)), r"Loads\.time has shape \(\)"),
    ],
)
def test_invalid_numbers_in_loads_are_rejected(build: Callable[[], Loads], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        build()


def test_nodal_field_of_another_mesh_is_rejected() -> None:
    body = Fem(base_held(box((2, 2, 2))), [Elasticity(), Held(), NodalForce()], TRAIN, "cpu", element="p1")
    with pytest.raises(InputError, match=rf"Nodal.force has 8 vertices, but the mesh has {COUNT}"):
        body.deform(Loads((Nodal(np.zeros((1, 8, 3))),)))
    with pytest.raises(InputError, match=r"Prescribed\.displacement has 8 vertices"):
        body.deform(Loads((Prescribed(np.zeros((1, 8, 3))),)))


def test_loads_may_consist_of_times_only() -> None:
    later = Loads((), np.array([0.1, 0.2]))
    both = stack([later, later.select(np.array([1])).scale(0.5)])
    np.testing.assert_array_equal(both.times, [0.1, 0.2, 0.2])
    body = Fem(base_held(box((2, 2, 2))), [Elasticity(), Held(), NodalForce()], TRAIN, "cpu", element="p1")
    np.testing.assert_array_equal(body.deform(both).displacement, 0.0)


def test_loads_are_scaled_and_selected_by_row() -> None:
    half = LOADS.scale(0.5).get(Pushed)
    each = LOADS.scale(np.arange(5.0)).select(np.array([3])).get(Pushed)
    assert half is not None
    assert each is not None
    np.testing.assert_array_equal(half.force, 0.5 * FORCE)
    np.testing.assert_array_equal(half.point, POINT)
    np.testing.assert_array_equal(each.force, 3.0 * FORCE[[3]])
