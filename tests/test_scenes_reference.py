"""Reference solutions of a report and of frames: stored by load, and evaluated at the compared points."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import make_box
from studies import nothing
from theatres import small

from scenes.builtin.retract import RELAXING_BRAIN
from scenes.play.deformers import PatientSetup
from scenes.play.reference import solve_reference_frames
from scenes.report.reference import ReferenceSolutions, get_reference, get_solutions_beyond, solve_reference
from scenes.report.row import compare_with_reference
from sim.accuracy import TRAIN
from sim.effects import Elasticity, Held, Slide, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Pushed, push
from surrogate.model.training_range import compute_training_range


def test_comparison_uses_only_loads_converged_in_both(study, study_box, monkeypatch):
    truth = ReferenceSolutions(np.full((2, len(study.read_nodes), 3), 1e-3), np.array([True, False]), np.ones(2))
    monkeypatch.setattr("scenes.report.row.get_reference", lambda study: truth)
    answer = np.full((2, len(study_box.tumour_nodes), 3), [[[1e-3, 1e-3, 3e-3]], [[np.nan] * 3]])
    for good, loads in (([True, True], 1), ([True, False], 1)):
        figures = compare_with_reference(study, answer, np.array(good), study_box.tumour_nodes)
        assert figures.loads == loads and figures.mm.mean == pytest.approx(2.0) == figures.mm.largest
    assert compare_with_reference(study, answer, np.array([False, True]), study_box.tumour_nodes) is None


def test_reference_resumes_with_missing_loads_only(study, monkeypatch):
    deform = Fem.deform
    before = get_reference(study)
    lost = sorted((study.folder / "answers").glob("reference-*"))[1]
    lost.unlink()
    solved = []
    monkeypatch.setattr(Fem, "deform", lambda self, loads, *rest: solved.append(len(loads)) or deform(self, loads))
    reported = []
    solve_reference(study, reported.append)
    assert solved == [1] and reported == [1, 1]
    assert np.allclose(get_reference(study).displacement, before.displacement, atol=1e-12) and before.good.all()


def test_damaged_reference_file_is_rejected_by_name(study):
    """Also a damaged table of the series: stopped runs resume from both."""
    get_reference(study)
    kept = study.folder / "answers"
    answer, table = min(kept.glob("reference-*")), kept / f"series-{study.digest}.npz"
    for path, ask in ((answer, lambda: get_reference(study)), (table, lambda: replace(study).expansion.table)):
        path.write_bytes(b"PK" * 100)
        with pytest.raises(InputError, match=f"{path.name}.*Delete it: it is computed again"):
            ask()
        path.unlink()


def test_finer_reference_is_evaluated_at_the_same_points(study, tmp_path):
    """On a coarse box, halved edges change the motion by some percent."""
    one, fine = (replace(study, folder=tmp_path, loads=1, thorough=fine) for fine in (False, True))
    for each in (one, fine):
        solve_reference(each, nothing, TRAIN)
    coarse, finer = get_reference(one).displacement, get_reference(fine).displacement
    off = np.linalg.norm(coarse - finer, axis=2).mean() / np.linalg.norm(finer, axis=2).mean()
    assert 1e-3 < off < 0.3


def test_extrapolation_loads_are_outside_training_range(study):
    training = study.converged.select(np.flatnonzero(study.disc_split.training_mask)).get(Pushed)
    outside = study.loads_beyond.get(Pushed)
    assert not compute_training_range(study.patch, training).is_inside(study.patch, outside).any()
    size = np.linalg.norm(outside.force, axis=1)
    assert (size[::3] > 1.19 * np.linalg.norm(training.force, axis=1).max()).all()
    assert (study.patch.compute_edge_distance(outside.point[2::3]) < outside.footprint[2::3]).all()
    assert get_solutions_beyond(study).displacement.shape == (study.beyond, len(study.anatomy.tumour_nodes), 3)


def test_reference_frame_depends_on_loading_history() -> None:
    """Relaxing tissue after a press differs from tissue that was never pressed."""
    anatomy = make_box(cells=(6, 6, 4), spacing=9e-3, tumour=12e-3, depth=20e-3, opening=22e-3)
    theatre = PatientSetup(anatomy, None, {}, "cpu")
    scene = replace(small(), effects=(Elasticity(RELAXING_BRAIN), Held(), Slide(), ToolForce()), element="p1")
    moments = ((1.5, 0.5), (1.5, 2.0), (0.5, 2.2))
    loads = [scene.build_loads(theatre.site, scene.path(moment), time) for moment, time in moments]
    found, fem, last = solve_reference_frames(theatre, scene, loads).displacement, theatre.build_fem(scene, TRAIN), None
    for row, load in zip(found, loads, strict=True):
        last = fem.deform(load, start=last)
        np.testing.assert_allclose(row, last.displacement[0], atol=1e-9)
    alone = fem.deform(loads[2]).displacement[0]
    assert np.linalg.norm(found[2] - alone) > 0.1 * np.linalg.norm(alone)


def test_reference_frames_report_their_progress(pretender):
    theatre = SimpleNamespace(build_fem=lambda scene, accuracy, batch: pretender)
    loads = [push(np.array([0.001 * k, 0.0, 0.0]), np.array([0.0, 0.0, -0.1]), 6e-3) for k in range(20)]
    heard = []
    found = solve_reference_frames(theatre, None, loads, heard.append)
    assert heard == [16, 4]
    alone = np.concatenate([pretender.deform(load).displacement for load in loads])
    np.testing.assert_allclose(found.displacement, alone, atol=1e-12)
