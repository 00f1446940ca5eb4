"""Plans of data sets: limits, independent sampling of each episode, and stored parameters."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from conftest import make_box

from scenes.episodes.checksums import find_errors
from scenes.episodes.make import make_body, make_episode, to_episode_path
from scenes.episodes.plan import load_plan, parse_plan
from scenes.episodes.scripted import sample_episode
from scenes.play.deformers import open_theatre
from sim.anatomy import TUMOUR_LABEL
from sim.bodies.meshfile import write_anatomy
from sim.effects import Elasticity, build_push_effects
from sim.errors import InputError
from sim.material import BRAIN, Material
from sim.runtime.device import find_device
from sim.runtime.memory import check_fits
from surrogate.data.solution_rows import describe_tissue_source, read_tissue_text
from surrogate.model.applicability import find_rejection

TINY = """
title = "tiny"
seconds = 0.5
frames_per_second = 8.0
size = [96, 72]
solved_every = 3
[motion.press]
[motion.walk]
[look]
path = "hand-held"
stereo = 1
cottonoids = 1
glove = 1
[noise]
grey_levels = 4
force_n = 0.01
tool_mm = 1
"""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[motion.press]\nforce_n = [0.5, 0.1]", r"motion.press.force_n: from 0.5 to 0.1 is upside down"),
        ("[motion.press]\nforce_n = [0.5, 100]", r"motion.press.force_n: 100.0 may be drawn, and 0.01 to 2"),
        ("[motion.press]\nforce_n = {log = [0, 1]}", "logarithmic range starts above 0"),
        ("[motion.press]\nforce_n = {normal = [0.1, 0.1]}", "motion.press.force_n: -0.2"),
        ("[motion.press]\nforce_n = {choice = [0.1], weights = [1, 2]}", "2 weights for 1 values"),
        ("[motion.press]\nforce_n = {}", "give one of uniform, log, normal and choice, not none"),
        ("[motion.press]\nforce_n = [nan, 1.0]", "upside down"),
        ("[motion.press]\n[look]\npath = 'flying'", "look.path: 'flying' is not known: choose from fixed"),
        ("[motion.kick]", "motion.kick: there is no such key"),
        ("[motion.press]\nforce_n = '3'", "motion.press.force_n: give a number or a table or a list, and not text"),
        ("[motion.press]\n[bodies.tumour]\nradius_mm = 12", "only drawn anatomies have such a tumour"),
        ("[motion.press]\nweight = 0", "with a weight above 0"),
        ("[motion.press]\n[bodies]\ncount = 0", "bodies.count: 0 is outside"),
        ("[motion.press]\n[bodies]\nanatomies = 'mine'", "bodies.anatomies: 'mine' is invalid"),
        ("[motion.press]\n[bodies]\nanatomies = '../../etc/x.vtu'", "is outside the plan's folder"),
        ("[motion.press]\n[bodies]\nanatomies = '/etc/x.vtu'", "is outside the plan's folder"),
        ("[motion.press]\n[bodies.tissue]\noedema_ratio = 0.5", "only an own anatomy may have oedema"),
        ("[motion.press]\n[bodies.learner]\nname = 'gpt'", "no learner is called gpt"),
        ("[motion.press]\nforce_n = {choice = [1, 2], weights = [1e308, 1e308]}", "weights .* are none"),
        ("[motion.press]\nweight = inf", "motion.press.weight: inf is outside 0 to 100,000"),
        ("[motion.press]\n[hand]\ntremor_mm = nan", "hand.tremor_mm: nan may be drawn"),
        (f"seconds = {'[' * 5000}", "recursion"),
        ("[motion.press", "docs/datasets_make.md says"),
        ("", "motion"),
    ],
)
def test_invalid_plan_is_rejected_with_its_reason(text, said):
    with pytest.raises(InputError, match=said):
        parse_plan(f'title = "x"\n{text}', "mine")


def test_unknown_plan_is_rejected_with_known_names(tmp_path):
    with pytest.raises(InputError, match="there is no plan 'big': choose hard, small, standard"):
        load_plan("big")
    (tmp_path / "own.toml").write_text(TINY)
    assert load_plan(str(tmp_path / "own.toml")).digest == parse_plan(TINY, "own").digest


def test_plan_with_too_long_name_or_text_is_rejected(tmp_path):
    with pytest.raises(InputError, match="there is no plan"):
        load_plan(f"{'long' * 500}.toml")
    (tmp_path / "long.toml").write_text(f"{TINY}#{'x' * 10_000_000}")
    with pytest.raises(InputError, match="is longer than a plan may be"):
        load_plan(str(tmp_path / "long.toml"))


def test_plan_digest_depends_on_its_anatomy_file(box, tmp_path):
    path, text = tmp_path / "own.toml", f"{TINY}[bodies]\nanatomies = 'box.vtu'\n[bodies.learner]\nname = 'none'\n"
    path.write_text(text)
    with pytest.raises(InputError, match=r"box.vtu: cannot be read as an anatomy: no such file.*next to the plan"):
        load_plan(str(path))
    write_anatomy(tmp_path / "box.vtu", box)
    plan = load_plan(str(path))
    assert load_plan(str(path)).digest == plan.digest != parse_plan(text, "own").digest
    write_anatomy(tmp_path / "box.vtu", make_box(cells=(6, 6, 4), spacing=12e-3))
    assert load_plan(str(path)).digest != plan.digest
    assert "box.vtu: has changed since the plan was read" in make_body(tmp_path / "set", plan, 1, 0, "cpu").failed


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder, plan = tmp_path_factory.mktemp("set"), parse_plan(TINY, "tiny")
    assert not make_body(folder, plan, 1, 0, "cpu").failed
    return folder, plan, make_episode(folder, plan, 1, 5, "cpu")


def test_episode_stores_plan_seed_and_parameters(made):
    folder, plan, episode = made
    assert episode.path == to_episode_path(folder, 5) and episode.frames == 5 and not episode.failed
    with h5py.File(episode.path) as file:
        assert file.attrs["plan"] == TINY and file.attrs["plan_digest"] == plan.digest and not find_errors(file)
        assert (file.attrs["seed"], file.attrs["episode"], file.attrs["solved_every"]) == (1, 5, 3)
        drawn = sample_episode(plan.contents, 1, 5)
        stated = json.loads(file.attrs["parameters"])
        assert file.attrs["family"] == drawn.family and drawn.values.items() <= stated.items()
        assert file["fem_frames"][:].tolist() == [0, 3] and file["cortex_fem"].shape[0] == 2
        off = np.linalg.norm(file["tumour_fem"][:] - file["tumour_predicted"][:][[0, 3]], axis=2)
        moved = np.linalg.norm(file["tumour_fem"][1] - file["tumour_rest"][:], axis=1)
        assert off.max() < 0.2 * moved.max() > 1e-5
        assert 0.0 < np.abs(file["force_read"][:] - file["force"][:]).max() < 0.06
        assert not np.allclose(file["T_world_tool"][:], file["T_world_tool_tracked"][:], atol=1e-5)
        base = file["T_camera_world_right"][:] @ np.linalg.inv(file["T_camera_world"][:])
        assert np.allclose(np.linalg.norm(base[:, :3, 3], axis=1), 24e-3, atol=1e-4)
        assert "date" not in file.attrs and "seconds" not in file


def test_episode_has_identical_bytes_in_any_folder(made, tmp_path):
    _, plan, episode = made
    make_body(tmp_path, plan, 1, 0, "cpu")
    make_episode(tmp_path, plan, 1, 6, "cpu")
    again = make_episode(tmp_path, plan, 1, 5, "cpu")
    assert again.path.read_bytes() == episode.path.read_bytes()
    assert to_episode_path(tmp_path, 6).read_bytes() != episode.path.read_bytes()
    assert make_episode(tmp_path, plan, 1, 5, "cpu").skipped and make_body(tmp_path, plan, 1, 0, "cpu").skipped


def test_changed_value_breaks_a_checksum(made, tmp_path):
    path = tmp_path / "changed.h5"
    path.write_bytes(made[2].path.read_bytes())
    with h5py.File(path, "r+") as file:
        file["tumour_predicted"][1, 0, 0] += 1e-9
        assert find_errors(file) == ["/tumour_predicted: is not as it was written"]
        file.attrs["seed"] = 2
        assert "attributes" in find_errors(file)[1]


def test_body_that_cannot_be_meshed_fails_with_reason(tmp_path):
    plan = parse_plan(f"{TINY}[bodies]\nanatomies = 'drawn'\n[bodies.tumour]\nradius_mm = 35\ncover_mm = 1\n", "big")
    body = make_body(tmp_path, plan, 1, 0, "cpu")
    assert "none of 6 anatomies that were drawn can be meshed; the last: a " in body.failed
    assert not list(tmp_path.glob("bodies/*"))
    with pytest.raises(InputError, match="is not a body of a data set"):
        make_episode(tmp_path, plan, 1, 0, "cpu")


def test_memory_shortage_is_raised_and_marks_no_failed_body(tmp_path, monkeypatch):
    """Memory may become free: the engine tries again."""

    def full(*args):
        check_fits(10**9, 10**6, 1, find_device("cpu", "float64"))

    monkeypatch.setattr("scenes.episodes.make.write_body", full)
    with pytest.raises(InputError, match="are free"):
        make_body(tmp_path, parse_plan(TINY, "tiny"), 1, 0, "cpu")
    assert not list(tmp_path.glob("bodies/*"))


def test_model_states_the_tissue_of_its_regions():
    tissue = Elasticity(BRAIN, {TUMOUR_LABEL: Material("neo-hookean", 9000.0, 0.49)})
    assert read_tissue_text(describe_tissue_source(tissue)) == tissue and read_tissue_text(
        describe_tissue_source(Elasticity(BRAIN))
    ) == Elasticity(BRAIN)
    theatre = open_theatre()
    model = theatre.models["series-gp"]
    other = replace(model, training={**model.training, **describe_tissue_source(tissue)})
    here = build_push_effects(theatre.anatomy, tissue)
    assert find_rejection(other, here) is None
    assert "region 2" in (find_rejection(model, here) or "") and find_rejection(
        other, build_push_effects(theatre.anatomy, BRAIN)
    )
    assert "region 2" in other.source
