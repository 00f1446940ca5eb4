"""The condensed surroundings of a part: against the dense Schur complement."""

import numpy as np
from openings import EFFECTS, begun
from oracle import tissue

from sim.compile import compile_part
from sim.effects import Elasticity
from sim.linalg.schur import condense_exterior
from sim.local_solvers.batch_elimination import find_near_tetrahedra


def test_condensed_stiffness_is_the_schur_complement() -> None:
    problem, space = begun("linear", "smoothed")
    chosen = find_near_tetrahedra(space, problem.constraint)
    assert chosen is not None and 0.15 < chosen.mean() < 0.25
    nodes = np.unique(space.table[chosen])
    own = compile_part((Elasticity(tissue("linear")), *EFFECTS), space, problem, chosen, nodes)
    around = condense_exterior(problem, nodes, own.rest_curvature())
    basis, whole = problem.constraint.build_basis(), problem.rest_curvature().toarray()
    part = (3 * nodes[:, None] + np.arange(3)).ravel()
    stays = np.ones(problem.rows, bool)
    stays[part] = False
    far = basis.toarray()[:, np.abs(basis.toarray()[stays]).max(axis=0) > 0.0]
    moved = -far @ np.linalg.solve(far.T @ whole @ far, far.T @ whole[:, part])
    schur = whole[np.ix_(part, part)] + whole[part] @ moved - own.rest_curvature().toarray()
    expected = np.zeros_like(schur)
    expected[np.ix_(around.rows, around.rows)] = around.stiffness
    np.testing.assert_allclose(expected, schur, atol=1e-6 * np.abs(whole).max())
    np.testing.assert_allclose(around.extension, moved[:, around.rows], atol=1e-5)
