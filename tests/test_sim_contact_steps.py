"""Steps of single columns in arrays that stay, against the descent that makes each anew."""

from __future__ import annotations

from dataclasses import replace

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
from sim.local_solvers.strained_part import Strains
from sim.material import Material
from sim.minimisers.lbfgs import Descended
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


def cases_at(x: float, y: float, z: float) -> Cases:
    """The ball at a place [m]."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return Cases(Loads((Touching(pose[None, None]),)), np.zeros(1))


def followed(fem: Fem, descent: ContactDescent, many: int) -> list[Descended]:
    """Along so much of the way, each from where the last one ended."""
    u, out = fem.problem.device.zeros(fem.problem.rows, 1), []
    for place in WAY[:many]:
        fem.problem.begin(cases_at(*place))
        out.append(descent.descend(u, np.full(1, TOLERANCE), 30))
        u = out[-1].u
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
    ("limits", "least", "radius", "many"),
    [
        (ContactLimits(), 0.02, 6e-3, 3),
        (ContactLimits(stale=0.0), 0.02, 6e-3, 3),
        (ContactLimits(drag=30.0), 0.02, 6e-3, 2),
        (ContactLimits(), 9.0, 6e-3, 2),
        (ContactLimits(shortest=2.0), 0.5, 6e-3, 3),
        (ContactLimits(), 0.02, 1.5e-3, 1),
    ],
    ids=["usual", "models made anew", "dragged", "as at rest", "misled", "sharp"],
)
def test_replayed_steps_are_those_of_the_descent(
    limits: ContactLimits, least: float, radius: float, many: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As many of them, to the same places, whatever becomes of models, and of steps that go too far."""
    fem = solver(NEO, radius)
    found = fem.strategy.contact
    assert found is not None
    strains = Strains(least=least, cut=np.inf)
    ordinary, replayed = (replace(found, limits=limits, strains=strains, replays=which) for which in (False, True))
    expected = followed(fem, ordinary, many)
    taken = counted(monkeypatch, ContactSteps, "accept")
    answers = followed(fem, replayed, many)
    for answer, other in zip(answers, expected, strict=True):
        assert answer.status[0] == other.status[0] and answer.steps[0] == other.steps[0]
        motion = np.abs(other.u.numpy()).max()
        np.testing.assert_allclose(answer.u.numpy(), other.u.numpy(), rtol=0.0, atol=1e-9 * motion)
    assert taken


def test_steps_are_replayed_only_where_arrays_stay() -> None:
    """Tissue that relaxes has a memory, which each batch brings anew."""
    for material, replays in ((NEO, True), (RELAXING, False)):
        found = solver(material).strategy.contact
        assert found is not None
        assert (replace(found, replays=True).steps is not None) is replays
        assert found.steps is None
