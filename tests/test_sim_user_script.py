"""Extensions in a user's own file: a tissue law, an effect, a cause; and several pushing tools."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boxes import base_held, box

from sim.accuracy import REFERENCE, TRAIN
from sim.compile import compile_problem
from sim.discretisation.footprint import compute_footprint_weights
from sim.effects import BuiltIn, Elasticity, Held, NodalForce, ToolForce, has_history
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Nodal, Pushed, push
from sim.runtime.device import find_device
from sim.runtime.user_script import run_script

EXAMPLES = Path(__file__).parents[1] / "examples"
YEOH, VEINS = (run_script(EXAMPLES / name) for name in ("yeoh.py", "veins.py"))
MESH = box((3, 3, 3), 0.06)
HALVES = replace(MESH, region=(MESH.nodes[MESH.tets].mean(axis=1)[:, 0] > 0.03).astype(int))
BODY, TWO = base_held(MESH), base_held(HALVES)
TOP = np.array([0.03, 0.03, 0.06])
PRESS = push(TOP, np.array([[0.1, 0.0, -0.4], [0.0, 0.0, -0.1]]), 15e-3)


def answer(*effects: Any, loads: Loads = PRESS, body=BODY, element: str = "p1", **more: Any):
    found = Fem(body, (*effects, Held(), ToolForce(), NodalForce()), REFERENCE, "cpu", element=element, **more).deform(
        loads
    )
    assert all(outcome.good for outcome in found.outcome)
    return found.displacement


def surface_vertices(near: float = 0.02) -> tuple[int, ...]:
    high = np.abs(MESH.nodes[:, 2] - 0.06) < 1e-9
    return tuple(np.flatnonzero(high & (np.linalg.norm(MESH.nodes - TOP, axis=1) < near)).tolist())


@dataclass(frozen=True, eq=False)
class Pull:
    """Of veins: how hard (B,)."""

    share: np.ndarray
    magnitude = "share"


class TestEffect:
    @pytest.mark.parametrize("element", ["p1", "smoothed", "p2"])
    def test_veins_reduce_displacement_of_the_cortex(self, element):
        loads = push(TOP, np.array([0.0, 0.0, -0.4]), 15e-3)
        free = answer(Elasticity(), loads=loads, element=element, live=True)
        veins = VEINS.Veins(surface_vertices(), 60.0, 5e-4)
        tied = answer(Elasticity(), veins, loads=loads, element=element, live=True)
        slack = answer(Elasticity(), VEINS.Veins(surface_vertices(), 60.0, 1.0), loads=loads, element=element)
        assert np.abs(tied).max() < 0.8 * np.abs(free).max()
        assert np.abs(slack - free).max() < 1e-6 * np.abs(free).max()

    def test_vein_forces_reproduce_the_displacement(self):
        """The same motion without veins, under the tool and the force of each vein."""
        veins, loads = VEINS.Veins(surface_vertices(), 60.0, 5e-4), push(TOP, np.array([0.0, 0.0, -0.4]), 15e-3)
        tied = answer(Elasticity(), veins, loads=loads)
        at = list(veins.vertices)
        far = np.linalg.norm(tied[:, at], axis=2, keepdims=True)
        force = np.zeros_like(tied)
        force[:, at] = -veins.stiffness * np.maximum(far - veins.slack, 0.0) / far * tied[:, at]
        assert np.abs(force).max() > 1e-3
        alike = answer(Elasticity(), loads=Loads((*loads.causes, Nodal(force))))
        assert np.abs(alike - tied).max() < 1e-5 * np.abs(tied).max()

    def test_custom_effects_disable_acceleration(self):
        def problem(*effects):
            return compile_problem((Elasticity(), Held(), *effects), BODY, find_device("cpu", "float64"))

        assert problem().can_accelerate and not problem(VEINS.Veins((5,))).can_accelerate
        names = [term.name for term in problem(VEINS.Veins((5,)), ToolForce()).terms]
        assert names[-1] == "veins" and "tool force" in names

    def test_unknown_effect_lists_known_ones_and_extension(self):
        class Glue:
            pass

        with pytest.raises(InputError, match=r"no effect is called Glue: choose from Elasticity, .*Contact; or let"):
            answer(Elasticity(), Glue())
        assert VEINS.Veins not in BuiltIn.__args__

    def test_invalid_or_duplicate_terms_of_effects_are_rejected(self):
        class Nothing(VEINS.Veins):
            def term(self, body):
                return 7

        class Named(VEINS.Veins):
            def term(self, body):
                made = super().term(body)
                made.name = "tool force"
                return made

        with pytest.raises(InputError, match=r"returned a int: must be a sim\.Term"):
            answer(Elasticity(), Nothing((5,)))
        with pytest.raises(InputError, match=r"two terms are called 'tool force'"):
            answer(Elasticity(), Named((5,)))
        with pytest.raises(InputError, match=r"occurs 2 times"):
            answer(Elasticity(), VEINS.Veins((5,)), VEINS.Veins((6,)))

    def test_custom_cause_reaches_only_its_own_effect(self):
        seen = []

        class Pulled(VEINS.Veins):
            cause = Pull
            remembers = True

            def term(self, body):
                made = super().term(body)
                made.begin = lambda cases: seen.append(cases.loads.get(Pull).share)
                return made

        loads = Loads((*PRESS.causes, Pull(np.array([1.0, 2.0]))))
        answer(Elasticity(), Pulled((5,)), loads=loads)
        assert seen[0].tolist() == [1.0, 2.0] and has_history((Pulled((5,)),)) and not has_history((VEINS.Veins((5,)),))
        assert loads.scale(0.5).get(Pull).share.tolist() == [0.5, 1.0]
        with pytest.raises(InputError, match=r"loads hold Pull, which no effect uses: add the effect that it is for"):
            answer(Elasticity(), loads=loads)

    def test_invalid_causes_are_rejected(self):
        with pytest.raises(InputError, match=r"float is no cause: choose from Pushed, .*Retracted; or make your own"):
            Loads((3.0,))  # pyright: ignore[reportArgumentType]
        with pytest.raises(InputError, match=r"Pull.share has a value that is not finite"):
            Loads((Pull(np.array([np.nan])),))
        with pytest.raises(InputError, match=r"Pull.share is one number: give a row per load case"):
            Loads((Pull(np.float64(1.0)),))  # pyright: ignore[reportArgumentType]


LEFT, RIGHT = np.array([0.02, 0.03, 0.06]), np.array([0.045, 0.03, 0.06])


def pushed(point: np.ndarray, force: list[float], radius: float) -> Pushed:
    return Pushed(np.array([point, point]), np.array([force, np.multiply(force, 0.5)]), np.full(2, radius))


TOOLS = pushed(LEFT, [0.0, 0.05, -0.25], 12e-3), pushed(RIGHT, [-0.1, 0.0, -0.15], 8e-3)


class TestTwoTools:
    @pytest.mark.parametrize("element", ["p1", "smoothed"])
    @pytest.mark.parametrize("live", [False, True])
    def test_two_tools_agree_with_their_sum_as_nodal_forces(self, element, live):
        both = answer(Elasticity(), loads=Loads(TOOLS), element=element, live=live)
        force = np.zeros((2, len(MESH.nodes), 3))
        for tool in TOOLS:
            share = compute_footprint_weights(MESH.nodes, MESH.surface, tool.point, tool.footprint).toarray()
            force += share[:, :, None] * tool.force[:, None]
        summed = answer(Elasticity(), loads=Loads((Nodal(force),)), element=element)
        first = answer(Elasticity(), loads=Loads(TOOLS[:1]), element=element)
        assert np.abs(both - first).max() > 0.2 * np.abs(both).max()
        assert np.abs(both - summed).max() < 1e-6 * np.abs(summed).max()

    def test_frames_of_two_tools_converge_from_previous_frame(self):
        """Neither the path of one push nor a patch around it is followed: the other solvers handle both."""
        fem = Fem(BODY, (Elasticity(), Held(), ToolForce()), TRAIN, "cpu", live=True, element="p1")
        last = None
        for size in (0.4, 0.7, 1.0):
            last = fem.deform(Loads(TOOLS).scale(size).select(slice(0, 1)), start=last)
            assert last.outcome[0].good
        alone = fem.deform(Loads(TOOLS).select(slice(0, 1)))
        assert np.abs(last.displacement - alone.displacement).max() < 1e-3 * np.abs(alone.displacement).max()
        one = fem.deform(Loads(TOOLS[:1]).select(slice(0, 1)), start=last)
        assert one.outcome[0].good

    def test_each_tool_has_its_reaction(self):
        fem = Fem(BODY, (Elasticity(), Held(), ToolForce()), TRAIN, "cpu", element="p1")
        reaction = fem.deform(Loads(TOOLS)).reaction
        assert reaction.shape == (2, 2, 6)
        for number, tool in enumerate(TOOLS):
            assert np.allclose(reaction[:, number, :3], tool.force)

    def test_single_cause_lookup_rejects_several_tools(self):
        loads = Loads(TOOLS)
        assert loads.get_all(Pushed) == loads.causes and loads.get_only(Pushed) is None
        with pytest.raises(InputError, match=r"2 causes Pushed, but one is supported"):
            loads.get(Pushed)
        with pytest.raises(InputError, match=r"each kind but Pushed once"):
            Loads((Nodal(np.zeros((1, 3, 3))), Nodal(np.zeros((1, 3, 3)))))
