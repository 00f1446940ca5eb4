"""Models of poses in relaxing tissue: history, training and playback."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.play.deformers import GUARDED, PatientSetup
from scenes.script.scene import find_scene
from scenes.script.tool import Probe
from sim.accuracy import REFERENCE
from sim.anatomy import Anatomy
from sim.deformation import Deformation, Outcome, build_start
from sim.effects import Elasticity, Held, ToolContact, build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Pushed, Touching
from sim.material import Material, to_tissue_json
from sim.tools import Ball
from surrogate.data.cortex_patch import open_patch
from surrogate.data.dataset import read_dataset
from surrogate.data.encode import compute_tool_features
from surrogate.data.indentation import RelaxingPushes, add_relaxation, get_poses, get_relaxation, to_indentation
from surrogate.data.load_histories import APPROACH_TIME, HISTORY, read_prony_series, sample_times
from surrogate.data.simulate import simulate
from surrogate.data.tool_poses import draw_poses
from surrogate.evaluation.score import compute_point_errors
from surrogate.model.applicability import find_rejection
from surrogate.model.guarded import Guarded, describe_error
from surrogate.model.relaxation import MEMORY_KEY, RelaxationState, update_relaxation
from surrogate.model.store import load, save
from surrogate.model.tool_contact import compute_wrench
from surrogate.onnx_export.export import build_onnx_model
from surrogate.training.fem_tables import condense_contact
from surrogate.training.train import train

SERIES = ((0.4, 0.5), (0.3, 20.0))
SOFT = Material("neo-hookean", 3000.0, 0.45, prony=SERIES)
BALL = Ball(6e-3)
EFFECTS = (Elasticity(SOFT), Held(), ToolContact((BALL,)))
SAID = {
    "shape": repr(BALL),
    "tissue": to_tissue_json(SOFT),
    "effects": repr(EFFECTS),
    "element": "p1",
    "history": HISTORY,
}


def pressed(depth: float, x: float = 0.0) -> Pushed:
    return Pushed(np.array([[x, 0.0, 0.0]]), np.array([[0.0, 0.0, -depth]]), np.array([BALL.radius]))


def start_of(past: RelaxationState, time: float) -> Deformation:
    return replace(build_start(np.zeros((1, 1, 3))), memory={MEMORY_KEY: past.memory}, time=np.array([time]))


def played(depths: list[float], times: list[float], x: list[float] | None = None) -> list[RelaxationState]:
    """The frames of a tool that was in the air before."""
    found = [update_relaxation(SERIES, pressed(0.0), np.zeros(1), None, 1e-4)]
    for depth, before, time, place in zip(depths, [0.0, *times], times, x or [0.0] * len(times), strict=False):
        start = start_of(found[-1], before)
        found.append(update_relaxation(SERIES, pressed(depth, place), np.array([time]), start, 1e-4))
    return found[1:]


def test_relaxed_share_equals_the_hereditary_integral():
    """Tool that approaches linearly within one second and stays: closed form, frames of 30 ms."""
    times = list(np.arange(1, 91) / 30.0)
    found = played([4e-3 * min(t, 1.0) for t in times], times)
    for frame in (14, 29, 89):
        t = times[frame]
        coming = min(t, 1.0)
        left = sum(g * tau / coming * (np.exp(-(t - coming) / tau) - np.exp(-t / tau)) for g, tau in SERIES)
        assert found[frame].relaxed_share[0] == pytest.approx(0.7 - left, abs=2e-4)
        assert not found[frame].outside_training[0]


def test_histories_outside_training_are_marked():
    """A held tool that retracts, or one that slides far; a first contact is not marked."""
    back = played([4e-3, 4e-3, 3e-3, 0.0], [0.5, 6.0, 6.1, 6.2])
    assert [bool(each.outside_training[0]) for each in back] == [False, False, True, True]
    assert back[3].relaxed_share[0] == 0.0
    slid = played([4e-3] * 3, [0.5, 1.0, 1.5], [0.0, 2e-3, 4e-3])
    assert [bool(each.outside_training[0]) for each in slid] == [False, False, True]


def test_start_without_matching_history_is_rejected():
    late = start_of(played([1e-3], [2.0])[0], 2.0)
    with pytest.raises(InputError, match=r"the start is 1 s later than the loads"):
        update_relaxation(SERIES, pressed(1e-3), np.ones(1), late, 1e-4)
    with pytest.raises(InputError, match="does not say how far the tissue has relaxed"):
        update_relaxation(SERIES, pressed(1e-3), np.ones(1), replace(late, memory={}), 1e-4)


class Fading:
    """Answers histories of a ball as linear tissue, which moves less as it relaxes, and pushes much less."""

    def __init__(self, anatomy: Anatomy):
        self.anatomy, self.patch = anatomy, open_patch(anatomy)
        fem = Fem(anatomy, build_push_effects(anatomy, SOFT), REFERENCE, "cpu", element="p1")
        cortex = np.setdiff1d(self.patch.nodes, anatomy.tumour_nodes)
        self.contact, self.bases = condense_contact(fem, [anatomy.tumour_nodes, cortex], BALL)

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        pushed = to_indentation(loads, BALL, self.patch)
        share = update_relaxation(SERIES, pushed, loads.times, start, 1e-4).relaxed_share[:, None]
        X, count = compute_tool_features(self.patch, pushed), len(loads)
        answered = self.contact.compute_linear(X) * X[:, 6:7] * (1.0 - 0.3 * share)
        split, moved = len(self.bases[0].modes), np.zeros((count, len(self.anatomy.mesh.nodes), 3))
        for basis, coefficients in zip(self.bases, (answered[:, :split], answered[:, split:]), strict=True):
            moved[:, basis.nodes] = basis.decode(coefficients)
        force = self.contact.compute_nodal_forces(X).reshape(count, -1, 3).sum(axis=1) * (1.0 - share)
        reaction, nodes = compute_wrench(force, get_poses(loads, BALL), BALL), np.arange(moved.shape[1])
        outcome = (Outcome.CONVERGED,) * count
        answer = Deformation(moved, nodes, outcome, np.zeros(count, int), np.zeros(count), loads.times, reaction)
        return answer if at is None else answer.restrict(at)


@pytest.fixture(scope="module")
def data(tmp_path_factory, box):
    path = tmp_path_factory.mktemp("relaxing") / "data.h5"
    causes = draw_poses("palpation", box, 80, 0, BALL).causes
    simulate(path, Fading(box), Loads(causes, sample_times(80, 0)), SAID)
    return read_dataset(path)


@pytest.fixture(scope="module")
def model(data):
    return train(data, ["contact"]).models["contact"]


def test_relaxation_model_predicts_and_round_trips(tmp_path, model, box):
    """Motion and force at new poses and times, from a file too; training needs the times."""
    assert model.series == SERIES
    causes, nodes = draw_poses("palpation", box, 30, 77, BALL).causes, box.tumour_nodes
    fresh, truth = Loads(causes, sample_times(30, 77)), Fading(box)
    answer, right = model.deform(fresh), truth.deform(fresh)
    moved = right.restrict(nodes).displacement
    assert compute_point_errors(model, fresh, moved, nodes).mean() < 0.01 * np.linalg.norm(moved, axis=2).mean()
    force = np.linalg.norm(right.reaction[:, 0, :3], axis=1)
    assert np.linalg.norm((answer.reaction - right.reaction)[:, 0, :3], axis=1).mean() < 0.02 * force.mean()
    assert np.isfinite(answer.bound).any() and np.isfinite(answer.reaction_bound).any()
    save(tmp_path / "model.npz", {"contact": model})
    again = load(tmp_path / "model.npz", box)["contact"]
    assert again.series == SERIES
    np.testing.assert_array_equal(again.deform(fresh).displacement, answer.displacement)


def test_predictions_follow_the_load_history(model, box):
    """The force of a held tool decreases with its history; after lifting off it is extrapolated."""
    loads = draw_poses("palpation", box, 3, 5, BALL)
    touching = loads.get(Touching)
    assert touching is not None
    answer, forces = None, []
    for time in (APPROACH_TIME, 1.5, 3.0, 9.0):
        answer = model.deform(Loads(loads.causes, np.full(3, time)), answer)
        forces.append(np.linalg.norm(answer.reaction[:, 0, :3], axis=1))
    assert answer is not None and (np.diff(forces, axis=0) < 0.0).all()
    alone = model.deform(Loads(loads.causes, np.full(3, 9.0)))
    np.testing.assert_allclose(answer.displacement, alone.displacement, atol=1e-9)
    apart = model.predict_distance(Loads(loads.causes, np.full(3, 9.0)), answer)
    np.testing.assert_allclose(
        apart.distance, model.predict_distance(Loads(loads.causes, np.full(3, 9.0))).distance, atol=1e-9
    )
    up = touching.pose.copy()
    up[:, 0, 2, 3] += 0.05
    lifted = model.deform(Loads((Touching(up),), np.full(3, 9.1)), answer)
    assert lifted.outcome == (Outcome.EXTRAPOLATED,) * 3 and np.abs(lifted.displacement).max() == 0.0


def test_pose_features_end_with_the_relaxed_share(box):
    pushed = to_indentation(draw_poses("palpation", box, 2, 0, BALL), BALL, open_patch(box))
    assert get_relaxation(pushed) is None
    known = add_relaxation(pushed, np.array([0.1, 0.2]))
    assert isinstance(known, RelaxingPushes)
    np.testing.assert_array_equal(get_relaxation(known), [0.1, 0.2])


def test_model_rejects_other_prony_series(model, box):
    assert find_rejection(model, EFFECTS) is None

    def under(series: tuple) -> str:
        return str(find_rejection(model, (Elasticity(replace(SOFT, prony=series)), *EFFECTS[1:])))

    off = replace(model, tool=Ball(BALL.radius * (1.0 + 1e-15)))
    assert off.tool != BALL and find_rejection(off, EFFECTS) is None  # sizes that were read in millimetres
    assert "on the poses of a ball" in str(find_rejection(replace(model, tool=Ball(5e-3)), EFFECTS))
    words = "it learned from tissue that relaxes by 40 % in 0.5 s and 30 % in 20 s, and here it "
    assert under(((0.4, 0.5),)) == f"{words}relaxes by 40 % in 0.5 s"
    assert under(()) == f"{words}does not relax"
    timeless = replace(model, training={name: said for name, said in model.training.items() if name != "history"})
    assert "from loads without time, and here the tissue relaxes" in str(find_rejection(timeless, EFFECTS))
    with pytest.raises(InputError, match="unsupported histories"):
        read_prony_series({**SAID, "history": "the tool fell"})


def test_relaxation_model_plays_frame_by_frame_without_fem(model, box):
    """Finite elements are no fallback for it, and a frame depends on those before it."""
    scene = replace(find_scene("palpate"), effects=EFFECTS, tool=Probe(BALL.radius))
    theatre = PatientSetup(box, None, {"contact": model}, "cpu")
    scene = replace(scene, element="p1")
    assert theatre.list_deformers(scene) == ("contact", "fem") and theatre.select_default(scene) == "contact"
    assert describe_error(replace(model, bound=1e-3)).endswith(
        "1 mm in 95 % of loads (limit 0.2 mm): scenes play it without FEM, as its tissue relaxes"
    )
    with pytest.raises(InputError, match="its tissue relaxes, so that finite elements would have to solve"):
        theatre.build_deformer(GUARDED, scene)
    with pytest.raises(InputError, match="would need every earlier frame"):
        Guarded(model, Fading(box))
    with pytest.raises(InputError, match="contact follows tissue that relaxes in time"):
        build_onnx_model("contact", model)
    player = theatre.build_player("contact", scene)
    assert player.follows and player.remembers
    last = None
    for number in range(0, 40, 4):
        last = player.compute_deformation(player.build_loads(number), last)
    assert last is not None and last.memory[MEMORY_KEY].shape == (1, 4 + len(SERIES))
    held_there = player.build_loads(40)
    going_on, alone = (player.compute_deformation(held_there, start).memory[MEMORY_KEY] for start in (last, None))
    assert np.abs(going_on[0, 4:]).min() > 0.0 and not np.allclose(going_on, alone, atol=1e-5)
