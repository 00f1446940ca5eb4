"""Surgical tasks as Gymnasium environments: what they promise, on the template's model and on a box."""

import json
import subprocess
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from programs import main
from theatres import put, theatre_of

import scenes.gym
from scenes.gym.environment import many as made_apart
from scenes.gym.episode import ENDED, FAR, OVER_LIMIT, SHARE, STEP, Judged, earned
from scenes.gym.observation import FELT, TRACKED
from scenes.gym.pressed_model import Hertz, PressedModel
from scenes.gym.registration import NAMES, register_environments
from scenes.gym.scripted import scripted
from scenes.gym.setting import open_setting
from scenes.gym.tasks import DEBULK, PALPATE, RETRACT, TASKS
from scenes.gym.touched import Asked
from scenes.play.deformers import model_path
from sim.anatomy import TUMOUR_LABEL
from sim.bodies.meshfile import write_anatomy
from sim.effects import Elasticity
from sim.errors import InputError
from sim.material import BRAIN, MATERIALS
from surrogate.data.answer_rows import stating

SIZE = (48, 36)
STIFF = Elasticity(BRAIN, {TUMOUR_LABEL: replace(BRAIN, young=9000.0)})
DOWN = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0], np.float32)


def made(name="Palpate", **given):
    return gymnasium.make(f"sulcus/{name}-v0", device="cpu", size=SIZE, **given)


def many(count, name="Palpate", **given):
    return gymnasium.make_vec(f"sulcus/{name}-v0", num_envs=count, device="cpu", size=SIZE, **given)


@pytest.fixture(scope="module")
def boxed(box, tmp_path_factory):
    path = tmp_path_factory.mktemp("box") / "box.vtu"
    write_anatomy(path, box)
    return str(path)


def played(environment, seed, steps, task="palpate"):
    """Observations, rewards and truth of the scripted policy, until the episode is over."""
    seen, truth = environment.reset(seed=seed)
    rows = [(seen, 0.0, truth)]
    for _ in range(steps):
        states = seen["states"] if isinstance(seen, dict) else seen
        seen, reward, terminated, truncated, truth = environment.step(scripted(task, states))
        rows.append((seen, reward, truth))
        if terminated or truncated:
            break
    return rows


def test_they_are_registered_once():
    register_environments()  # a second time: warnings are errors here
    assert scenes.gym.register_environments is register_environments
    for name in NAMES:
        spec = gymnasium.spec(f"sulcus/{name}-v0")
        assert spec.kwargs == {"task": name.lower()} and spec.max_episode_steps == 200 and name.lower() in TASKS


def test_without_gymnasium_there_is_a_remedy_and_nothing_else_needs_it():
    code = (
        "import sys; sys.modules['gymnasium'] = None; import scenes.cli, sim\n"
        "try:\n    import scenes.gym\nexcept sim.InputError as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install -e '.[gym]'" in done.stdout


@pytest.mark.parametrize("observation", ["states", "rgbd"])
def test_gymnasium_finds_nothing_wrong(observation, boxed):
    for name, given in (("Palpate", {}), ("Retract", {"anatomy": boxed}), ("Debulk", {"anatomy": boxed})):
        environment = made(name, observation=observation, render_mode="rgb_array", **given)
        check_env(environment.unwrapped)
        assert environment.action_space.shape == (6,)


def test_the_same_seed_and_actions_give_the_same_bytes_wherever_they_are():
    """Alone, and second of three, whose neighbours do something else; pictures too."""
    alone = played(made(observation="rgbd"), 7, 18)
    vector = many(3, observation="rgbd")
    seen, _ = vector.reset(seed=[0, 7, 3])
    for row, (expected, _, _) in enumerate(alone[1:]):
        actions = np.stack([DOWN, scripted("palpate", seen["states"][1]), 0.0 * DOWN])
        seen, _, _, _, truth = vector.step(actions)
        for key in ("rgb", "depth", "states"):
            assert seen[key][1].tobytes() == expected[key].tobytes(), row
    assert truth["tumour_nodes"][1].tobytes() == alone[-1][2]["tumour_nodes"].tobytes()
    assert np.linalg.norm(truth["force"][1]) > 0.01  # the tool touches by now


def test_a_vector_begins_anew_what_is_over():
    vector = many(2, max_episode_steps=3)
    first, _ = vector.reset(seed=5)
    for _ in range(2):
        assert not vector.step(np.zeros((2, 6)))[3].any()
    assert vector.step(np.zeros((2, 6)))[3].all()
    seen, rewards, _, truncated, _ = vector.step(np.zeros((2, 6)))
    assert not truncated.any() and not rewards.any() and seen[0, 12] == 0.0
    assert not np.allclose(seen, first)  # another goal
    # As one environment draws its second episode.
    one = made()
    one.reset(seed=5)
    for _ in range(3):
        one.step(np.zeros(6, np.float32))
    assert np.array_equal(one.reset()[0], seen[0])


def test_a_vector_is_what_gymnasium_makes_of_single_ones():
    """Byte for byte, over the end of episodes; the truth too."""
    vectors = [many(2, max_episode_steps=4), many(2, max_episode_steps=4, vectorization_mode="sync")]
    assert vectors[0].metadata["autoreset_mode"] == vectors[1].metadata["autoreset_mode"]
    random = np.random.default_rng(0)
    ours, theirs = (vector.reset(seed=11) for vector in vectors)
    for _ in range(12):
        for one, other in zip(ours[:-1], theirs[:-1], strict=True):
            assert np.array_equal(one, other)
        assert set(theirs[-1]) <= set(ours[-1])
        assert all(np.array_equal(ours[-1][name], value) for name, value in theirs[-1].items())
        actions = random.uniform(-1.0, 1.0, (2, 6)).astype(np.float32)
        ours, theirs = (vector.step(actions) for vector in vectors)


def test_finite_elements_answer_together_what_they_answer_apart(boxed):
    """A spatula on a box: each tool goes its own way, and the second begins anew in between."""
    vectors = [many(2, "Retract", anatomy=boxed, together=each) for each in (False, True)]
    seen = [vector.reset(seed=[0, 1]) for vector in vectors]
    touched = np.zeros(2, bool)
    for number in range(14):
        if number == 12:
            for vector in vectors:
                vector.episodes[1].over = True
        actions = scripted("retract", seen[0][0])
        seen = [vector.step(actions) for vector in vectors]
        apart, together = (each[-1] for each in seen)
        assert np.allclose(apart["force"], together["force"], atol=2e-3)
        assert np.allclose(apart["tumour_nodes"], together["tumour_nodes"], atol=5e-5)
        assert np.allclose(apart["pressure"], together["pressure"], rtol=0.05, atol=50.0)
        touched |= apart["pressure"] > 0.0
    assert touched.any()


def test_the_scripted_policy_palpates_and_pushing_on_ends_at_the_limit():
    rows = played(made(), 3, 60)
    truth = rows[-1][2]
    assert truth["success"] and truth["violations"] == 0 and abs(truth["reached"] / truth["asked"] - 1.0) < 0.15
    assert 0.0 < truth["model_error"] < 0.1e-3 and truth["pressure"] < PALPATE.pressure
    environment = made()
    environment.reset(seed=3)
    terminated, rewards = False, []
    while not terminated:
        _, reward, terminated, truncated, truth = environment.step(DOWN)
        assert not truncated
        rewards.append(reward)
    assert truth["load"] > 1.25 and truth["violations"] > 0 and rewards[-1] < ENDED + 1.0
    with pytest.raises(InputError, match=r"call reset\(\)"):
        environment.unwrapped.step(DOWN)


def test_a_reward_is_a_difference_of_potentials_and_its_limits():
    near, far = Judged(0.002, 0.1, 0, 0.5), Judged(0.012, 0.6, 0, 0.5)
    assert earned(far, near, False, False) == pytest.approx(1.0 + 0.5 - STEP)
    assert earned(near, near, False, False) == pytest.approx(-STEP)
    assert earned(near, replace(near, load=1.1), False, False) == pytest.approx(-STEP - OVER_LIMIT)
    assert earned(near, near, False, True) == pytest.approx(ENDED - STEP)
    assert earned(near, replace(near, cut=2), False, False) == pytest.approx(2.0 * SHARE - STEP)
    lost, farther = Judged(FAR, 1.0, 0, 0.5), Judged(2.0 * FAR, 5.0, 0, 0.5)  # beyond, all count alike
    assert earned(farther, lost, False, False) == pytest.approx(-STEP) != earned(lost, near, False, False)


def test_the_model_has_the_force_of_the_finite_elements():
    """By pose, at 3 mm: its force within 25 %, the tumour's nodes within a quarter of their motion."""
    site = open_setting(PALPATE, "template", "model", "cpu", SIZE).site
    poses = [PALPATE.tool.pose(site.origin + depth * site.axis, site.axis, site.right) for depth in (-2e-3, 3e-3)]
    found = []
    for physics in ("model", "fem"):
        answers, last = open_setting(PALPATE, "template", physics, "cpu", SIZE).answers, None
        for pose in poses:
            (last,) = answers.answer([Asked(pose, last)])
        assert last is not None and last.good
        motion = np.zeros((len(site.anatomy.mesh.nodes), 3))
        motion[last.nodes] = last.motion
        found.append((np.linalg.norm(last.force), motion[site.anatomy.tumour_nodes]))
    (force, motion), (expected, true) = found
    assert abs(force / expected - 1.0) < 0.25 and expected > 0.05
    assert np.linalg.norm(motion - true, axis=1).max() < 0.25 * np.linalg.norm(true, axis=1).max()


def test_many_answered_together_are_as_each_alone():
    setting = open_setting(PALPATE, "template", "model", "cpu", SIZE)
    site = setting.site
    tips = [site.origin + 1e-3 * depth * site.axis for depth in (-3.0, 0.5, 2.0, 4.0)]
    asked = [Asked(PALPATE.tool.pose(tip, site.axis, site.right)) for tip in tips]
    together = replace(setting.answers, together=True).answer(asked)
    for one, each in zip(setting.answers.answer(asked), together, strict=True):
        assert np.allclose(one.force, each.force, atol=1e-4) and np.allclose(one.motion, each.motion, atol=1e-5)
    unbound = replace(setting.answers, model=replace(setting.answers.model, bounds=None, bound=7e-4))
    assert unbound.answer(asked[2:3])[0].error == 7e-4  # loads without a bound have the model's


def test_the_tumour_sinks_and_is_cut_share_by_share(boxed):
    rows = played(made("Debulk", anatomy=boxed), 0, 120, "debulk")
    truths = [truth for _, _, truth in rows]
    assert truths[-1]["success"] and truths[-1]["reached"] == 3.0 and truths[-1]["violations"] == 0
    assert sorted({truth["steps_done"] for truth in truths}) == [1, 2, 3]
    sunk = np.linalg.norm(truths[-1]["tumour_nodes"] - truths[0]["tumour_nodes"], axis=1)
    assert sunk.mean() > 1e-5


def test_the_goal_follows_the_tumour_and_its_middle_is_of_what_is_left(boxed):
    environment = made("Debulk", anatomy=boxed)
    rows = played(environment, 0, 120, "debulk")
    setting = environment.unwrapped.episode.setting
    tumour, first = setting.site.anatomy.tumour_nodes, [truth for _, _, truth in rows if truth["steps_done"] == 1]
    share = np.searchsorted(tumour, setting.shares[0])
    assert np.allclose(first[-2]["target"], first[-2]["tumour_nodes"][share].mean(axis=0), atol=1e-12)
    assert np.linalg.norm(first[-2]["target"] - first[0]["target"]) > 1e-6
    last = rows[-1][2]
    assert np.allclose(first[0]["tumour_middle"], first[0]["tumour_nodes"].mean(axis=0), atol=1e-3)
    assert np.linalg.norm(last["tumour_middle"] - last["tumour_nodes"].mean(axis=0)) > 1e-3


def test_what_is_observed_is_the_truth_with_its_noise():
    """In the axes of the twists."""
    environment = made()
    environment.reset(seed=3)
    episode, off = environment.unwrapped.episode, []
    for step in range(60):
        states, _, _, _, truth = environment.step(DOWN if step < 12 else 0.0 * DOWN)
        place = episode.frame.T @ (episode.actual.place - episode.setting.site.origin)
        force = episode.frame.T @ truth["force"]
        off.append((*(1e-2 * states[:3] - place), *(PALPATE.force * states[9:12] - force)))
    assert np.linalg.norm(force) > 0.05
    deviation = np.std(off, axis=0)
    assert deviation[:3] == pytest.approx(np.full(3, TRACKED), rel=0.35)
    assert deviation[3:] == pytest.approx(np.full(3, FELT), rel=0.35)
    assert np.abs(np.mean(off, axis=0)[3:]).max() < FELT


def test_an_aspirator_presses_on_healthy_tissue_by_hertz(boxed):
    setting = open_setting(DEBULK, boxed, "auto", "cpu", SIZE)
    site, ball = setting.site, Hertz(DEBULK.tool.radius, MATERIALS["drained"].tissue)
    for depth in (1e-3, DEBULK.tool.radius + 1e-3):  # its middle above a flat top, and below it
        tip = site.origin + 0.012 * site.right + depth * site.axis  # beside the corridor
        (touched,) = setting.answers.answer([Asked(DEBULK.tool.pose(tip, site.axis, site.right), done=1)])
        force = float(ball.force(np.array(depth)))
        assert touched.force @ site.axis == pytest.approx(force, rel=1e-6)
        assert touched.pressure == pytest.approx(1.5 * force / (np.pi * DEBULK.tool.radius * depth))
    assert float(ball.deeper(np.array(force), ball.contact(np.array(force)))) == pytest.approx(0.0)


def test_pictures_show_the_tool_where_it_is():
    environment = made(observation="rgbd", render_mode="rgb_array")
    seen, truth = environment.reset(seed=2)
    camera, ball = environment.unwrapped.pictures.camera, PALPATE.tool.radius
    middle = truth["pose"][:3, 3] + ball * truth["pose"][:3, 2]
    (u, v), away = camera.project(middle)
    assert seen["depth"][round(v), round(u)] == pytest.approx(away - ball, abs=1e-3)
    assert np.array_equal(environment.render(), seen["rgb"]) and seen["rgb"].std() > 20


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"observation": "sounds"}, "choose one of states, rgbd"),
        ({"physics": "magic"}, "choose one of auto, model, fem"),
        ({"size": (3, 4000)}, "from 16 to 4096"),
        ({"render_mode": "human"}, "choose rgb_array"),
        ({"anatomy": 3}, "path of a .vtu file"),
        ({"anatomy": "nowhere.vtu"}, "nowhere.vtu"),
        ({"task": "juggle"}, "choose one of palpate, retract, debulk"),
        ({"task": "debulk", "physics": "model"}, "Give physics='fem'"),
        ({"model": 3}, "path of a .model.npz file"),
        ({"task": "retract", "model": "nowhere.npz"}, "nowhere.npz"),
    ],
)
def test_what_cannot_be_had_is_said(given, said):
    from scenes.gym.environment import Operation

    with pytest.raises(InputError, match=said.replace("(", r"\(")):
        Operation(**({"device": "cpu", "size": SIZE} | given))


def test_hostile_input_is_refused():
    environment, vector = made().unwrapped, many(2)
    with pytest.raises(InputError, match=r"call reset\(\)"):
        environment.step(DOWN)
    with pytest.raises(InputError, match="there are none"):
        environment.reset(options={"goal": 1})
    environment.reset(seed=0)
    for action in (np.full(6, np.nan), np.zeros(5), np.array([np.inf] * 6)):
        with pytest.raises(InputError, match="six finite numbers"):
            environment.step(action)
    with pytest.raises(InputError, match="give one for each"):
        vector.reset(seed=[1])
    with pytest.raises(InputError, match=r"\(2, 6\)"):
        vector.step(np.zeros((3, 6)))
    with pytest.raises(InputError, match="no task"):
        scripted("juggle", np.zeros(24))


def test_the_bench_counts_steps(boxed, capsys):
    words = ["benchmarks", "gym", "debulk", "--anatomy", boxed, "--device", "cpu", "--envs", "2", "--steps", "2"]
    assert main([*words, "--repeats", "2", "--size", "32x24", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["task"], row["observation"]) for row in rows] == [("debulk", "states"), ("debulk", "rgbd")]
    assert all(0.0 < row["least"] <= row["median"] <= row["most"] and row["environments"] == 2 for row in rows)
    assert main([*words, "--repeats", "0"]) == 2 and main(["benchmarks", "gym", "juggle", "--device", "cpu"]) == 2
    assert "choose one of palpate, retract, debulk" in capsys.readouterr().err


def test_a_spatula_is_answered_by_its_model_alone_and_among_others():
    """Byte for byte, through contact; and with a process of its own."""
    alone = played(made("Retract"), 2, 16, "retract")
    vector = many(2, "Retract")
    seen, _ = vector.reset(seed=[5, 2])
    true = alone[-1][2]
    for expected, _, _ in alone[1:]:
        seen, _, _, _, truth = vector.step(scripted("retract", seen))
        assert seen[1].tobytes() == expected.tobytes()
    assert truth["reliable"].all() and truth["force"][1].tobytes() == true["force"].tobytes()
    assert np.linalg.norm(true["force"]) > 0.02 and 0.0 < true["model_error"] < 1e-3 and 0.0 < true["pressure"] < 4e3
    apart = made_apart("retract", 1, True, device="cpu", size=SIZE)
    assert apart.reset(seed=2)[0][0].tobytes() == alone[0][0].tobytes()
    apart.close()


def test_a_pose_that_the_model_refuses_ends_an_episode():
    setting = open_setting(RETRACT, "template", "model", "cpu", SIZE)
    site, tool = setting.site, RETRACT.tool
    poses = [tool.pose(site.origin + depth * site.axis, site.axis, site.right) for depth in (2e-3, 40e-3)]
    (first,) = setting.answers.answer([Asked(poses[0])])
    (second,) = setting.answers.answer([Asked(poses[1], first)])
    assert first.good and not second.good and second.error == np.inf
    assert np.array_equal(second.motion, first.motion)


@pytest.fixture(scope="module")
def stiff(box, tmp_path_factory):
    """A body whose models, of pushes, learned from a stiff tumour."""
    theatre = theatre_of(box)
    learned = {
        name: replace(each, training={**each.training, **stating(STIFF)}) for name, each in theatre.models.items()
    }
    return put(replace(theatre, models=learned), tmp_path_factory.mktemp("stiff") / "stiff.vtu")


def test_a_body_has_the_tissue_of_its_models(stiff):
    setting = open_setting(PALPATE, str(stiff), "auto", "cpu", SIZE)
    assert isinstance(setting.answers, PressedModel) and setting.scene.elasticity == STIFF
    assert setting.answers.ball.tissue == BRAIN  # which lies over the tumour
    exact = open_setting(DEBULK, str(stiff), "auto", "cpu", SIZE)  # drained brain: as many times as stiff
    assert exact.scene.elasticity.of(TUMOUR_LABEL) == replace(MATERIALS["drained"].tissue, young=6300.0)


def test_a_ball_presses_what_lies_at_the_cortex(stiff, box, tmp_path):
    shallow = replace(box, mesh=replace(box.mesh, region=np.full_like(box.mesh.region, TUMOUR_LABEL)))
    models = {
        name: replace(each, anatomy=shallow, training={**each.training, **stating(STIFF)})
        for name, each in theatre_of(box).models.items()
    }
    path = put(replace(theatre_of(box), anatomy=shallow, models=models), tmp_path / "shallow.vtu")
    setting = open_setting(PALPATE, str(path), "fem", "cpu", SIZE)
    assert setting.answers.ball.tissue == STIFF.of(TUMOUR_LABEL)


def test_a_model_that_may_not_answer_is_named_with_the_reason(stiff):
    """One that is asked for is refused; one that lies beside the body is warned of."""
    beside, force = str(model_path(stiff)), "it was trained on what a tool's force does, and here is none"
    with pytest.raises(InputError, match=rf"model\.npz: does not answer the task retract: {force}, but .*ToolContact"):
        open_setting(RETRACT, str(stiff), "auto", "cpu", SIZE, beside)
    with pytest.raises(InputError, match=r"model\.npz: does not answer the task debulk: tissue is cut away"):
        open_setting(DEBULK, str(stiff), "auto", "cpu", SIZE, beside)
    with pytest.raises(InputError, match=rf"no trained model of .*stiff\.vtu answers the task retract: {force}"):
        open_setting(RETRACT, str(stiff), "model", "cpu", SIZE)
    with pytest.warns(UserWarning, match=rf"finite elements answer the task retract on .*, no trained model: {force}"):
        open_setting(RETRACT, str(stiff), "auto", "cpu", SIZE)
