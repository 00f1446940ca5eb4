"""Tumour localisation in scenes: image, page text and checks."""

import json
from dataclasses import replace

import numpy as np
import pytest
from locators import locator_of
from theatres import SIGHTED, short, small

from ar.overlay.hud import MAX_BOTTOM_WIDTH, TEXT_SCALE, format_bound, format_millimetres, wrap_line
from ar.overlay.outlines import average_colour, find_colour, has_text
from scenes.cli import main
from scenes.page.text import describe_estimate, format_page_legend, format_report
from scenes.play.checks import is_within_surface, list_warnings, measure_frames
from scenes.play.deformers import PatientSetup, open_theatre
from scenes.play.observer import ELLIPSOID_COLOUR
from scenes.play.player import REJECTED_WARNING
from scenes.play.reference import solve_reference_frames
from scenes.play.scene_costs import draw_cost_panel
from scenes.play.stage import TRUTH_COLOUR, TUMOUR_COLOUR
from scenes.script.observation_models import PointObservation
from scenes.script.scene import Bounds
from scenes.script.shipped_files import get_template_path
from scenes.script.tool_paths import press
from scenes.script.uncertainty import TumourError, Uncertainty
from scenes.script.viewpoint import OBLIQUE_VIEWPOINT
from sim.anatomy import PART_LABELS
from sim.bodies.meshfile import write_anatomy
from sim.errors import InputError
from surrogate.locating.locator_store import save_locator, to_locator_path
from surrogate.locating.prior import compute_centroid_motion
from surrogate.locating.regions import Region

# Small errors, as a tumour in a box moves little.
SIGHT = PointObservation(points=80, white=1e-4, smooth=1e-4, shift=1e-4, turn=0.0)


@pytest.fixture(scope="module")
def theatre(box, tmp_path_factory):
    path = tmp_path_factory.mktemp("sight") / "box.locator.npz"
    save_locator(path, locator_of(box, solved=True).restrict())
    return PatientSetup(box, None, {}, "cpu", path)


@pytest.fixture(scope="module")
def scene():
    near = replace(OBLIQUE_VIEWPOINT, width=480, height=360)
    return replace(small(path=press(0.3, rise=1.0, hold=0.5)), viewpoint=near, observation_model=SIGHT)


@pytest.fixture(scope="module")
def play(theatre, scene):
    return theatre.build_player("fem", scene)


@pytest.fixture(scope="module")
def frames(play):
    return list(play.play_frames(every=40))


@pytest.fixture(scope="module")
def truth(theatre, scene, frames):
    return solve_reference_frames(theatre, scene, [frame.loads for frame in frames])


def test_observer_omits_only_points_hidden_by_the_tool(still, play):
    observer, rest = still
    held = play.place_tool(play.scene.tool, play.get_touch(40), rest)
    corners = np.asarray(play.scene.tool.mesh.vertices) @ held.pose[:3, :3].T + held.pose[:3, 3]
    seen, all_seen = observer.observe(0, rest, corners), observer.observe(0, rest)
    assert 0 < len(all_seen.now) - len(seen.now) < 300 and len(seen.rest) == len(seen.now) == len(seen.sigmas)
    away = np.linalg.norm(seen.rest - held.tip, axis=1)
    assert away.min() > 3e-3 and len(seen.tips) == 1
    assert np.linalg.norm(seen.tips[0] - held.tip) < 3e-3
    lifted = observer.observe(0, rest, corners - 4e-3 * play.site.axis)
    assert not len(lifted.tips) and len(seen.now) < len(lifted.now)


def test_image_shows_estimate_truth_and_ellipsoid(play, frames):
    frame = frames[1]
    found = frame.estimate
    assert found.location is not None and found.is_covered and found.error < 0.7 * np.linalg.norm(found.true_motion)
    assert frame.moved == found.motion_length == pytest.approx(np.linalg.norm(found.location.centroid))
    for ink, least in ((TUMOUR_COLOUR, 200), (ELLIPSOID_COLOUR, 10), (TRUTH_COLOUR, 10)):
        assert np.count_nonzero(find_colour(frame.shown, average_colour(ink))) >= least
    nodes = play.site.anatomy.tumour_nodes
    believed, positions = play.estimate_positions(frame), play.compute_positions(frame.deformation)
    assert not np.allclose(believed[nodes], positions[nodes], atol=1e-5)
    others = np.setdiff1d(np.arange(len(positions)), nodes)
    assert np.array_equal(believed[others], positions[others])  # the camera sees the true cortex
    moved = compute_centroid_motion(play.site.anatomy, (believed - play.site.anatomy.mesh.nodes)[None])[0]
    assert moved == pytest.approx(found.motion, abs=1e-6)
    assert "locate" in frame.seconds and frame.remark.endswith(f"estimate error {1e3 * found.error:.1f} mm")


def test_checks_pass_and_report_estimate_coverage(play, frames, truth):
    figures = measure_frames(play, play.get_camera, frames, truth)
    assert figures.find_violations(Bounds(overlap=0.5, error=3e-3, visible=0.1)) == []
    # One frame moves, and by nothing that the locator's dents are: 14 % of it are removed.
    assert figures.covered == 1.0 and 0.1 < figures.removed < 1.0 and figures.error_mm > 0.01


def test_checks_detect_wrong_estimates(play, frames, truth):
    frame, others = frames[1], [frames[0], *frames[2:]]

    def sentences(wrong):
        figures = measure_frames(play, play.get_camera, [others[0], wrong, *others[1:]], truth)
        return " ".join(figures.find_violations(Bounds(overlap=0.0, error=1.0, visible=0.1, covered=1.0)))

    plain = replace(play, stage=replace(play.stage, observer=None))
    undrawn = plain.draw_frame(frame.number, frame.touch, frame.loads, frame.deformation, 0.1)
    assert "the drawn outline" in sentences(replace(undrawn, estimate=frame.estimate))
    astray = replace(frame.estimate, centroid=frame.estimate.centroid + 0.01)
    for wrong in (astray, replace(frame.estimate, location=None)):  # one that is refused has no ellipsoid
        assert "ellipsoid holds the tumour's middle in" in sentences(replace(frame, estimate=wrong))
    silent = replace(frame, remark="estimate error 9.9 mm")
    assert "does not show its frame number or" in sentences(silent)
    other = replace(frame, estimate=replace(frame.estimate, true_motion=np.full(3, 1.0)))
    assert sentences(other) == ""  # the truth is that of the finite elements
    assert sentences(frame) == ""


def test_ellipsoid_encloses_95_percent_of_its_covariance(frames):
    found = frames[1].estimate
    closed, root = found.build_ellipsoid(), np.linalg.cholesky(found.location.centroid_covariance)
    at, way = found.centroid + found.motion, np.array([0.6, 0.0, 0.8])
    assert is_within_surface(closed, at + 2.7 * root @ way) and not is_within_surface(closed, at + 2.85 * root @ way)
    assert replace(found, true_motion=found.motion + 2.79 * root @ way).is_covered  # chi-square of three, 95 %: 2.795
    assert not replace(found, true_motion=found.motion + 2.8 * root @ way).is_covered


def test_estimate_without_motion_is_labelled(play, frames):
    found = frames[0].estimate
    assert not found.is_significant and frames[0].remark.startswith("no significant motion detected; ")
    assert "No significant motion detected." in " ".join(describe_estimate(found))
    tried, guess = (replace(found, location=replace(found.location, calibrated=known)) for known in (True, False))
    assert "guess" not in tried.remark + " ".join(describe_estimate(tried))
    assert "; rough estimate; " in guess.remark and "It is a guess" in " ".join(describe_estimate(guess))


@pytest.fixture(scope="module")
def refused(theatre, scene):
    """A frame whose points are off by far more than they say."""
    play = theatre.build_player("fem", scene)
    stage = replace(play.stage, observer=Wild(play.stage.observer))
    return replace(play, stage=stage), replace(play, stage=stage).draw(40, 4 / 3, play.get_touch(40))


class Wild:
    """An observer whose points are scattered."""

    def __init__(self, observer):
        self.observer = observer

    def estimate(self, number, positions, tool=None):
        wild = replace(
            self.observer, observation_model=replace(self.observer.observation_model, white=8e-3, smooth=1e-4)
        )
        sigma = replace(wild.observe(number, positions, tool), sigma=None)
        return _estimated(replace(wild), sigma, positions)


def _estimated(observer, seen, positions):
    with pytest.raises(InputError) as refusal:
        observer.locator.locate(seen)
    return replace(observer.estimate(0, positions), observation=seen, location=None, rejection=str(refusal.value))


def test_rejected_observation_shows_warning_and_no_ellipsoid(refused, monkeypatch):
    play, frame = refused
    found, said = frame.estimate, []
    assert frame.doubt == REJECTED_WARNING and found.build_ellipsoid() is None
    assert not found.is_covered and frame.remark == ""
    nodes = play.site.anatomy.tumour_nodes
    assert np.array_equal(play.estimate_positions(frame)[nodes], play.site.anatomy.mesh.nodes[nodes])
    assert not find_colour(frame.shown, average_colour(ELLIPSOID_COLOUR)).any() and frame.moved == 0.0
    assert np.count_nonzero(find_colour(frame.shown, average_colour(TRUTH_COLOUR))) > 10
    monkeypatch.setattr(
        "scenes.play.scene_costs.draw_text_panel", lambda colour, lines, **more: said.extend(lines) or colour
    )
    draw_cost_panel(frame, "fem")
    assert any(line == f"estimate: rejected, {found.rejection}" for line in said)
    assert "Observation rejected" in format_report(frame, play.stage, "fem", "", (), 100)


def test_check_reports_locator_rejections_and_slips(refused, frames):
    """Rejections, slips and a tumour mostly at rest, each with its reason; otherwise nothing."""
    _, wild = refused
    best = max(frames, key=lambda frame: np.linalg.norm(frame.estimate.true_motion))
    slipped = replace(best.estimate, location=replace(best.estimate.location, slipped=True))
    still = replace(best, estimate=replace(best.estimate, true_motion=np.zeros(3)))
    assert list_warnings([best, best]) == [] and list_warnings([replace(best, estimate=None)]) == []
    why = wild.estimate.rejection
    assert list_warnings([wild, best]) == [f"the locator rejects the observation in 1 of 2 frames: {why}"]
    (doubt,) = list_warnings([replace(best, estimate=slipped), best])
    assert "doubts its result in 1 of 2 frames" in doubt and "may have slipped" in doubt
    (sparse,) = list_warnings([still, best, still])
    assert "moves in 1 of 3 frames" in sparse and "give a smaller --every" in sparse


def test_label_separates_simulated_and_estimated_motion(frames, monkeypatch):
    frame, said = frames[1], []
    found = frame.estimate
    monkeypatch.setattr(
        "scenes.play.scene_costs.draw_text_panel", lambda colour, lines, **more: said.extend(lines) or colour
    )
    draw_cost_panel(replace(frame, named=False), "fem")
    truth = 1e3 * np.linalg.norm(found.true_motion)
    off = format_bound(found.location.p95, 1)
    assert said[0] == f"simulated tumour motion: {truth:.2f} mm"
    assert said[1] == f"estimate: tumour moved {1e3 * found.motion_length:.2f} +- {off}"
    assert f"simulation: {frame.deformation.source}" in said and f"estimate: {found.source}" in said
    assert said[-1].startswith("lines: ") and not any("tumour moved" in line for line in said[2:])
    foot = f"estimate moved {format_millimetres(found.motion_length, found.location.p95)}"
    assert f"simulated motion {truth:.1f} mm; estimate" in frame.remark
    assert all(
        has_text(frame.shown, line, TEXT_SCALE) for line in wrap_line(foot, MAX_BOTTOM_WIDTH * frame.shown.shape[1])
    )
    said.clear()
    draw_cost_panel(replace(frame, named=True), "fem")
    assert not any(line.startswith("lines: ") for line in said)


def test_page_text_has_figures_and_errors_before_explanations(play, frames):
    words = format_report(frames[1], play.stage, "fem", "", (), 100)
    order = "estimated tumour motion", "converged", "Tumour position error", "<b>estimate</b> from", "frame "
    places = [words.index(each) for each in order]
    assert places == sorted(places)


def test_observation_error_replaces_prior_error(play, frames):
    alone, of_frame = replace(play, motion_error=None), frames[1]
    frame = alone.draw_frame(of_frame.number, of_frame.touch, of_frame.loads, of_frame.deformation, 0.1)
    assert frame.tumour_error == TumourError(None, "", frame.estimate.error_bound)
    times = tuple(float(time) for time in play.scene.times[[0, -1]])
    flat = {"times": times, "worst": (3e-3, 3e-3), "middle": (2e-3, 2e-3), "moved": (1e-3, 1e-3)}
    flat |= {"registered": (3e-3, 3e-3), "motion": (1e-3, 1e-3)}
    known = Uncertainty("it", "", 9, 0, **flat, parts={"E": (1e-3, 1e-3)})
    knowing = replace(play, uncertainty=known)
    both = knowing.draw_frame(frame.number, frame.touch, frame.loads, frame.deformation, 0.1).tumour_error
    assert both.prior == pytest.approx(3e-3) and both.bound == both.observed == frame.estimate.error_bound


def test_page_legend_describes_lines_and_estimate(play, frames):
    said = format_page_legend(play.scene)
    assert all(words in said for words in ("estimate", "simulated", "95 %", "scan", "tip to tumour"))
    assert "estimate" not in format_page_legend(replace(play.scene, observation_model=None))
    found = frames[1].estimate
    words = " ".join(describe_estimate(found))
    assert f"error {1e3 * found.error:.1f} mm; the simulated centre is inside the 95 % region" in words
    assert f"{len(found.observation.now)} points of the cortex, and where the tool touches; no force" in words
    assert "is outside the" in " ".join(describe_estimate(replace(found, true_motion=np.ones(3))))


def test_missing_locator_message_names_the_command(box, tmp_path, capsys):
    with pytest.raises(InputError, match="sulcus locator"):
        PatientSetup(box, None, {}, "cpu").build_stage(replace(short(), observation_model=SIGHT))
    write_anatomy(tmp_path / "box.vtu", box)
    words = ["--anatomy", str(tmp_path / "box.vtu"), "--device", "cpu", "--out", str(tmp_path / "out")]
    assert main(["render", "sag", *words]) == 2
    said = capsys.readouterr().err
    assert "has no locator at" in said and not (tmp_path / "out").exists()
    assert "sulcus train" not in said and "is the truth, as finite elements have it" in said


def test_scene_rejects_locator_of_other_region_stiffness(theatre, scene):
    other = replace(theatre)
    other.__dict__["locator"] = replace(theatre.locator, regions=(Region(PART_LABELS["oedema"], 0.5),))
    with pytest.raises(InputError, match=r"another stiffness of region 3 \(oedema\) than the scene\."):
        other.build_stage(scene)


def test_observation_scene_offers_only_fem_as_truth(scene):
    theatre = open_theatre(device="cpu")
    assert theatre.list_deformers(scene) == ("fem",) and theatre.list_deformers(
        replace(scene, observation_model=None)
    ) != ("fem",)


def test_template_locator_passes_check_in_all_sighted_scenes(capsys):
    assert to_locator_path(get_template_path()).stat().st_size < 8_000_000
    assert main(["check", *SIGHTED, "--every", "40", "--device", "cpu", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["scenes"]
    assert [row["scene"] for row in rows] == list(SIGHTED)
    for row in rows:
        assert row["covered"] >= 0.9 and row["removed"] > 0.3 and row["motion_mm"] > 1.5 and row["deformer"] == "fem"
