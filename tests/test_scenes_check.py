"""Scene checks: perturbed frames fail, unperturbed frames pass."""

import json
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from theatres import PUSHING, SIGHTED, player, put, small, theatre_of

from ar.overlay.composite import composite
from ar.overlay.hud import format_millimetres
from ar.overlay.marks import Marks, Occluders
from ar.rendering.renderer import Picture
from scenes.cli import main
from scenes.play.checks import SceneFigures, measure_frames
from scenes.play.frame_text import annotate_image
from scenes.play.player import measure_tip_gauge
from scenes.play.reference import solve_reference_frames
from scenes.play.stage import OPENING, TOOL
from scenes.script.scene import SCENES, Bounds, find_scene
from scenes.script.tool_paths import press
from sim.deformation import Outcome

GOOD = SceneFigures(
    overlap=0.99, error_mm=0.1, motion_mm=1.0, pixels=1e-9, drawn=0.5, printed=True, labelled=True, visible=0.9,
    honest=True,
    finite=True, answered=True, in_step=True, leaked=0.0, bond=0.1, covered=0.95, removed=0.5,
)  # fmt: skip
SENTENCES = {
    "overlap": (0.90, "overlap 0.9000 is below 0.95"),
    "error_mm": (0.31, "error 0.3100 mm is above 0.3 mm"),
    "motion_mm": (0.0, "never moves"),
    "pixels": (0.01, "0.01 pixels off"),
    "drawn": (2.5, "the drawn outline is 2.5 pixels off, more than 2"),
    "printed": (False, "does not show its frame number"),
    "labelled": (False, "cut off, or far from the tip"),
    "visible": (0.4, "40% of it is visible, less than 50%"),
    "honest": (False, "as if it were visible"),
    "finite": (False, "not finite"),
    "answered": (False, "solution is not good"),
    "in_step": (False, "at another time"),
    "covered": (0.89, "in 89% of the frames, less than 90%"),
    "removed": (-0.1, "remove -10% of the tumour's motion, less than 0%"),
}


by_each = pytest.mark.parametrize("play", ["linear", "fem"], indirect=True, scope="module")


@pytest.fixture(scope="module")
def play(request, theatre):
    """By a model, or by what is asked for."""
    near = replace(find_scene("press").viewpoint, width=480, height=360)
    scene = replace(small(path=press(0.2, hold=0.5)), viewpoint=near)
    return player(theatre, scene, getattr(request, "param", "linear"))


@pytest.fixture(scope="module")
def frames(play):
    return list(play.play_frames(every=30))


@pytest.fixture(scope="module")
def truth(theatre, play, frames):
    return solve_reference_frames(theatre, play.scene, [frame.loads for frame in frames])


def broken(play, frames, truth, camera=None):
    figures = measure_frames(play, play.get_camera if camera is None else lambda time: camera, frames, truth)
    return set(figures.find_violations(Bounds())), figures


def about(sentences, word):
    return any(word in sentence for sentence in sentences)


def shifted(frame, by):
    """The frame of an answer that puts the tumour elsewhere, `by` (3,) [m]."""
    answer = frame.deformation
    return replace(frame, deformation=replace(answer, displacement=answer.displacement + by))


def test_each_bound_has_a_violation_message():
    assert GOOD.find_violations(Bounds()) == []
    assert set(SENTENCES) == set(GOOD.to_row()) - {"leaked", "bond", "doubt"}  # stated, and held to nothing
    for name, (value, words) in SENTENCES.items():
        (sentence,) = replace(GOOD, **{name: value}).find_violations(Bounds())
        assert words in sentence
    unknown = replace(GOOD, overlap=np.nan, error_mm=np.nan, pixels=np.nan, drawn=np.nan)
    assert len(unknown.find_violations(Bounds())) == 4
    assert json.loads(json.dumps(GOOD.to_row())) == GOOD.to_row()


def test_volume_outside_the_skull_is_reported_as_leaked(play, frames, truth):
    leaky = replace(truth, leaked=np.linspace(0.0, 0.35, len(truth)))
    assert measure_frames(play, play.get_camera, frames, leaky).leaked == 0.35
    assert measure_frames(play, play.get_camera, frames, truth).leaked == truth.leaked.max() < 1e-5


@by_each
def test_unperturbed_frames_pass_all_checks(play, frames, truth):
    sentences, figures = broken(play, frames, truth)
    assert not sentences
    assert figures.overlap > 0.97 and figures.pixels < 1e-9 and figures.motion_mm > 0.4
    assert figures.error_mm < 0.05 and figures.drawn < 2.1 and figures.printed


def drawn(play, frame, positions, camera=None, tip=None, opening=OPENING):
    """A frame whose picture was drawn from other positions, by another camera, or with another tip."""
    stage, at = play.stage, frame.tip if tip is None else tip
    tumour, rest = (stage.build_tumour(each) for each in (positions, play.site.anatomy.mesh.nodes))
    gauge = measure_tip_gauge(at, tumour)
    if tip is None:
        gauge = replace(gauge, reading=frame.distance, error=frame.tumour_error.bound)
    shown = composite(
        frame.picture,
        camera or play.camera,
        tumour,
        cover=Occluders((TOOL,), opening=opening),
        marks=Marks(gauge=gauge, initial=rest),
    )
    annotate_image(shown, frame.number, frame.remark)
    return replace(frame, shown=shown.colour)


def compute_error(camera, columns, rows):
    """A camera with its principal point elsewhere [pixel]."""
    shift = np.zeros((3, 3))
    shift[:2, 2] = columns, rows
    return replace(camera, K=camera.K + shift)


class TestThePictureItself:
    """Correct solution, wrong image."""

    def pixels(self, play, frames, truth, wrong):
        """Sentences and figures where the middle frame's picture is another."""
        sentences, figures = broken(play, [frames[0], frames[1], wrong, *frames[3:]], truth)
        return sentences, figures

    def test_unchanged_image_passes_the_pixel_check(self, play, frames, truth):
        again = drawn(play, frames[2], play.compute_positions(frames[2].deformation))
        assert not self.pixels(play, frames, truth, again)[0]

    def test_image_of_undeformed_tumour_fails_the_pixel_check(self, play, frames, truth):
        wrong = drawn(play, frames[2], play.site.anatomy.mesh.nodes)
        sentences, figures = self.pixels(play, frames, truth, wrong)
        assert about(sentences, "outline") and figures.drawn > 2.0

    def test_image_of_tumour_shifted_by_1_mm_fails(self, play, frames, truth):
        """Image and solution agree, and both differ from FEM."""
        away = shifted(frames[2], 1e-3 * play.site.right)
        sentences, rows = self.pixels(play, frames, truth, drawn(play, away, play.compute_positions(away.deformation)))
        assert about(sentences, "outline") and rows.drawn > 2.0

    def test_image_of_an_earlier_frame_fails(self, play, frames, truth):
        late = replace(frames[2], shown=frames[1].shown)
        assert about(self.pixels(play, frames, truth, late)[0], "does not show its frame number")
        wrong = drawn(play, frames[2], play.compute_positions(frames[0].deformation))
        assert about(self.pixels(play, frames, truth, wrong)[0], "outline")

    @pytest.mark.parametrize("off", [(3.0, 0.0), (0.0, 8.0), (60.0, 40.0)])
    def test_image_from_a_shifted_camera_fails(self, play, frames, truth, off):
        camera = compute_error(play.camera, *off)
        wrong = drawn(play, frames[2], play.compute_positions(frames[2].deformation), camera)
        sentences, figures = self.pixels(play, frames, truth, wrong)
        assert about(sentences, "outline") and figures.drawn > 2.0

    def test_image_without_an_overlay_fails(self, play, frames, truth):
        bare = replace(frames[2], shown=frames[2].picture.colour)
        sentences, figures = self.pixels(play, frames, truth, bare)
        assert (
            about(sentences, "outline")
            and about(sentences, "does not show its frame number")
            and figures.drawn == np.inf
        )

    def test_check_rejects_image_with_wrong_tip_distance(self, play, frames, truth):
        deep = frames[2].tip + 0.4e-3 * play.site.axis
        wrong = drawn(play, frames[2], play.compute_positions(frames[2].deformation), tip=deep)
        assert about(self.pixels(play, frames, truth, wrong)[0], "does not show its frame number")

    def test_image_with_a_tenfold_tip_distance_fails(self, play, frames, truth, monkeypatch):
        monkeypatch.setattr(
            "ar.overlay.gauge.format_millimetres", lambda length, error=None: format_millimetres(10.0 * length, error)
        )
        wrong = drawn(play, frames[2], play.compute_positions(frames[2].deformation))
        assert about(self.pixels(play, frames, truth, wrong)[0], "does not show its frame number")

    def test_image_with_a_wrong_frame_number_fails(self, play, frames, truth):
        wrong = drawn(play, replace(frames[2], number=59), play.compute_positions(frames[2].deformation))
        assert about(self.pixels(play, frames, truth, replace(wrong, number=60))[0], "does not show its frame number")


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
def test_camera_rotated_by_half_a_degree_fails_the_checks(play, frames, truth, axis):
    off = [replace(frame, camera=frame.camera.perturb(0.5, axis)) for frame in frames]
    sentences, figures = broken(play, off, truth)
    assert about(sentences, "pixels off") and figures.pixels > 0.2
    if axis[2] == 0.0:  # about the line of sight a round tumour keeps its outline
        assert about(sentences, "overlap")
    one = [frames[0], off[1], *frames[2:]]  # in one frame only
    assert about(broken(play, one, truth)[0], "pixels off")


@by_each
@pytest.mark.parametrize("direction", ["right", "up", "axis"])
def test_tumour_shifted_by_1_mm_fails_the_checks(play, frames, truth, direction):
    by = 1e-3 * getattr(play.site, direction)
    sentences, figures = broken(play, [frames[0], shifted(frames[1], by), *frames[2:]], truth)
    assert about(sentences, "error") and figures.error_mm == pytest.approx(1.0, abs=0.1)
    if direction == "right":
        assert about(sentences, "overlap")


def test_frame_with_an_earlier_deformation_fails_the_checks(play, frames, truth):
    stale = [frames[0], replace(frames[1], deformation=frames[0].deformation), *frames[2:]]
    assert about(broken(play, stale, truth)[0], "at another time")
    # Even if it claims the right time: the tumour is elsewhere.
    lying = replace(frames[0].deformation, time=np.array([frames[1].time]))
    stale[1] = replace(frames[1], deformation=lying)
    sentences = broken(play, stale, truth)[0]
    assert about(sentences, "error") and not about(sentences, "at another time")


def test_frames_in_wrong_order_fail_the_checks(play, frames, truth):
    assert about(broken(play, [frames[1], frames[0], *frames[2:]], truth)[0], "at another time")


@by_each
def test_non_finite_depth_or_displacement_fails_the_checks(play, frames, truth):
    for poison in (np.nan, np.inf):
        depth = frames[1].picture.depth.copy()
        depth[3, 5] = poison
        there = wp.array(depth[None], dtype=wp.float32, device="cpu")
        off = replace(frames[1], picture=Picture(replace(frames[1].picture.drawn, depth=there)))
        assert about(broken(play, [frames[0], off, *frames[2:]], truth)[0], "not finite")
        # No deformer lets such a displacement pass: it can only be put in afterwards.
        answer = replace(frames[1].deformation, displacement=frames[1].deformation.displacement.copy())
        answer.displacement[0, np.searchsorted(answer.nodes, play.site.anatomy.tumour_nodes[0])] = poison
        off = replace(frames[1], deformation=answer)
        assert about(broken(play, [frames[0], off, *frames[2:]], truth)[0], "not finite")


def test_check_reports_bad_outcome_of_frame_and_reference(play, frames, truth):
    doubtful = replace(frames[1].deformation, outcome=(Outcome.EXTRAPOLATED,))
    off = [frames[0], replace(frames[1], deformation=doubtful), *frames[2:]]
    why = Outcome.EXTRAPOLATED.value
    assert broken(play, off, truth)[0] == {f"a solution is not good: frame {frames[1].number} as drawn, {why}"}
    stopped = replace(truth, outcome=(*truth.outcome[:-1], Outcome.BUDGET))
    why, last = Outcome.BUDGET.value, frames[-1].number
    assert broken(play, frames, stopped)[0] == {f"a solution is not good: frame {last} by the finite elements, {why}"}
    assert broken(play, off, stopped)[0].pop().endswith(" (1 more)")


def test_frames_without_motion_fail_the_checks(play, frames, truth):
    assert about(broken(play, frames[:1], truth.select(np.array([0])))[0], "never moves")


@pytest.fixture(scope="module")
def small_theatre(small_box):
    return theatre_of(small_box)


@pytest.fixture(scope="module")
def anatomy(small_theatre, tmp_path_factory):
    return put(small_theatre, tmp_path_factory.mktemp("check") / "box.vtu")


class TestCommand:
    def test_check_command_reports_every_scene_as_json(self, anatomy, capsys):
        """Blade scenes fail: they strain this small body beyond the measured range, or invert tetrahedra."""
        assert main(["check", "--anatomy", str(anatomy), "--every", "60", "--json"]) == 1
        out, err = capsys.readouterr()
        report = json.loads(out)
        assert out.count("\n") == 1 and not report["passed"]
        plain = [name for name in SCENES if name not in SIGHTED]
        assert [row["scene"] for row in report["scenes"]] == plain
        assert f"no {', '.join(SIGHTED)}: this anatomy has no locator" in err
        played = {row["scene"]: row["deformer"] for row in report["scenes"]}
        assert played == {name: "guarded" if name in PUSHING else "fem" for name in plain}
        for row in report["scenes"]:
            assert row["frames"] >= 3 and row["motion_mm"] > 0.03
            word = {"retract": "strained", "spatula": "inverted"}.get(row["scene"], "")
            assert [about([one], word) for one in row["broken"]] == [True] * bool(word)
        assert err.count("passes") == len(plain) - 1  # all but two, and a film whose markers are lost and found
        assert report["tracking"]["broken"] == [] and report["tracking"]["pictures"] == 16

    def test_check_command_passes_one_scene_solved_by_fem(self, anatomy, capsys):
        words = ["check", "draw", "--anatomy", str(anatomy), "--every", "40", "--deformer", "fem", "--device", "cpu"]
        assert main(words) == 0
        solver, verdict = capsys.readouterr().out.splitlines()[:2]
        assert solver == "draw by finite elements (smoothed; neo-hookean, E 3 kPa, nu 0.49)"
        assert verdict.split()[:2] == ["draw", "passes"]

    def test_check_command_fails_for_model_with_doubled_modes(self, small_theatre, anatomy, tmp_path, capsys):
        linear = small_theatre.models["linear"]
        parts = [replace(part, basis=replace(part.basis, modes=2 * part.basis.modes)) for part in linear.parts]
        wrong = replace(small_theatre, models={"linear": replace(linear, parts=tuple(parts))})
        off = put(wrong, tmp_path / "off.vtu")
        words = ["press", "--anatomy", str(off), "--every", "60", "--deformer", "linear"]
        assert main(["check", *words, "--json"]) == 1
        report = json.loads(capsys.readouterr().out)
        (row,) = report["scenes"]
        assert not report["passed"] and about(row["broken"], "error") and row["error_mm"] > 0.3
        assert main(["check", *words]) == 1
        out = capsys.readouterr().out
        assert "FAILS" in out and "mm is above" in out

    def test_check_command_fails_for_frames_without_motion(self, anatomy, capsys):
        assert main(["check", "press", "--anatomy", str(anatomy), "--every", "1000"]) == 1
        assert "never moves" in capsys.readouterr().out
