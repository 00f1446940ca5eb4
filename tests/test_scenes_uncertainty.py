"""Errors of model and tumour: priors, ensemble, stored file, and text in the image."""

import json
from dataclasses import replace

import numpy as np
import pytest
from test_sim_conformance import YEOH
from theatres import put, short, small

from ar.overlay.hud import MAX_BOTTOM_WIDTH, TEXT_SCALE, format_millimetres, wrap_line
from ar.overlay.outlines import has_text
from scenes.analysis.uncertainty import (
    SolvedMotions,
    SurfaceMotions,
    apply_sample,
    collect_contributor_values,
    compute_worst_distances,
    estimate_uncertainty,
    measure_coverage,
    solve_nominal,
    solve_scene,
    split_contributions,
)
from scenes.cli import main
from scenes.play.frame_text import NOT_KNOWN_WORDS, find_largest, format_errors
from scenes.play.scene_costs import draw_cost_panel
from scenes.script.priors import POISSON, SKULL, STIFFNESS, TOOL, PatientSample, sample_priors
from scenes.script.scene import SCENES, find_scene
from scenes.script.tool_paths import Touch
from scenes.script.uncertainty import (
    NOT_KNOWN,
    TumourError,
    Uncertainty,
    compute_scene_mark,
    fit_motion_error,
    read_uncertainties,
    to_uncertainty_path,
    write_uncertainties,
)
from sim.anatomy import TUMOUR_LABEL
from sim.deformation import Outcome
from sim.effects import SKULLS, Elasticity
from sim.errors import InputError
from sim.material import BRAIN

SAME = PatientSample(1.0, BRAIN.poisson, 1.0, 0.0, (0.0, 0.0, 0.0), 0.0)
"""As the scene has it."""


class Hasty:
    """A theatre whose finite elements find no equilibrium at calls of some numbers."""

    def __init__(self, theatre, failing):
        self.theatre, self.failing, self.starts, self.site = theatre, failing, [], theatre.site

    def build_fem(self, *asked, **named):
        self.solver = self.theatre.build_fem(*asked, **named)
        return self

    def deform(self, loads, start=None):
        self.starts.append(start)
        answer = self.solver.deform(loads, start=start)
        wrong = len(self.starts) - 1 in self.failing
        return replace(answer, outcome=np.array([Outcome.BUDGET], object)) if wrong else answer


def stated(scene, theatre, worst=(2e-3, 4e-3), **values):
    """An uncertainty that grows from the first frame to the last."""
    mark = compute_scene_mark(scene, theatre.site, theatre.choose_element(scene))
    flat = (1e-3, 1e-3)
    lists = {"times": (0.0, scene.duration), "worst": worst, "middle": flat, "moved": flat}
    lists |= {"registered": (1e-3, 3.5e-3), "motion": (0.0, 2.5e-3)}
    return Uncertainty(
        scene.name, mark, 8, 0, **(lists | values), parts={"E": (0.0, 3e-3), "registration": (2e-3, 2e-3)}
    )


class TestEnsemble:
    def test_sampled_scene_has_the_sampled_parameters(self):
        scene = find_scene("palpate")
        found = apply_sample(scene, PatientSample(2.0, 0.47, 0.5, 0.5, (1e-3, 2e-3, 3e-3), 0.1))
        elasticity, _, skull, _ = found.effects
        assert isinstance(elasticity, Elasticity) and skull == SKULLS["slide"]
        brain = BRAIN.replace_constants(2.0 * BRAIN.young, 0.47)
        assert elasticity == Elasticity(brain, {TUMOUR_LABEL: replace(brain, young=BRAIN.young)})
        asked, given = scene.path(1.3), found.path(1.3)
        assert (given.x - asked.x, given.y - asked.y, given.depth - asked.depth) == pytest.approx((1e-3, 2e-3, 3e-3))

    def test_stiffness_changes_motion_under_known_force_only(self, theatre):
        """Under a known pose it cancels."""
        stiff = replace(SAME, stiffness=2.0)
        for scene, times in ((short(), 0.5), (small("palpate"), 1.0)):
            ours, theirs = (solve_scene(theatre, apply_sample(scene, one)).motions[2] for one in (SAME, stiff))
            lengths = [np.linalg.norm(field, axis=1).mean() for field in (theirs, ours)]
            assert lengths[1] > 1e-5 and lengths[0] / lengths[1] == pytest.approx(times, rel=0.12)

    def test_registration_and_segmentation_add_to_model_error(self):
        off = np.array([[[3.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
        normals = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        shift, wide = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), np.array([0.5, 0.0])
        worst_point, middle = compute_worst_distances(off, normals, shift, wide)
        np.testing.assert_allclose(worst_point, [[4.5, np.hypot(3.0, 2.0)]])
        np.testing.assert_allclose(middle, [[np.hypot(2.75, 0.25), 2.5]])

    def test_contributions_of_independent_parameters_are_separated(self):
        """Fields depend on stiffness and tool independently; other parameters contribute nothing."""
        scene, draws = short(), sample_priors(40, 5)
        random = np.random.default_rng(0)
        field, of_stiffness, of_tool = random.normal(size=(3, 6, 3))
        motion = field + np.array([np.log(one.stiffness) * of_stiffness + one.tip[0] * of_tool for one in draws])
        found = split_contributions(motion, field, draws, scene)
        largest = np.linalg.norm(of_stiffness, axis=1).max()
        assert found[STIFFNESS.name] == pytest.approx(
            largest * np.sqrt(np.mean([np.log(one.stiffness) ** 2 for one in draws]))
        )
        assert found[TOOL] > 0.0 and max(found[name] for name in (POISSON.name, SKULL, "several together")) < 1e-12
        assert TOOL not in collect_contributor_values(draws, find_scene("brain_shift"))
        assert not any(column.any() for column in collect_contributor_values([SAME], scene).values())

    def test_error_bound_covers_95_percent_of_new_samples(self, theatre):
        """Motion inversely proportional to stiffness: 95 of 100 new samples lie within the bound."""
        scene = short()
        random = np.random.default_rng(1)
        normals = random.normal(size=(9, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        field = 3e-3 * random.normal(size=(9, 3))
        still = SurfaceMotions((0.0, 1.0), (0.0 * field, field), (normals, normals))

        def answers(draws):
            return [SolvedMotions((0.0 * field, field / one.stiffness)) for one in draws]

        draws, twins = sample_priors(300, 0), sample_priors(300, 1)
        found = estimate_uncertainty(theatre, scene, still, draws, answers(draws))
        tested = measure_coverage(scene, still, found, twins, answers(twins), 1)
        assert tested.patients == 300 and 0.93 < tested.covered < 0.97
        few = [
            measure_coverage(scene, still, found, sample_priors(20, seed), answers(sample_priors(20, seed)), seed)
            for seed in range(2, 22)
        ]
        scatter = np.std([one.covered for one in few])
        assert 0.5 * scatter < np.mean([one.deviation for one in few]) < 3.0 * scatter
        tight = replace(found, worst=tuple(0.7 * one for one in found.worst))
        assert measure_coverage(scene, still, tight, twins, answers(twins), 1).covered < 0.85
        with pytest.raises(InputError, match="1 of 300 synthetic patients"):
            measure_coverage(scene, still, found, twins, [*answers(twins)[:1], *[None] * 299], 1)

    def test_samples_without_equilibrium_are_counted(self, theatre):
        field = np.ones((9, 3))
        still, draws = SurfaceMotions((0.0,), (field,), (field,)), sample_priors(10, 0)
        answers = [SolvedMotions((field,), inverted) for inverted in [0, 0, 5, 1, 0, 0, 0, 0, 0]]
        found = estimate_uncertainty(theatre, short(), still, draws, iter([*answers, None]))
        assert (found.failed, found.folded) == (1, 2)
        with pytest.raises(InputError, match="too few"):
            estimate_uncertainty(theatre, short(), still, draws, [*answers[:7], None, None, None])

    @pytest.mark.parametrize(("failing", "asked"), [((), 5), ((1,), 9), ((1, 3), 4)])
    def test_failed_time_step_is_repeated_with_substeps(self, theatre, failing, asked):
        """After a failed call the solver starts again from the time before; a second failure gives no result."""
        hasty = Hasty(theatre, failing)
        found, whole = solve_scene(hasty, short()), solve_scene(theatre, short())
        assert len(hasty.starts) == asked
        if len(failing) == 2:
            assert found is None
            return
        for ours, theirs in zip(found.motions, whole.motions, strict=True):
            assert ours == pytest.approx(theirs, abs=2e-5)
        if failing:
            assert hasty.starts[1] is hasty.starts[2] is not None

    def test_very_soft_sample_counts_inverted_tetrahedra(self, theatre):
        """The scene itself inverts none; a tenth of its stiffness inverts some."""
        weak = solve_scene(theatre, apply_sample(short(), replace(SAME, stiffness=0.1)))
        assert solve_scene(theatre, short()).inverted == 0 and weak is not None and weak.inverted > 0

    def test_nominal_times_end_at_the_end_of_the_scene(self, theatre):
        still = solve_nominal(theatre, short())
        assert still.times[0] == 0.0 and still.times[-1] == pytest.approx(0.2)
        assert [np.linalg.norm(one, axis=1).mean() > 1e-4 for one in still.fields] == [False, True, True, True, False]
        np.testing.assert_allclose(np.linalg.norm(still.normals[0], axis=1), 1.0)


class TestStored:
    def test_uncertainty_file_round_trips_and_adds_scenes(self, theatre, tmp_path):
        path = tmp_path / "box.uncertainty.json"
        one = stated(short(), theatre)
        write_uncertainties(path, [one])
        write_uncertainties(path, [replace(one, scene="other")])
        assert read_uncertainties(path) == {"other": replace(one, scene="other"), one.scene: one}
        assert read_uncertainties(tmp_path / "none.json") == {}

    @pytest.mark.parametrize("harm", ["{", '{"format": "else", "scenes": {}}', None])
    def test_damaged_uncertainty_file_is_rejected(self, theatre, tmp_path, harm):
        path = tmp_path / "box.uncertainty.json"
        write_uncertainties(path, [replace(stated(short(), theatre), worst=(1e-3, np.nan))])
        if harm:
            path.write_text(harm)
        with pytest.raises(InputError, match=r"box\.uncertainty\.json"):
            read_uncertainties(path)

    def test_stored_error_holds_only_for_same_scene_and_tissue(self, theatre):
        scene = short()
        knowing = replace(theatre, uncertainties={scene.name: stated(scene, theatre)})
        assert knowing.estimate_uncertainty(scene) is not None
        others = (
            scene.replace_tissue(BRAIN.replace_constants(4000.0), None), scene.replace_tissue(None, "p1"),
            replace(scene, name="else"),
            replace(scene, path=lambda time: Touch(force=0.1)), replace(scene, effects=scene.effects[:-1]),
        )  # fmt: skip
        assert [knowing.estimate_uncertainty(other) for other in others] == [None] * 5

    def test_tumour_error_is_interpolated_in_time_plus_model_error(self, theatre):
        found = stated(short(), theatre)
        for time, most, largest in ((0.0, 2e-3, "registration"), (0.15, 3.5e-3, "E")):
            error = found.evaluate(time)
            assert error == TumourError(pytest.approx(most), largest, moved=error.moved)
        assert error.moved == pytest.approx(2.5e-3 * time / 0.2)
        assert found.evaluate(0.0, 1.5e-3).moved == pytest.approx(1.5e-3)
        assert found.evaluate(0.0, 1.5e-3).prior == pytest.approx(2.5e-3)
        assert found.evaluate(0.0, 9e-3).main_source == "surrogate"

    def test_perfect_registration_adds_no_error(self, theatre):
        found = stated(short(), theatre)
        perfect, clinical = (found.evaluate(0.0, 0.0, registration) for registration in ("perfect", "clinical"))
        assert (perfect.prior, clinical.prior) == (pytest.approx(1e-3), pytest.approx(2e-3))
        assert perfect.main_source != "registration" and clinical.main_source == "registration"
        assert perfect.registration_text == "perfect registration"
        assert clinical.registration_text == "clinical registration, 1.6 mm per axis"

    def test_older_uncertainty_file_gives_upper_estimates(self, theatre, tmp_path):
        path, scene = tmp_path / "box.uncertainty.json", short()
        write_uncertainties(path, [stated(scene, theatre)])
        stored = json.loads(path.read_text())
        for name in ("registered", "motion"):
            del stored["scenes"][scene.name][name]
        path.write_text(json.dumps(stored))
        found = read_uncertainties(path)[scene.name]
        assert found.registered == found.motion == (0.0, pytest.approx(4e-3))  # 1.96 x 3 mm exceeds the whole error

    def test_error_of_other_loads_is_proportional_to_motion(self, theatre):
        found = fit_motion_error(stated(short(), theatre, moved=(0.0, 2e-3)))
        assert found.mean == pytest.approx(1.25) and found.surface == pytest.approx((3.5**2 - 1.0) ** 0.5 / 2.0)
        rest, moved = (found.evaluate(motion, 0.0, "perfect") for motion in (0.0, 2e-3))
        assert (rest.prior, rest.moved) == (pytest.approx(1e-3), 0.0)
        assert (moved.prior, moved.moved) == (pytest.approx(3.5e-3), pytest.approx(2.5e-3)) and moved.is_rough
        assert found.evaluate(0.0, 0.0, "clinical").prior == pytest.approx(2e-3)
        assert fit_motion_error(stated(short(), theatre, moved=(0.0, 0.0))) is None

    def test_template_has_uncertainty_of_each_scene_without_observer(self):
        from scenes.play.deformers import open_theatre

        template = open_theatre(device="cpu")
        known = [name for name in SCENES if template.estimate_uncertainty(find_scene(name))]
        assert known == sorted(template.uncertainties, key=SCENES.index)
        assert known == [name for name in SCENES if find_scene(name).observation_model is None]


class TestSaid:
    @pytest.mark.parametrize(
        ("trained", "promised", "error", "said"),
        [
            (
                True, 2.21e-4, TumourError(4.11e-3, "E"),
                [
                    "surrogate error <= 0.23 mm (95 %, relative to FEM)",
                    "tumour position error <= 4.2 mm (95 %), mainly E",
                ],
            ),
            (False, None, NOT_KNOWN, ["FEM reference (no surrogate)", NOT_KNOWN_WORDS]),
            (
                True, None, TumourError(4.11e-3, "E"),
                [
                    "model error relative to FEM: not known",
                    "tumour position error <= 4.2 mm (95 %), mainly E",
                ],
            ),
            (
                False, None, TumourError(4.11e-3, "E", 1e-3),
                ["tumour position error <= 1.0 mm (95 %); without cortex observation: 4.2 mm"],
            ),
        ],
    )  # fmt: skip
    def test_model_error_and_tumour_error_are_shown_separately(self, trained, promised, error, said):
        assert format_errors(promised, error, trained) == said
        assert format_errors(promised, error, trained, "doubt") == said[-1:]

    @pytest.mark.parametrize(
        ("trained", "promised", "error", "said"),
        [
            (True, 2.21e-4, TumourError(4.11e-3, "E"), ["model <= 0.23 mm", "tumour <= 4.2 mm"]),
            (True, None, NOT_KNOWN, ["model: not known", "tumour: not known"]),
            (False, None, TumourError(4.11e-3, "E"), ["FEM reference", "tumour <= 4.2 mm"]),
            (False, None, TumourError(4.11e-3, "E", 1e-3), ["tumour <= 1.0 mm"]),
        ],
    )
    def test_small_images_have_brief_error_text(self, trained, promised, error, said):
        assert format_errors(promised, error, trained, is_brief=True) == said

    def test_worst_error_is_known_only_if_all_errors_are_known(self):
        errors = [TumourError(1e-3, "E"), TumourError(3e-3, "nu"), TumourError(2e-3, "E")]
        assert find_largest(errors) == errors[1]
        assert find_largest([*errors, NOT_KNOWN]) == find_largest([]) == NOT_KNOWN

    def test_image_has_both_errors_and_band_of_tumour_error(self, theatre, monkeypatch):
        scene = short()
        wide = replace(scene, viewpoint=replace(scene.viewpoint, width=640, height=480))
        knowing = replace(theatre, uncertainties={scene.name: stated(scene, theatre)})
        player = knowing.build_player("linear", wide)
        drawn_with = []
        from scenes.play.player import composite

        monkeypatch.setattr(
            "scenes.play.player.composite", lambda *given, **more: drawn_with.append(given) or composite(*given, **more)
        )
        frame = player.draw(3, 0.1, scene.path(0.1))
        assert frame.tumour_error.prior == pytest.approx(np.hypot(2.25e-3, frame.model_error))
        assert frame.model_error == frame.deformation.bound[0, 0]
        marks = drawn_with[0][5]
        assert marks.margin == marks.gauge.error == frame.tumour_error.prior
        assert list(frame.head) == format_errors(frame.model_error, frame.tumour_error, True)
        assert all(has_text(frame.shown, line, TEXT_SCALE) for line in frame.head)
        # The panel of figures begins under them.
        assert all(has_text(draw_cost_panel(frame, "linear"), line, TEXT_SCALE) for line in frame.head)
        thin = knowing.build_player("linear", scene).draw(3, 0.1, scene.path(0.1))
        assert thin.shown.shape == (240, 320, 3)
        brief = format_errors(thin.model_error, thin.tumour_error, True, is_brief=True)
        assert " ".join(thin.head) == " ".join(brief)
        moved = wrap_line(f"moved {format_millimetres(thin.moved, thin.tumour_error.moved)}", MAX_BOTTOM_WIDTH * 320)
        for line in (*thin.head, *moved, "frame 3"):
            assert has_text(thin.shown, line, TEXT_SCALE)

    def test_manual_load_error_follows_motion_or_is_unknown(self, theatre):
        scene = short()
        player = replace(theatre, uncertainties={scene.name: stated(scene, theatre)}).build_player("linear", scene)
        held, doubtful = (player.draw(3, 0.1, Touch(force=force)) for force in (0.2, 0.6))
        expected = fit_motion_error(player.uncertainty).evaluate(held.moved, held.model_error, "perfect")
        assert held.tumour_error == expected and expected.is_rough and expected.prior > 1e-3
        assert doubtful.tumour_error == NOT_KNOWN
        assert held.model_error is not None and doubtful.model_error is None and doubtful.doubt


def test_check_and_episode_use_error_of_uncertainty_command(theatre, tmp_path, capsys):
    import h5py

    body = put(theatre, tmp_path / "box.vtu")
    own = tmp_path / "brief.py"
    own.write_text(
        "from scenes import Scene, press\n"
        "SCENE = Scene('brief', 'A short press.', press(0.25, rise=0.1, hold=0.0), duration=0.2)\n"
    )
    words = [str(own), "--anatomy", str(body), "--device", "cpu"]
    assert main(["uncertainty", *words, "--draws", "8", "--twins", "2", "--json"]) == 0
    said = capsys.readouterr()
    (row,) = json.loads(said.out)["scenes"]
    assert "these parts are guesses: 8 numbers are fitted to 8 draws" in said.err and row["fitted_numbers"] == 8
    assert row["scene"] == "brief" and row["draws"] == 8 and row["patients"] == 2 and 0.5 < row["covered"] <= 1.0
    assert "on 2 synthetic patients that are not among them" in said.err and 0.0 <= row["covered_deviation"] < 0.5
    assert row["tumour_mm"] > 4.0 > row["model_mm"] and row["largest_part"] is None
    stored = read_uncertainties(to_uncertainty_path(body))["brief"]
    assert stored.covered == pytest.approx(row["covered"], abs=1e-6)
    assert main(["check", *words, "--deformer", "fem", "--every", "3", "--json"]) == 0
    (checked,) = json.loads(capsys.readouterr().out)["scenes"]
    assert checked["model_error_mm"] is None
    errors = [stored.evaluate(0.1 * one, registration="perfect").prior for one in range(3)]
    assert checked["tumour_error_mm"] == pytest.approx(1e3 * max(errors))
    assert main(["check", *words, "--deformer", "linear", "--every", "3"]) == 0
    said = capsys.readouterr().out
    assert "surrogate error <= " in said and "tumour position error <= " in said
    assert main(["collect", *words, "--deformer", "linear", "--out", str(tmp_path / "one.h5")]) == 0
    with h5py.File(tmp_path / "one.h5") as file:
        assert np.isfinite(file["tumour_error"][:]).all() and file["tumour_error"][0] > file["model_error"][0] >= 0.0
        assert np.array_equal(file["tumour_error"][:], file["tumour_error_unobserved"][:])
    assert main(["uncertainty", *words, "--draws", "2"]) == 2
    assert "--draws" in capsys.readouterr().err
    # Before anything is solved.
    assert main(["uncertainty", *words, "--out", str(tmp_path / "found.csv")]) == 2
    assert "written as .json" in capsys.readouterr().err


def test_uncertainty_rejects_tissue_without_young_modulus():
    scene = short().replace_tissue(YEOH.Yeoh(500.0, 0.0, 1e4), None)
    with pytest.raises(InputError, match="has another tissue: Yeoh"):
        apply_sample(scene, SAME)
