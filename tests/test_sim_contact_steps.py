"""Contact steps of single columns in preallocated arrays, against the descent that allocates them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from boxes import base_held, box

from sim.accuracy import Accuracy
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, ToolContact
from sim.fem import Fem
from sim.loads import Loads, Touching
from sim.local_solvers.contact_descent import ContactDescent
from sim.local_solvers.contact_limits import ContactLimits
from sim.local_solvers.contact_steps import ContactSteps
from sim.local_solvers.strained_part import StrainLimits
from sim.material import Material
from sim.minimisers.lbfgs import DescentResult
from sim.tools import Ball

HEIGHT, TOLERANCE = 0.03, 1e-7
BODY = base_held(box((6, 6, 3), 0.06))
NEO, RELAXING = Material("neo-hookean", 3000.0, 0.45), Material("neo-hookean", 3000.0, 0.45, prony=((0.4, 1.0),))
# In its order: pressed, pressed deeper, moved aside.
WAY = (0.031, 0.028, HEIGHT - 2e-3), (0.031, 0.028, HEIGHT - 4e-3), (0.034, 0.03, HEIGHT - 5e-3)


def solver(material: Material, radius: float = 6e-3) -> Fem:
    """A block under a ball."""
    effects = [Elasticity(material), Held(), ToolContact((Ball(radius),))]
    return Fem(BODY, effects, Accuracy(TOLERANCE), "cpu", element="p1")


def cases_at(number: int, memory: Mapping[str, Any]) -> Cases:
    """The ball at a place on its way, a second after the one before."""
    pose = np.eye(4)
    pose[:3, 3] = WAY[number]
    loads = Loads((Touching(pose[None, None]),), np.full(1, number + 1.0))
    return Cases(loads, np.full(1, float(number)), memory)


def followed(fem: Fem, descent: ContactDescent, many: int) -> list[DescentResult]:
    """Along so much of the way, each from where the last one ended, with what is remembered of it."""
    u, out, memory = fem.problem.device.allocate(fem.problem.rows, 1), [], {}
    for number in range(many):
        fem.problem.begin(cases_at(number, memory))
        out.append(descent.descend(u, np.full(1, TOLERANCE), 30))
        u = out[-1].u
        memory = fem.problem.end(u)
    return out


def counted(monkeypatch: pytest.MonkeyPatch, owner: type, name: str) -> list[object]:
    """What a method of a class has answered since."""
    seen, own = [], getattr(owner, name)

    def said(self: object, *given: object) -> object:
        seen.append(own(self, *given))
        return seen[-1]

    monkeypatch.setattr(owner, name, said)
    return seen


@pytest.mark.parametrize(
    ("limits", "least", "radius", "many", "material"),
    [
        (ContactLimits(), 0.02, 6e-3, 3, NEO),
        (ContactLimits(stale_factor=0.0), 0.02, 6e-3, 3, NEO),
        (ContactLimits(proximal=30.0), 0.02, 6e-3, 2, NEO),
        (ContactLimits(), 9.0, 6e-3, 2, NEO),
        (ContactLimits(reset_length=2.0), 0.5, 6e-3, 3, NEO),
        (ContactLimits(), 0.02, 1.5e-3, 1, NEO),
        (ContactLimits(), 0.02, 6e-3, 3, RELAXING),
    ],
    ids=["usual", "models made anew", "dragged", "as at rest", "misled", "sharp", "relaxing"],
)
def test_replayed_contact_steps_agree_with_descent(
    limits: ContactLimits, least: float, radius: float, many: int, material: Material, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Same number of steps and same result, also with rejected models and steps that are too long."""
    fem = solver(material, radius)
    found = fem.strategy.contact
    assert found is not None
    strains = StrainLimits(min_strain=least)
    ordinary, replayed = (replace(found, limits=limits, strains=strains, uses_graphs=which) for which in (False, True))
    expected = followed(fem, ordinary, many)
    taken = counted(monkeypatch, ContactSteps, "take_step")
    answers = followed(fem, replayed, many)
    for answer, other in zip(answers, expected, strict=True):
        assert answer.status[0] == other.status[0] and answer.steps[0] == other.steps[0]
        motion = np.abs(other.u.numpy()).max()
        np.testing.assert_allclose(answer.u.numpy(), other.u.numpy(), rtol=0.0, atol=1e-8 * motion)
    assert taken
