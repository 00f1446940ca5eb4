"""Planned trajectories: entry and direction of the tool, and rejected trajectories outside the craniotomy."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_sim_dural_septa import PLAN
from test_sim_head_masks import grid, head, nifti
from theatres import short

from scenes.cli import main
from scenes.options.placement_options import add_craniotomy_arguments, get_trajectory_path, to_craniotomy_args
from scenes.play.deformers import PatientSetup
from scenes.script.approach import Approach, parse_approach
from scenes.script.craniotomy_frame import CraniotomyFrame, build_craniotomy_frame
from scenes.script.scene import PALPATION, find_scene
from scenes.script.tool import Blade
from scenes.script.tool_paths import Touch, keep_idle, press
from sim.bodies.label_volume import build_volume_subject
from sim.bodies.markups import read_markup
from sim.bodies.meshfile import write_anatomy
from sim.bodies.subject import make_anatomy
from sim.errors import InputError
from sim.loads import Pushed


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A curved cortex, open over a tumour to the right and above."""
    affine, places = grid()
    path = nifti(tmp_path_factory.mktemp("approach") / "a.nii", head(places), affine)
    return build_craniotomy_frame(make_anatomy(build_volume_subject(path, (1,), (3,)), PLAN))


def marked(folder: Path, points: np.ndarray, kind: str = "Line") -> Path:
    """Points (n, 3) [m, RAS] as 3D Slicer saves them: in mm, LPS."""
    controls = [{"position": (1e3 * point * [-1.0, -1.0, 1.0]).tolist()} for point in points]
    markup = {"type": kind, "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": controls}
    path = folder / "plan.mrk.json"
    path.write_text(json.dumps({"markups": [markup]}))
    return path


def planned(
    site: CraniotomyFrame, right: float, up: float, tilt: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A point of the cortex, a direction, and a line through it from 40 mm outside to 30 mm inside."""
    entry = site.find_nearest(site.origin + right * site.right + up * site.up).point
    way = site.compute_direction(Touch(tilt=tilt))
    return entry, way, entry + np.outer([-40e-3, 30e-3], way)


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize(("right", "up", "tilt"), [(0.0, 0.0, (0.0, 0.0)), (9e-3, -6e-3, (0.5, -0.3))])
def test_tool_follows_entry_and_direction_of_trajectory(site, tmp_path, right, up, tilt, swapped):
    """For both drawing orders of the line; the scene's own positions and tilts are added."""
    entry, way, line = planned(site, right, up, tilt)
    approach = parse_approach(read_markup(marked(tmp_path, line[::-1] if swapped else line)), site)
    touch = approach.shift_path(press(0.3))(2.0)
    assert (
        np.linalg.norm(site.find_nearest(site.origin + touch.x * site.right + touch.y * site.up).point - entry) < 1e-4
    )
    np.testing.assert_allclose(site.compute_direction(touch), way, atol=1e-9)
    assert touch.force == pytest.approx(0.3)
    aside = approach.shift_path(lambda time: Touch(2e-3, 1e-3, tilt=(0.2, 0.0)))(0.0)
    assert aside.x == pytest.approx(touch.x + 2e-3) and aside.y == pytest.approx(touch.y + 1e-3)
    assert np.tan(aside.tilt[0]) == pytest.approx(np.tan(touch.tilt[0]) + np.tan(0.2))


def test_single_point_gives_entry_without_tilt(site, tmp_path):
    entry, _, _ = planned(site, 5e-3, 5e-3, (0.0, 0.0))
    approach = parse_approach(read_markup(marked(tmp_path, entry[None] - 2e-3 * site.axis, "Fiducial")), site)
    assert approach.tilt == pytest.approx((0.0, 0.0), abs=1e-12)
    assert np.hypot(approach.x - 5e-3, approach.y - 5e-3) < 2e-3


def test_trajectory_ending_near_the_cortex_is_extended(site, tmp_path):
    entry, way, _ = planned(site, 9e-3, -6e-3, (0.5, -0.3))
    through, *short = (
        parse_approach(read_markup(marked(tmp_path, entry + np.outer(ends, way))), site)
        for ends in ([-40e-3, 30e-3], [9e-3, 30e-3], [-40e-3, -9e-3])
    )
    for approach in short:
        assert [approach.x, approach.y, *approach.tilt] == pytest.approx([through.x, through.y, *through.tilt])


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.5, -0.3), (-0.2, 0.6)])
def test_probe_shaft_aligns_with_trajectory(site, tmp_path, tilt):
    """Points and blades leave the orientation of the tool unchanged."""
    entry, way, line = planned(site, 4e-3, 2e-3, tilt)
    approach = parse_approach(read_markup(marked(tmp_path, line)), site)
    held, plain = approach.align_tool(PALPATION), PALPATION
    turned, usual = (tool.pose(entry, site.axis, site.right) for tool in (held, plain))
    np.testing.assert_allclose(turned[:3, 2], -way, atol=1e-9)
    np.testing.assert_allclose(turned[:3, :3].T @ turned[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(turned[:3, :3]) == pytest.approx(1.0)
    centres = [pose[:3, 3] + plain.radius * pose[:3, 2] for pose in (turned, usual)]
    np.testing.assert_allclose(*centres, atol=1e-12)
    point = parse_approach(read_markup(marked(tmp_path, entry[None], "Fiducial")), site)
    assert point.align_tool(plain) == plain and approach.align_tool(Blade()) == Blade()


def test_trajectory_outside_the_craniotomy_is_rejected(site, tmp_path):
    _, _, line = planned(site, 0.0, 0.0, (0.0, 0.0))
    beside = line + 60e-3 * site.right
    oblique = site.origin + np.outer([-40e-3, 40e-3], site.compute_direction(Touch(tilt=(1.3, 0.0))))
    for points, kind, reason in (
        (beside, "Line", r"passes \d\d mm from the open cortex\. Open the skull where it enters: --opening-at"),
        (oblique, "Line", "runs at 74 degrees to the opening's axis, and 60 is the most"),
        (
            line + 130e-3 * site.axis,
            "Line",
            "ends 90 mm from where it would enter the open cortex, and 10 mm is the most",
        ),
        (line - 45e-3 * site.axis, "Line", "ends 15 mm from where it would enter"),
        (line[:1], "Fiducial", "its point lies 40 mm from the open cortex, and 10 mm is the most"),
        (line, "Fiducial", "is no trajectory"),
        (np.concatenate([line, line]), "Line", "is no trajectory"),
        (line, "ClosedCurve", "is no trajectory"),
    ):
        with pytest.raises(InputError, match=reason):
            parse_approach(read_markup(marked(tmp_path, points, kind)), site)


def test_trajectory_option_moves_the_tool_of_the_scene(site, tmp_path, capsys):
    """Scene `press`; near the rim a message names the stop at the bone; scenes without a tool are unchanged."""
    from scenes.options.patient_options import add_patient, build_requested_scene

    def asked(name: str, line: np.ndarray):
        parser = argparse.ArgumentParser()
        add_patient(parser)
        words = parser.parse_args(
            ["--trajectory", str(marked(tmp_path, line))], argparse.Namespace(program="sulcus demo")
        )
        return build_requested_scene(words, name, PatientSetup(site.anatomy, None, {}, "cpu"))

    entry, way, line = planned(site, 6e-3, 4e-3, (0.3, 0.1))
    scene = asked("press", line)
    pushed = scene.build_loads(site, scene.path(2.0), 2.0).get(Pushed)
    assert scene.tool == replace(PALPATION, lean=scene.tool.lean, turn=scene.tool.turn) != PALPATION
    assert pushed is not None and np.linalg.norm(pushed.point[0] - entry) < 1e-4
    np.testing.assert_allclose(pushed.force[0] / np.linalg.norm(pushed.force[0]), way, atol=1e-9)
    assert capsys.readouterr().err == ""
    asked("press", planned(site, site.clearance - 2e-3, 0.0, (0.0, 0.0))[2])
    assert "plan.mrk.json enters, the bone's edge stops the tool" in capsys.readouterr().err
    assert asked("sag", line).path(1.0) == find_scene("sag").path(1.0) == keep_idle(1.0)
    assert "sag has no tool that could follow" in capsys.readouterr().err


def test_render_command_rejects_trajectory_off_the_cortex(site, tmp_path, capsys):
    write_anatomy(tmp_path / "a.vtu", site.anatomy)
    line = marked(tmp_path, planned(site, 0.0, 0.0, (0.0, 0.0))[2] + 60e-3 * site.right)
    words = ["render", "press", "--anatomy", str(tmp_path / "a.vtu"), "--out", str(tmp_path / "out"), "--device", "cpu"]
    assert main([*words, "--trajectory", str(line)]) == 2
    assert "mm from the open cortex" in capsys.readouterr().err


def test_opening_options_give_trajectory_only_for_lines(site, tmp_path):
    parser = argparse.ArgumentParser()
    add_craniotomy_arguments(parser)
    line = planned(site, 0.0, 0.0, (0.0, 0.0))[2]
    for points, kind, found in ((line, "Line", True), (line[:1], "Fiducial", False)):
        path = marked(tmp_path, points, kind)
        for option in ("--opening-at", "--opening-over"):
            assert get_trajectory_path(parser.parse_args([option, str(path)])) == (path if found else None)
    assert get_trajectory_path(parser.parse_args([])) is None
    words = ["--nodes=5300", "--opening-at=1.0,2.0,3.0", "--fine-opening"]
    assert to_craniotomy_args(parser.parse_args(words[1:])) == words
    assert to_craniotomy_args(parser.parse_args([])) == words[:1]


def test_approach_at_origin_leaves_the_path_unchanged():
    assert Approach(0.0, 0.0).shift_path(short().path)(0.7) == short().path(0.7)
