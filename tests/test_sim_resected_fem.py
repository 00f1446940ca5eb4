"""History of a body after a resection: the remainder keeps it as if it had always been separate."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import base_held, box, hold, quadratic
from cuts import BODY, EFFECTS, MESH, STEPS, TIGHT, lying

from sim.deformation import Deformation, build_start
from sim.effects import Elasticity, Gravity, Held, Inertia, Resection
from sim.elements import ELEMENTS
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Prescribed, Resected
from sim.material import Material
from sim.resected_fem import build_fem

RELAXING = Material("neo-hookean", 3000.0, 0.4, prony=((0.5, 0.2), (0.2, 5.0)))


@pytest.mark.parametrize("element", ["p1", "p2"])
def test_batches_of_unequal_steps_keep_their_own_history(element: str) -> None:
    """The history of elements is kept for each case: other cases and their resections do not change it."""
    fem = build_fem(BODY, (*EFFECTS[1:], Elasticity(RELAXING), Inertia(), STEPS), TIGHT, "cpu", element=element)
    frames = [(0, 1), (1, 1), (1, 2)]

    def at(frame: int, rows: list[int]) -> Loads:
        asked = lying([frames[frame][row] for row in rows])
        return Loads(asked.causes, np.full(len(rows), 0.1 * (frame + 1)))

    whole, alone = None, [None, None]
    for frame in range(len(frames)):
        whole = fem.deform(at(frame, [0, 1]), whole)
        for row in (0, 1):
            alone[row] = fem.deform(at(frame, [row]), alone[row])
            assert np.abs(whole.displacement[row] - alone[row].displacement[0]).max() < 1e-9
    assert np.abs(whole.displacement).max() > 1e-4


class TestMemory:
    """A column in a tube: layers that relax, one that does not, and above a plane that is held what bears nothing."""

    COLUMN = box((1, 1, 4), 0.04)
    LAYER = (COLUMN.nodes[COLUMN.tets].mean(axis=1)[:, 2] // 0.01).astype(int)
    FAR = Resection((tuple(np.flatnonzero(LAYER == 3).tolist()),))
    TIMES = np.array([0.0, 0.05, 0.3, 0.7, 2.0, 9.0])

    def run(self, element: str, regions: dict, cut: int, forgets: bool = False) -> list[Deformation]:
        """Held stretched by a tenth; before frame number `cut` the far layer is there, and then it is not."""
        mesh = replace(self.COLUMN, region=np.where(self.LAYER == 1, 2, 1))
        mesh = quadratic(mesh) if element == "p2" else mesh
        height = mesh.nodes[:, 2]
        held = np.column_stack([np.ones((len(height), 2), bool), (height < 1e-9) | (np.abs(height - 0.02) < 1e-9)])
        effects = (Elasticity(RELAXING, regions), Held(), self.FAR)
        made = build_fem(hold(mesh, held), effects, TIGHT, "cpu", element=element)
        lifted = np.where(height[:, None] > 0.019, [0.0, 0.0, 2e-3], 0.0)[None]
        found, last = [], None
        for frame, time in enumerate(self.TIMES):
            done = np.array([int(frame >= cut)])
            last = made.deform(Loads((Prescribed(lifted), Resected(done)), np.array([time])), last)
            assert last.outcome[0].good
            found.append(last)
            last = replace(last, memory={}) if forgets and frame == cut - 1 else last
        return found

    @pytest.mark.parametrize("element", ELEMENTS)
    def test_remainder_relaxes_as_without_the_resection(self, element: str) -> None:
        """The interface of a relaxing layer with an elastic one creeps; without its history it would be elsewhere."""
        regions = {2: Material("neo-hookean", 3000.0, 0.4)}
        cut, whole, forgetful = (self.run(element, regions, *how) for how in ((3,), (9,), (3, True)))
        gone = ~cut[-1].displacement[0].any(axis=1) & whole[-1].displacement[0].any(axis=1)
        crept = np.abs(whole[-1].displacement - whole[0].displacement).max()
        for frame in range(3, len(self.TIMES)):
            apart = np.abs(whole[frame].displacement - cut[frame].displacement)[0, ~gone].max()
            assert apart < 1e-8 * crept
        assert np.abs(whole[3].displacement - forgetful[3].displacement)[0, ~gone].max() > 0.1 * crept
        assert crept > 5e-5 and gone.sum() == (18 if element == "p2" else 4)

    @pytest.mark.parametrize("element", ELEMENTS)
    def test_stress_after_resection_follows_prony_series(self, element: str) -> None:
        """Each part of the stress at constant strain is g exp(-t / tau) of its initial value, across the cut."""
        found = self.run(element, {}, 3)
        (name,) = (name for name in found[0].memory if "visco" in name)
        at_once = found[0].memory[name][0, :, :6]
        stretched = np.abs(at_once).max(axis=1) > 1.0
        assert stretched.sum() >= 6
        for answer, time in zip(found, self.TIMES, strict=True):
            left = answer.memory[name][0, stretched].reshape(stretched.sum(), 3, 6)
            for part, (share, tau) in enumerate(RELAXING.prony, start=1):
                expected = share * np.exp(-time / tau) * at_once[stretched]
                np.testing.assert_allclose(left[:, part], expected, atol=1e-6 * np.abs(at_once).max())

    def test_prony_series_of_resected_tissue_changes_no_result(self) -> None:
        """A negligible share changes no result, one step forward and one back, also in a batch."""
        cut = np.isin(np.arange(len(MESH.tets)), STEPS.steps[0])
        body = base_held(replace(MESH, region=np.where(cut, 2, 1)))
        longer = replace(RELAXING, prony=(*RELAXING.prony, (1e-13, 1.0)))
        found = []
        for tissue in (RELAXING, longer):
            effects = (Elasticity(RELAXING, {2: tissue}), Held(), Gravity(direction=(0.0, 0.0, -1.0)), STEPS)
            made, last = build_fem(body, effects, TIGHT, "cpu"), None
            for frame, done in enumerate(([0, 0], [0, 1], [1, 0], [1, 1])):
                last = made.deform(replace(lying(done), time=np.full(2, 0.1 * (frame + 1))), last)
            assert last is not None and all(outcome.good for outcome in last.outcome)
            found.append(last.displacement)
        np.testing.assert_allclose(found[1], found[0], atol=1e-8 * np.abs(found[0]).max())

    def test_run_before_resection_is_bit_identical_to_plain_run(self) -> None:
        """Compared with a solver without the effect `Resection`."""
        effects = (Elasticity(RELAXING), Held(), Gravity(direction=(0.0, 0.0, -1.0)), Inertia())
        plain, made = (
            Fem(BODY, effects, TIGHT, "cpu", element="p1"),
            build_fem(BODY, (*effects, STEPS), TIGHT, "cpu", element="p1"),
        )
        one = other = None
        for time in (0.01, 0.02, 0.05):
            loads = replace(lying([0]), time=np.array([time]))
            one, other = plain.deform(loads.drop(Resected), one), made.deform(loads, other)
            np.testing.assert_array_equal(one.displacement, other.displacement)
            assert {"inertia", "viscoelasticity neo-hookean"} <= set(one.memory) == set(other.memory) - {"resection"}
            for name, value in one.memory.items():
                np.testing.assert_array_equal(value, other.memory[name])

    def test_history_of_another_body_is_rejected(self) -> None:
        made = build_fem(BODY, (Elasticity(RELAXING), Held(), STEPS), TIGHT, "cpu", element="p1")
        strange = replace(
            build_start(np.zeros((1, len(MESH.nodes), 3))), memory={"viscoelasticity neo-hookean": np.ones((1, 7, 18))}
        )
        with pytest.raises(InputError, match="start from a solution of the same mesh"):
            made.deform(Loads((Resected(np.array([1])),)), strange)
