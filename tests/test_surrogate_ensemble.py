"""Oedema among the causes of an ensemble: swelling tissue, draws, solves and observation."""

from dataclasses import replace

import numpy as np
import pytest
from locators import locator_of

from sim import fem
from sim.anatomy import BRAIN_LABEL, PART_LABELS
from surrogate.locating.causes import OEDEMA, SWELLING, Causes, build_groups, build_swellings
from surrogate.locating.ensemble import ACCURACY, mark_tumour_surroundings, solve_members
from surrogate.locating.observation import Observation, to_evidence
from surrogate.locating.posterior import condition_prior

FEW = Causes(
    poisson=(0.45,), tools=(1, 1), drainages=1, levels=(0.5,), swellings=(0.02,), tumour_swellings=(0.1,),
    oedema=(0.1, -0.05), reach=(8e-3, 16e-3), reaches=(2, 1),
)  # fmt: skip


def test_swelling_near_tumour_includes_marked_oedema(body):
    middle = body.mesh.nodes[body.mesh.tets].mean(axis=1)
    away = np.linalg.norm(middle[:, None] - body.mesh.nodes[body.tumour_nodes], axis=2).min(axis=1)
    far = PART_LABELS["oedema"]
    region = np.where(away > 25e-3, far, body.mesh.region)
    for anatomy, labels in ((body, ()), (replace(body, mesh=replace(body.mesh, region=region)), (far,))):
        for reach in (9e-3, 20e-3):
            marked, swells = mark_tumour_surroundings(anatomy, reach)
            own = np.setdiff1d(swells, labels)
            near = (away < reach) & (anatomy.mesh.region == BRAIN_LABEL)
            assert len(own) == 1 and np.array_equal(marked.mesh.region == own, near) and near.any()
            assert set(labels) <= set(swells) and np.array_equal(marked.in_tumour, body.in_tumour)
            assert np.array_equal(marked.mesh.region[~near], anatomy.mesh.region[~near])


def test_oedema_reaches_cover_their_range_in_each_skull(body):
    made = build_groups(body, 0, replace(FEW, poisson=(0.45, 0.47, 0.49)))
    for skull, count in (("bonded", 6), ("contact", 2)):
        reach = np.concatenate([group.reach for group in made if group.skull == skull])
        share = np.log(reach / FEW.reach[0]) / np.log(FEW.reach[1] / FEW.reach[0])
        assert np.floor(count * np.sort(share)).tolist() == list(range(count))


def test_oedema_bulges_more_than_brain_swelling(body):
    motion, kind = solve_members(body, build_groups(body, 0, FEW)[0], 0, "cpu", FEW)
    assert (kind == OEDEMA).sum() == len(FEW.oedema) * FEW.reaches[0]
    size = np.linalg.norm(motion[:, np.unique(body.open_surface)], axis=2)
    bulge = size.max(axis=1) / np.sqrt((size**2).mean(axis=1))
    assert bulge[kind == OEDEMA].min() > 1.05 * bulge[kind == SWELLING][0]


def test_group_members_share_one_preconditioner(body, monkeypatch):
    """Only volume changes differ; results agree with separate preconditioners within the tolerance."""
    group, made, choose = build_groups(body, 0, FEW)[0], [], fem.choose_preconditioner
    monkeypatch.setattr(fem, "choose_preconditioner", lambda *given: made.append(given) or choose(*given))
    motion, kind = solve_members(body, group, 0, "cpu", FEW)
    assert len(made) == 1
    marked, labels = mark_tumour_surroundings(body, group.reach[0])
    apart = fem.Fem(marked, group.build_effects(FEW.oedema, labels), ACCURACY, "cpu").deform(
        build_swellings(marked, FEW.oedema)
    )
    largest = np.abs(apart.displacement).max()
    assert motion[kind == OEDEMA][: len(apart)] == pytest.approx(apart.displacement, abs=1e-2 * largest)


def test_unnamed_points_are_not_attributed_to_oedema(body):
    """Errors of clouds resemble oedema (docs/locate.md); the same points with names may indicate it."""
    locator = locator_of(body)
    prior = locator.prior
    moved = 4.0 * prior.shape[np.flatnonzero(prior.kind == OEDEMA)[0]].astype(float)
    nodes = np.unique(body.open_surface)
    rest = body.mesh.nodes[nodes]
    for known, believed in ((rest, True), (None, False)):
        found = condition_prior(prior, to_evidence(body, Observation(rest + moved[nodes], known)))
        rows = np.concatenate([answer.rows for answer in found.results])
        kinds = prior.kind[rows[rows < len(prior.kind)]]
        assert (OEDEMA in kinds) == believed
