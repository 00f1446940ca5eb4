"""Invalid arguments give an error that names them: arrays, vertices, starts and options of the solver."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from boxes import base_held, box

from sim.accuracy import LIVE, Accuracy
from sim.deformation import Deformation, build_start
from sim.effects import Elasticity, Held, Inertia, Resection, ToolForce
from sim.errors import InputError
from sim.fem import MID_EDGE_KEY, Fem
from sim.loads import (
    Displaced,
    Loads,
    Nodal,
    Posture,
    Prescribed,
    Pushed,
    Resected,
    Retracted,
    Touching,
    build_posture,
    push,
)
from sim.minimisers.lbfgs import HISTORY_KEYS
from sim.resected_fem import build_fem

BODY = base_held(box((3, 3, 3), 0.1))
EFFECTS = Elasticity(), Held(), ToolForce()
POINT, FORCE = np.array([0.05, 0.05, 0.1]), np.array([0.0, 0.0, -0.2])
PUSH = push(POINT, FORCE, 0.02)

WRONG: dict[str, tuple[Any, str]] = {
    "ragged": ([[1.0, 2.0, 3.0], [1.0]], "cannot be converted"),
    "text": ("left", "type <U4"),
    "texts": ([["a", "b", "c"]], "type <U1"),
    "complex": (np.ones((1, 3)) * 1j, "type complex128"),
    "objects": (np.array([[None, 1, 2]], object), "type object"),
    "nothing": (None, "type object|shape"),
    "truth values": (np.ones((1, 3), bool), "type bool"),
    "nan": (np.array([[0.0, np.nan, 0.0]]), "finite"),
    "infinite": (np.array([[0.0, np.inf, 0.0]]), "finite"),
    "huge": (np.array([[0.0, 1e300, 0.0]]), r"1e\+300, beyond"),
    "wide": (np.array([[0.0, 0.0, 1.0]], np.longdouble) * np.longdouble("1e4000"), "finite"),
    "a whole number too long": ([[10**400, 0, 0]], "type object"),
    "two columns": (np.zeros((1, 2)), "shape"),
    "four columns": (np.zeros((3, 4)), "shape"),
}
CAUSES: dict[type, dict[str, np.ndarray]] = {
    Pushed: {"point": POINT[None], "force": FORCE[None], "footprint": np.array([0.01])},
    Displaced: {"point": POINT[None], "displacement": FORCE[None], "footprint": np.array([0.01])},
    Nodal: {"force": np.zeros((1, 5, 3))},
    Prescribed: {"displacement": np.zeros((1, 5, 3))},
    Posture: {"direction": FORCE[None], "csf_level": np.zeros(1), "share": np.ones(1)},
    Resected: {"done": np.zeros(1)},
    Touching: {"pose": np.eye(4)[None, None]},
    Retracted: {"pose": np.eye(4)[None], "displacement": FORCE[None]},
}


@pytest.mark.parametrize("wrong", WRONG)
def test_invalid_arrays_of_each_load_are_rejected_by_name(wrong: str) -> None:
    value, _ = WRONG[wrong]
    for kind, arrays in CAUSES.items():
        assert len(Loads((kind(**arrays),))) == 1
        for name in arrays:
            with pytest.raises(InputError, match=rf"{kind.__name__}\.{name} (has|cannot)"):
                Loads((kind(**{**arrays, name: value}),))


@pytest.mark.parametrize("wrong", WRONG)
def test_invalid_push_and_posture_are_rejected_by_name(wrong: str) -> None:
    value, reason = WRONG[wrong]
    for name in ("point", "force", "footprint"):
        with pytest.raises(InputError, match=rf"Pushed\.{name} .*({reason}|shape)"):
            push(**{"point": POINT, "force": FORCE, "footprint": 0.01, name: value})
    for name in ("direction", "csf_level"):
        with pytest.raises(InputError, match=rf"Posture\.{name} .*({reason}|shape)"):
            build_posture(**{"direction": FORCE, "csf_level": 0.0, name: value})


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: push(np.zeros((2, 3)), np.ones((3, 3)), 0.01), "rows of point 2, force 3, footprint 1"),
        (lambda: push(POINT, np.ones((3, 3)), np.full(2, 0.01)), "rows of point 1, force 3, footprint 2"),
        (lambda: push(POINT, FORCE, np.full((1, 1), 0.01)), r"Pushed\.footprint has shape \(1, 1\)"),
        (lambda: push(POINT, FORCE, 7), r"a radius of 7 m: give positive radii in metres, .*7 mm are 0\.007"),
        (lambda: push(POINT, FORCE, 1e-12), r"a radius of 1e-12 m.* from 0\.0001 to 0\.1"),
        (lambda: build_posture(np.ones((2, 3)), np.zeros(3)), "rows of direction 2, csf_level 3"),
        (lambda: build_posture(np.array([1e-200, 0.0, 0.0]), 0.0), "row of zeros"),
        (lambda: Loads((5,)), r"int is no cause: choose from Pushed, "),  # pyright: ignore[reportArgumentType]
        (lambda: Loads(PUSH), r"Loads\.causes is Loads"),  # pyright: ignore[reportArgumentType]
        (lambda: Loads(PUSH.causes, "now"), r"Loads\.time has the type"),  # pyright: ignore[reportArgumentType]
        (lambda: Loads(PUSH.causes, np.array([2e30])), r"Loads\.time .* beyond"),
        (lambda: Loads((Resected(np.array([1e300])),)), r"Resected\.done .* beyond"),
    ],
)
def test_wrong_row_counts_and_radii_are_rejected(build: Callable[[], Loads], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        build()


@pytest.fixture(scope="module")
def fem() -> Fem:
    return Fem(BODY, EFFECTS, LIVE, "cpu", element="p1")


@pytest.fixture(scope="module")
def cut() -> Any:
    return build_fem(BODY, (*EFFECTS, Resection(((150, 151, 152),))), LIVE, "cpu")


VERTICES = [
    (np.ones(64, bool), "at is a boolean mask: give vertex numbers, as np.flatnonzero"),
    ([True, False], "at is a boolean mask"),
    ([1.5], r"at has shape \(1,\) and type float64: give the numbers of vertices"),
    (np.array([1.0, 2.0]), "type float64"),
    (np.array([[1, 2]]), r"shape \(1, 2\)"),
    (3, r"shape \(\)"),
    (["one"], "type <U3"),
    ([[1], [1, 2]], "at cannot be converted"),
    ([-1], "no vertex -1"),
    ([10**6], "no vertex 1000000: choose from 0 to 63"),
    (np.array([2**63 + 5], np.uint64), "no vertex"),
]


@pytest.mark.parametrize(("at", "sentence"), VERTICES)
def test_invalid_vertices_are_rejected(fem: Fem, cut: Any, at: Any, sentence: str) -> None:
    for body in (fem, cut):
        with pytest.raises(InputError, match=sentence):
            body.deform(PUSH, at=at)
    with pytest.raises(InputError, match=sentence):
        fem.build_reading(at, np.ones((1, 1, 3)))
    answer = fem.deform(PUSH)
    with pytest.raises(InputError):
        answer.restrict(at)


@pytest.mark.parametrize("loads", [None, [PUSH], "push"])
def test_deform_rejects_values_that_are_not_loads(fem: Fem, cut: Any, loads: Any) -> None:
    for body in (fem, cut):
        with pytest.raises(InputError, match=r"loads is .*: give Loads, such as push\(...\) makes"):
            body.deform(loads)


def test_vertices_may_be_lists_tuples_or_small_integers(fem: Fem, cut: Any) -> None:
    for body in (fem, cut):
        whole = body.deform(PUSH)
        some_lists: list[Any] = [[5, 2], (5, 2), np.array([5, 2], np.uint8), [7, 7]]
        for at in some_lists:
            some = body.deform(PUSH, at=at)
            np.testing.assert_array_equal(some.displacement, whole.displacement[:, np.array(at, int)])
            np.testing.assert_array_equal(whole.restrict(at).displacement, some.displacement)
            assert some.displacement.shape == (1, len(at), 3)
        none: Any = []
        assert body.deform(PUSH, at=none).displacement.shape == whole.restrict(none).displacement.shape == (1, 0, 3)
    with pytest.raises(InputError, match="lacks vertex 3"):
        fem.deform(PUSH, at=np.array([1])).restrict(np.array([3]))
    with pytest.raises(InputError, match="lacks vertex 3"):
        fem.deform(PUSH, at=np.zeros(0, int)).restrict(np.array([3]))


@pytest.mark.parametrize("batch", [0, -1, 1.5, True, "2", np.nan])
def test_invalid_batch_size_is_rejected(batch: Any) -> None:
    with pytest.raises(InputError, match=r"batch is .*: give a whole number from 1 up"):
        Fem(BODY, EFFECTS, LIVE, "cpu", batch=batch, element="p1")


@pytest.mark.parametrize(
    ("made", "sentence"),
    [
        ({"accuracy": "live"}, "accuracy is 'live': give an Accuracy"),
        ({"anatomy": "patient.vtu"}, r"anatomy is 'patient.vtu': give an Anatomy, such as read_anatomy\(FILE.vtu\)"),
        ({"effects": (Elasticity, Held)}, r"Elasticity is a class, not an instance: write Elasticity\(...\)"),
        ({"element": "p7"}, "no element is called 'p7'"),
        ({"element": ["p1"]}, r"no element is called \['p1'\]"),
        ({"effects": Elasticity()}, "effects is Elasticity.*: give a tuple of effects"),
    ],
)
def test_invalid_solver_arguments_are_rejected(made: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        Fem(**{"anatomy": BODY, "effects": EFFECTS, "accuracy": LIVE, "device": "cpu", **made})


@pytest.mark.parametrize(
    ("budget", "sentence"),
    [
        ({"outer": 1.5}, "outer is 1.5: give a whole number from 1 up"),
        ({"inner": 0}, "inner is 0"),
        ({"steps": -1}, "steps is -1: give a whole number from 0 up"),
        ({"tolerance": "fine"}, "tolerance is 'fine': give a number"),
        ({"tolerance": np.nan}, "a tolerance of nan is outside"),
        ({"precision": ["float32"]}, "no precision is called"),
    ],
)
def test_invalid_accuracy_arguments_are_rejected(budget: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        Accuracy(**budget)
    assert Accuracy(**{"tolerance": np.float32(1e-3), "outer": np.int32(4)}).outer == 4


def spoilt(answer: Deformation, **memory: Any) -> Deformation:
    return replace(answer, memory={**answer.memory, **memory})


def warmed(answer: Deformation, **warm: Any) -> Deformation:
    return replace(answer, warm={**answer.warm, **warm})


def test_invalid_starts_are_rejected(fem: Fem, cut: Any) -> None:
    for body in (fem, cut):
        good = body.deform(PUSH)
        own = np.zeros((1, 64, 3))
        wrong: list[tuple[Any, str]] = [
            (5, "the start is a int"),
            (good.displacement, "the start is a ndarray"),
            (build_start(np.zeros((2, 64, 3))), r"shape \(2, 64, 3\): give every vertex of 1 load cases, \(1, 64, 3\)"),
            (build_start(np.zeros((1, 8, 3))), r"shape \(1, 8, 3\)"),
            (good.restrict(np.array([1, 2])), r"shape \(1, 2, 3\)"),
            (replace(good, time=np.array([np.nan])), "the start's 'time' are no 1 rows of finite numbers"),
            (replace(good, time=np.zeros(3)), "the start's 'time'"),
            (spoilt(good, inertia=np.full((1, 64, 3), np.nan)), "the start's 'inertia'"),
            (spoilt(good, pushes=np.full((1, 2, 7), np.nan)), "the start's 'pushes'"),  # a term of that name
            (warmed(good, pushes=np.array("x")), "the start's 'pushes'"),
            (warmed(good, pushes=np.zeros((4, 2, 7))), "the start's 'pushes'"),
            (warmed(good, pushes=good.warm["pushes"] * 1j), "the start's 'pushes'"),
        ]
        for start, sentence in wrong:
            with pytest.raises(InputError, match=sentence):
                body.deform(PUSH, start)
        assert body.deform(PUSH, build_start(own)).outcome[0].good
    for values, sentence in ((np.full((1, 64, 3), np.nan), "finite"), (np.zeros((64, 3)), "shape"), ("x", "type")):
        with pytest.raises(InputError, match=f"a guessed displacement .*{sentence}"):
            build_start(values)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_non_finite_warm_start_data_are_ignored(fem: Fem, value: float) -> None:
    first = fem.deform(PUSH)
    start = fem.deform(PUSH.scale(1.1), first)
    assert start.warm["known"][0] > 0
    for name, rest in (("s", {"pushes", "before"}), ("before", {*HISTORY_KEYS, "pushes"})):
        found = fem.deform(PUSH.scale(1.2), warmed(start, **{name: np.full_like(start.warm[name], value)}))
        left = {key: array for key, array in start.warm.items() if key in rest}
        other = fem.deform(PUSH.scale(1.2), replace(start, warm=left))
        np.testing.assert_array_equal(found.displacement, other.displacement)


def test_start_with_wrong_mid_edge_nodes_is_rejected() -> None:
    body = Fem(BODY, EFFECTS, LIVE, "cpu", element="p2")
    answer = body.deform(PUSH)
    wrong = spoilt(answer, **{MID_EDGE_KEY: answer.memory[MID_EDGE_KEY][:, :, :2]})
    with pytest.raises(InputError, match=f"the start's memory of {MID_EDGE_KEY} has shape"):
        body.deform(PUSH, wrong)


def test_empty_load_batch_with_start_gives_empty_result() -> None:
    body = Fem(BODY, (Elasticity(), Held(), ToolForce(), Inertia()), LIVE, "cpu", element="p1")
    none = PUSH.select(np.arange(0))
    assert len(body.deform(none, build_start(np.zeros((0, 64, 3))))) == 0


def test_accuracy_beyond_float_precision_is_rejected() -> None:
    with pytest.raises(InputError, match="float32 reaches 2e-05"):
        Accuracy(tolerance=1e-6, precision="float32")
    with pytest.raises(InputError, match="no precision is called"):
        Accuracy(precision="float16")  # pyright: ignore[reportArgumentType]
