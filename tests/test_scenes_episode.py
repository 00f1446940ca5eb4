"""Scenes as files: stored episodes, frames and videos."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from limits import files_below
from theatres import player, put, short

from ar.optics.camera import Camera, project_cv2
from scenes.cli import main
from scenes.episodes.episode import DEPTH_SCALE, collect
from scenes.episodes.reading.contents import read_contents
from scenes.episodes.reading.schema import ARRAYS, PICTURES
from scenes.episodes.reading.validation import check_mask, validate_episode
from scenes.play.player import STAGES
from scenes.play.stage import CORTEX, DRAPE, TOOL
from scenes.script.tool_paths import press
from scenes.script.viewpoint import PLAIN_APPEARANCE
from sim.accuracy import TRAIN
from sim.effects import Held, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import push
from surrogate.data.solution_rows import read_tissue_text


@pytest.fixture(scope="module")
def anatomy(theatre, tmp_path_factory):
    return put(theatre, tmp_path_factory.mktemp("records") / "box.vtu")


@pytest.fixture
def brief(monkeypatch):
    """The commands find a scene of seven small frames."""
    monkeypatch.setattr("scenes.script.scene.find_scene", lambda name: short())


@pytest.fixture(scope="module")
def episode(theatre, tmp_path_factory):
    path = tmp_path_factory.mktemp("episode") / "press.h5"
    play = replace(player(theatre, replace(short(), look=PLAIN_APPEARANCE), "linear"), motion_error=None)
    report = collect(path, theatre, play, "linear", iter)
    assert list(path.parent.iterdir()) == [path]
    with h5py.File(path, "r") as file:
        yield report, file, play, list(play.play_frames())


def decode_recorded(file, name, number, flag=cv2.IMREAD_UNCHANGED):
    return cv2.imdecode(file["pictures"][name][number], flag)


class TestEpisode:
    def test_stored_images_match_rendered_images(self, episode):
        _, file, _, frames = episode
        assert file.attrs["depth_scale_m"] == DEPTH_SCALE and len(file["pictures/colour"]) == len(frames) == 7
        for frame in frames:
            # Thin lines over the tool cost JPEG more than the scene alone.
            for name, truth, most in (("colour", frame.picture.colour, 2.0), ("overlay", frame.shown, 2.2)):
                picture = decode_recorded(file, name, frame.number, cv2.IMREAD_COLOR)[..., ::-1]
                assert picture.shape == truth.shape
                assert np.abs(picture.astype(int) - truth).mean() < most
            depth = decode_recorded(file, "depth", frame.number)
            assert depth.dtype == np.uint16
            assert np.abs(depth * DEPTH_SCALE - frame.picture.depth).max() <= 0.51 * DEPTH_SCALE
            assert np.array_equal(depth == 0, frame.picture.depth == 0.0)
            assert np.array_equal(decode_recorded(file, "segmentation", frame.number), frame.picture.segmentation)

    def test_validation_accepts_new_episode_and_all_its_arrays(self, episode, box):
        _, file, _, _ = episode
        path = Path(file.filename)
        assert validate_episode(path).problems == []
        assert check_mask(file, read_contents(path), box) == ([], [])
        assert set(file["pictures"]) <= set(PICTURES) and set(file) - {"pictures"} <= set(ARRAYS)

    def test_frame_is_recomputed_from_attributes_of_the_file(self, episode, box):
        """Tissue, element, tool, load and solver are those in the file's attributes."""
        _, file, _, _ = episode
        said, number = file.attrs, 3
        effects = (read_tissue_text({name: str(text) for name, text in said.items()}), Held(), ToolForce())
        fem = Fem(box, effects, TRAIN, "cpu", element=said["element"])
        assert said["anatomy"] == box.digest and said["finite_elements"] == fem.description
        load = push(file["contact"][number], file["force"][number], float(said["footprint_m"]))
        moved = fem.deform(load, at=file["tumour_nodes"][:]).displacement[0]
        found = file["tumour_fem"][number] - file["tumour_rest"][:]
        assert np.linalg.norm(moved - found) < 2e-3 * np.linalg.norm(found) > 0.0
        assert len(said["model_digest"]) == 16 and said["date"][:2] == "20" and "Probe" in said["tool"]

    def test_stored_tip_distance_equals_distance_of_the_frame(self, episode):
        _, file, _, frames = episode
        for name in ("distance", "distance_error"):
            expected = [np.nan if getattr(frame, name) is None else getattr(frame, name) for frame in frames]
            np.testing.assert_allclose(file[name][:], expected, rtol=1e-12)
        assert np.isfinite(file["distance"][:]).all()

    @pytest.mark.parametrize("attribute", ["unit", "meaning"])
    def test_each_array_has_a_description_attribute(self, episode, attribute):
        _, file, _, _ = episode
        bare = []
        file.visititems(lambda name, item: bare.append(name) if attribute not in item.attrs else None)
        assert bare == ["pictures"]  # a group

    def test_camera_projects_the_tumour_onto_its_mask(self, episode):
        _, file, _, _ = episode
        width, height = int(file.attrs["width"]), int(file.attrs["height"])
        for number in (0, 3):
            camera = Camera(file["K"][:], file["T_camera_world"][number], width, height)
            column, row = np.rint(project_cv2(camera, file["tumour_predicted"][number])).astype(int).T
            mask = decode_recorded(file, "tumour_mask", number) > 0
            assert mask.shape == (height, width) and 0.003 < mask.mean() < 0.2
            grown = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5)))  # a corner lies on the border
            assert grown[row, column].all()
            rows, columns = np.nonzero(mask)
            for pixels, corners in ((rows, row), (columns, column)):
                assert abs(pixels.min() - corners.min()) <= 2 and abs(pixels.max() - corners.max()) <= 2

    def test_depth_and_camera_reconstruct_the_cortex(self, episode):
        _, file, play, frames = episode
        camera = Camera(file["K"][:], file["T_camera_world"][0], frames[0].camera.width, frames[0].camera.height)
        pixels = np.argwhere(decode_recorded(file, "segmentation", 0) == CORTEX)
        depth = decode_recorded(file, "depth", 0)[tuple(pixels.T)] * DEPTH_SCALE
        height = camera.unproject(pixels[:, ::-1].astype(float), depth) @ play.site.axis
        assert len(height) > 1000 and np.abs(height).max() < 2e-5  # the box is flat, its top at zero

    def test_stored_motion_equals_motion_of_the_frames(self, episode, theatre):
        _, file, play, frames = episode
        nodes = theatre.anatomy.tumour_nodes
        rest = theatre.anatomy.mesh.nodes[nodes]
        assert np.array_equal(file["tumour_nodes"][:], nodes) and np.array_equal(file["tumour_rest"][:], rest)
        assert np.allclose(file["time"][:], play.scene.times)
        for frame in frames:
            assert np.array_equal(file["T_world_tool"][frame.number], frame.pose)
            assert np.array_equal(file["tip"][frame.number], frame.tip)
            assert np.allclose(file["force"][frame.number], frame.touch.force * play.site.axis)
            assert np.allclose(file["contact"][frame.number], play.site.origin)
            guess = rest + frame.deformation.restrict(nodes).displacement[0]
            assert np.allclose(file["tumour_predicted"][frame.number], guess, atol=1e-12)
        alone = (
            player(theatre, short(), "fem").draw(3, 0.1, short().path(0.1)).deformation.restrict(nodes).displacement[0]
        )
        truth = file["tumour_fem"][3] - rest
        assert np.linalg.norm(alone, axis=1).mean() > 3e-4
        assert np.linalg.norm(truth - alone, axis=1).max() < 2e-5
        np.testing.assert_allclose(file["reaction_fem"][:, 0, :3], file["force"][:], atol=1e-12)
        assert file["seconds"].shape == (7, 3) and tuple(file["seconds"].attrs["stages"]) == STAGES
        assert file["tumour_left"][:].all()  # nothing is cut in this scene

    def test_episode_arrays_have_units_and_metadata(self, episode, theatre):
        report, file, _, _ = episode
        units = {name: file[name].attrs["unit"] for name in file if "unit" in file[name].attrs}
        assert units == {
            "time": "s", "T_camera_world": "m", "T_world_tool": "m", "tip": "m", "force": "N", "contact": "m",
            "tumour_predicted": "m", "tumour_fem": "m", "seconds": "s", "tumour_rest": "m", "bound": "m",
            "cortex_predicted": "m", "cortex_fem": "m", "cortex_rest": "m", "cortex_nodes": "1", "fem_frames": "1",
            "reaction_fem": "N, N m", "K": "pixel", "tumour_nodes": "1", "tumour_left": "1",
            "outcome_predicted": "text", "outcome_fem": "text", "distance": "m", "distance_error": "m",
            "model_error": "m", "tumour_error": "m", "tumour_error_unobserved": "m",
        }  # fmt: skip
        assert "1e-05 m" in file["pictures/depth"].attrs["unit"]
        assert file.attrs["anatomy"] == theatre.anatomy.digest and file.attrs["deformer"] == "linear"
        assert "RAS" in file.attrs["world_frame"] and "OpenCV" in file.attrs["camera_frame"]
        for label in (f"{CORTEX} cortex", f"{DRAPE} drape", f"{TOOL} tool"):
            assert label in file.attrs["segmentation"]
        for who, outcome in (("predicted", "PREDICTED"), ("fem", "CONVERGED")):
            assert [name.decode() for name in file[f"outcome_{who}"][:]] == 7 * [outcome]
        assert file["bound"].shape == (7, 2) and (np.diff(file["bound"][:]) >= 0.0).all()
        assert report["frames"] == 7 and report["fem"] == {"converged": 7}

    @pytest.mark.parametrize("blow", [KeyboardInterrupt, RuntimeError])
    def test_interrupted_episode_leaves_no_file(self, theatre, tmp_path, blow):
        def stop(frames):
            for number, frame in enumerate(frames):
                if number == 2:
                    raise blow
                yield frame

        with pytest.raises(blow):
            collect(tmp_path / "press.h5", theatre, player(theatre, short(), "linear"), "linear", stop)
        assert not list(tmp_path.iterdir())

    def test_interruption_keeps_the_existing_episode_file(self, theatre, tmp_path):
        path = tmp_path / "press.h5"
        path.write_bytes(b"earlier")
        with pytest.raises(ZeroDivisionError):
            collect(path, theatre, player(theatre, short(), "linear"), "linear", lambda frames: [1 / 0])
        assert path.read_bytes() == b"earlier" and list(tmp_path.iterdir()) == [path]

    def test_collect_rejects_a_folder_that_is_a_file(self, theatre, tmp_path):
        (tmp_path / "file").touch()
        with pytest.raises(InputError, match="Choose another folder"):
            collect(tmp_path / "file" / "a.h5", theatre, player(theatre, short(), "linear"), "linear", iter)

    @pytest.mark.parametrize(("size", "most"), [(40_000, 4), (150_000, 7)])
    def test_collect_reports_a_full_disk_as_input_error(self, theatre, tmp_path, size, most, monkeypatch):
        """HDF5 aborts the process on a failed write: it does not write to the disk itself."""
        # The check before the start finds enough space.
        monkeypatch.setattr("scenes.episodes.episode.check_disk_space", lambda *asked: None)
        drawn, play = [], player(theatre, short(), "linear")
        with files_below(size), pytest.raises(InputError, match=r"press\.h5: cannot be written \(File too large\)"):
            collect(
                tmp_path / "press.h5", theatre, play, "linear",
                lambda frames: (drawn.append(1) or frame for frame in frames),
            )  # fmt: skip
        assert not list(tmp_path.iterdir())
        assert len(drawn) <= most  # the rest is not drawn in vain

    def test_collect_command_writes_episode_and_json_report(self, brief, anatomy, tmp_path, capsys):
        out = tmp_path / "new" / "press.h5"
        words = ["collect", "press", "--anatomy", str(anatomy), "--deformer", "fem", "--out", str(out), "--json"]
        assert main(words) == 0
        text = capsys.readouterr().out
        assert json.loads(text)["frames"] == 7 and text.count("\n") == 1
        with h5py.File(out) as file:
            moved = np.linalg.norm(file["tumour_fem"][:] - file["tumour_predicted"][:], axis=2).max()
            assert moved < 3e-5 and file.attrs["deformer"] == "fem"


RENDER = ("render", "press", "--deformer", "linear", "--anatomy")


class TestRender:
    def test_render_command_writes_frames_and_video(self, brief, anatomy, tmp_path, capsys):
        frames, film = tmp_path / "a" / "frames", tmp_path / "film.mp4"
        words = [*RENDER, str(anatomy), "--out", str(frames), "--every", "2", "--json"]
        assert main([*words, "--film", str(film)]) == 0
        report = json.loads(capsys.readouterr().out)
        assert report["frames"] == 4 and report["not_good"] == 0 and report["deformer"] == "linear"
        names = sorted(path.name for path in frames.iterdir())
        assert names == [f"frame_{number:04d}.png" for number in (0, 2, 4, 6)]
        pictures = [cv2.imread(str(frames / name)) for name in names]
        assert {picture.shape for picture in pictures} == {(240, 320, 3)}
        assert (pictures[0] != pictures[2]).any()
        video = cv2.VideoCapture(str(film))
        assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 4 and video.get(cv2.CAP_PROP_FPS) == pytest.approx(15.0)
        video.release()
        assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "film.mp4"]

    def test_render_plain_writes_frames_without_cost_label(self, brief, anatomy, theatre, tmp_path, capsys):
        words = [*RENDER, str(anatomy), "--every", "3", "--plain", "--out", str(tmp_path)]
        assert main(words) == 0
        assert "3 frames by linear" in capsys.readouterr().out
        shown = [frame.shown for frame in player(theatre, short(), "linear").play_frames(every=3)]
        for number, colour in zip((0, 3, 6), shown, strict=True):
            assert np.array_equal(cv2.imread(str(tmp_path / f"frame_{number:04d}.png"))[..., ::-1], colour)

    def test_render_exits_with_1_for_unreliable_solutions(self, anatomy, tmp_path, monkeypatch, capsys):
        strong = replace(short(), path=press(0.8, rise=0.1, hold=0.0))
        monkeypatch.setattr("scenes.script.scene.find_scene", lambda name: strong)
        words = ["render", "press", "--deformer", "linear", "--anatomy", str(anatomy), "--out", str(tmp_path), "--json"]
        assert main(words) == 1
        assert 2 <= json.loads(capsys.readouterr().out)["not_good"] <= 5


def test_oversized_episode_is_rejected_at_the_start(theatre, tmp_path):
    play = player(theatre, short(), "linear")
    with files_below(100_000), pytest.raises(InputError, match=r"files are limited to 0\.1 MB"):
        collect(tmp_path / "press.h5", theatre, play, "linear", iter)
    assert not list(tmp_path.iterdir())
