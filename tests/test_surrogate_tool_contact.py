"""Blades with warm start, their pressure, and the shipped model of the spatula."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenes.script.shipped_files import get_gym_model_path, get_template_path
from sim.anatomy import Anatomy
from sim.bodies.meshfile import read_anatomy
from sim.contact_pressure import compute_pressure
from sim.deformation import join_deformations
from sim.effects import Elasticity, Held, ToolContact, build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Touching
from sim.material import Material
from sim.tools import Spatula
from surrogate.data.cortex_patch import open_patch
from surrogate.data.indentation import to_indentation
from surrogate.model.guarded import compute_tool_pressure, has_tool_pressure
from surrogate.model.learned import Learned, ModelPart
from surrogate.model.store import load
from surrogate.model.tool_contact import CONTACT_KEY, ForceModel
from surrogate.model.training_range import compute_training_range
from surrogate.training.fem_tables import condense_contact, join_bases

BLADE = Spatula(8e-3, 12e-3, 1.5e-3)
SOFT = Material("linear", 3000.0, 0.45)


def over(body: Anatomy, *places: tuple[float, float]) -> Loads:
    """The blade straight over the middle of a box's flat top: so far aside, and so deep [mm]."""
    points = open_patch(body).points
    pose = np.tile(np.eye(4), (len(places), 1, 1, 1))
    pose[:, 0, :3, 3] = 0.5 * (points.min(axis=0) + points.max(axis=0))
    pose[:, 0, 0, 3] += [1e-3 * aside for aside, _ in places]
    pose[:, 0, 2, 3] -= [1e-3 * deep for _, deep in places]
    return Loads((Touching(pose),))


@pytest.fixture(scope="module")
def model(box):
    """Contact on linear tissue, of which nothing is learned."""
    parts = [box.tumour_nodes, np.setdiff1d(open_patch(box).nodes, box.tumour_nodes)]
    contact, bases = condense_contact(Fem(box, build_push_effects(box, SOFT), device="cpu", element="p1"), parts, BLADE)
    contact = replace(contact, grip=np.array([1.0, 0.0]))
    asked = to_indentation(over(box, (0.0, 0.2), (1.0, 4.0)), BLADE, open_patch(box))
    known = compute_training_range(open_patch(box), asked)
    part = ModelPart("core", contact, join_bases(bases))
    return Learned(box, (part,), known, tool=BLADE, force=ForceModel())


def test_warm_started_blade_reaches_the_direct_contact(model, box):
    """Same contact as directly from the air; the same start gives the same bytes."""
    first, second = over(box, (0.0, 2.5)), over(box, (0.4, 3.0))
    start = model.deform(first)
    on, straight = model.deform(second, start), model.deform(second)
    assert on.displacement.tobytes() == model.deform(second, start).displacement.tobytes()
    for nodes, share in ((model.nodes, 0.08), (box.tumour_nodes, 0.05)):  # on facets of 6 mm, its edge counts
        one, other = on.restrict(nodes).displacement, straight.restrict(nodes).displacement
        assert 0.0 < np.linalg.norm(one - other, axis=2).max() < share * np.linalg.norm(other, axis=2).max()
    force = straight.reaction[:, 0, :3]
    np.testing.assert_allclose(on.reaction[:, 0, :3], force, atol=0.05 * np.linalg.norm(force))
    # Where it stays, nothing changes; and without what is warm it comes straight in.
    again = model.deform(first, start)
    np.testing.assert_allclose(again.displacement, start.displacement, atol=2e-5)
    dropped = model.deform(second, replace(start, warm={}))
    assert dropped.displacement.tobytes() == straight.displacement.tobytes()


def test_distant_start_gives_the_direct_contact(model, box):
    """Starts in the air, far aside and deeper in the tissue; each row is solved separately."""
    starts = [model.deform(over(box, place)) for place in ((0.0, -2.0), (9.0, 0.5), (0.3, 1.5))]
    there = over(box, (0.0, 1.0), (0.0, 1.0), (0.0, 1.5))
    found, straight = model.deform(there, join_deformations(starts)), model.deform(there)
    for row in (0, 1):
        assert found.displacement[row].tobytes() == straight.displacement[row].tobytes()
    assert found.displacement[2].tobytes() != straight.displacement[2].tobytes()
    lifted = model.deform(over(box, (0.0, -1.0)), starts[2])
    assert not lifted.displacement.any() and not lifted.reaction[:, 0, :3].any()
    strange = replace(starts[2], warm={CONTACT_KEY: np.ones((1, 5))})
    alone = there.select(np.array([2]))
    assert model.deform(alone, strange).displacement.tobytes() == model.deform(alone).displacement.tobytes()
    spoiled = replace(starts[2], warm={CONTACT_KEY: np.nan * starts[2].warm[CONTACT_KEY]})
    assert model.deform(alone, spoiled).displacement.tobytes() == model.deform(alone).displacement.tobytes()


def test_tool_pressure_matches_finite_elements(model, box):
    """Its integral is the force; its maximum is that of the barrier forces."""
    loads = over(box, (0.0, 2.0), (2.0, 3.0), (0.0, -1.0))
    answer = model.deform(loads)
    found = compute_tool_pressure(model, loads, answer)
    assert has_tool_pressure(model) and not found[2].any()
    np.testing.assert_array_equal(compute_tool_pressure(model, loads, replace(answer, warm={})), found)
    fem = Fem(box, (Elasticity(SOFT), Held(), ToolContact((BLADE,))), device="cpu", batch=1, element="p1")
    touching = loads.select(np.array([0, 1]))
    truth = compute_pressure(fem, touching, fem.deform(touching))
    np.testing.assert_allclose(found[:2].max(axis=1), truth.max(axis=1), rtol=0.2)
    with pytest.raises(InputError, match="give the complete result"):
        compute_tool_pressure(model, loads, answer.restrict(box.tumour_nodes))
    with pytest.raises(InputError, match="train the learner contact"):
        compute_tool_pressure(replace(model, force=None), loads, answer)


def test_shipped_spatula_model_matches_finite_elements():
    """New poses, two of them with contacts that are not positive definite in single precision."""
    model = load(get_gym_model_path(), read_anatomy(get_template_path()))["contact-gp"]
    kept = np.load(Path(__file__).parent / "data" / "spatula_poses.npz")
    answer = model.deform(Loads((Touching(kept["pose"][:, None]),)))
    off = np.linalg.norm(answer.restrict(model.anatomy.tumour_nodes).displacement - kept["tumour"], axis=2)
    moved = np.linalg.norm(kept["tumour"], axis=2)
    assert (off.max(axis=1) <= answer.bound[1]).all()
    assert np.mean(off.mean(axis=1) / moved.mean(axis=1)) < 0.08
    size = np.linalg.norm(kept["force"], axis=1)
    assert np.mean(np.linalg.norm(answer.reaction[:, 0, :3] - kept["force"], axis=1) / size) < 0.1
