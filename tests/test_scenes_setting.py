"""Settings of surgical tasks: model, tissue and reward."""

import json
from dataclasses import replace

import numpy as np
import pytest
from gym_examples import SIZE, made, played
from programs import main
from theatres import put, theatre_of

from scenes.gym.episode import REWARD, EpisodeScore, compute_reward
from scenes.gym.model_responses import PushSurrogate
from scenes.gym.setting import open_setting
from scenes.gym.tasks import DEBULK, PALPATE, RETRACT
from scenes.play.deformers import to_model_path
from sim.anatomy import TUMOUR_LABEL
from sim.effects import Elasticity
from sim.errors import InputError
from sim.material import BRAIN
from sim.named_tissues import MATERIALS
from surrogate.data.solution_rows import describe_tissue_source

STIFF = Elasticity(BRAIN, {TUMOUR_LABEL: BRAIN.replace_constants(9000.0)})


def test_reward_is_potential_difference_minus_penalties():
    near, far = EpisodeScore(0.002, 0.1, 0, 0.5), EpisodeScore(0.012, 0.6, 0, 0.5)
    step, most = REWARD.step_penalty, REWARD.max_potential_distance
    assert compute_reward(far, near, False, False) == pytest.approx(1.0 + 0.5 - step)
    assert compute_reward(near, near, False, False) == pytest.approx(-step)
    pressed = replace(near, load_ratio=1.1)
    assert compute_reward(near, pressed, False, False) == pytest.approx(-step - REWARD.limit_penalty)
    assert compute_reward(near, near, False, True) == pytest.approx(REWARD.abort_reward - step)
    cut = replace(near, cut_shares=2)
    assert compute_reward(near, cut, False, False) == pytest.approx(2.0 * REWARD.share_reward - step)
    lost, farther = EpisodeScore(most, 1.0, 0, 0.5), EpisodeScore(2.0 * most, 5.0, 0, 0.5)  # beyond, all count alike
    beyond = compute_reward(farther, lost, False, False)
    assert beyond == pytest.approx(-step) != compute_reward(lost, near, False, False)


def test_debulk_goal_tracks_remaining_tumour(boxed):
    environment = made("Debulk", anatomy=boxed)
    rows = played(environment, 0, 120, "debulk")
    setting = environment.unwrapped.episode.setting
    tumour, first = setting.site.anatomy.tumour_nodes, [truth for _, _, truth in rows if truth["steps_done"] == 1]
    share = np.searchsorted(tumour, setting.resection_shares[0])
    assert np.allclose(first[-2]["target"], first[-2]["tumour_nodes"][share].mean(axis=0), atol=1e-12)
    assert np.linalg.norm(first[-2]["target"] - first[0]["target"]) > 1e-6
    last = rows[-1][2]
    assert np.allclose(first[0]["tumour_middle"], first[0]["tumour_nodes"].mean(axis=0), atol=1e-3)
    assert np.linalg.norm(last["tumour_middle"] - last["tumour_nodes"].mean(axis=0)) > 1e-3


def test_gym_benchmark_reports_rate_per_observation_kind(boxed, capsys):
    words = ["benchmarks", "gym", "debulk", "--anatomy", boxed, "--device", "cpu", "--envs", "2", "--steps", "2"]
    assert main([*words, "--repeats", "2", "--size", "32x24", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["task"], row["observation"]) for row in rows] == [("debulk", "states"), ("debulk", "rgbd")]
    assert all(0.0 < row["least"] <= row["median"] <= row["most"] and row["environments"] == 2 for row in rows)
    assert main([*words, "--repeats", "0"]) == 2 and main(["benchmarks", "gym", "juggle", "--device", "cpu"]) == 2
    assert "choose one of palpate, retract, debulk" in capsys.readouterr().err


@pytest.fixture(scope="module")
def stiff(box, tmp_path_factory):
    """A body whose models, of pushes, learned from a stiff tumour."""
    theatre = theatre_of(box)
    learned = {
        name: replace(each, training={**each.training, **describe_tissue_source(STIFF)})
        for name, each in theatre.models.items()
    }
    return put(replace(theatre, models=learned), tmp_path_factory.mktemp("stiff") / "stiff.vtu")


def test_task_uses_the_tissue_of_the_models(stiff):
    setting = open_setting(PALPATE, str(stiff), "auto", "cpu", SIZE)
    assert isinstance(setting.tissue_model, PushSurrogate) and setting.scene.elasticity == STIFF
    assert setting.tissue_model.ball.tissue == BRAIN  # which lies over the tumour
    exact = open_setting(DEBULK, str(stiff), "auto", "cpu", SIZE)  # drained brain: as many times as stiff
    assert exact.scene.elasticity.get_law(TUMOUR_LABEL) == replace(MATERIALS["drained"].tissue, young=6300.0)


def test_contact_ball_uses_tissue_at_the_cortex(stiff, box, tmp_path):
    shallow = replace(box, mesh=replace(box.mesh, region=np.full_like(box.mesh.region, TUMOUR_LABEL)))
    models = {
        name: replace(each, anatomy=shallow, training={**each.training, **describe_tissue_source(STIFF)})
        for name, each in theatre_of(box).models.items()
    }
    path = put(replace(theatre_of(box), anatomy=shallow, models=models), tmp_path / "shallow.vtu")
    setting = open_setting(PALPATE, str(path), "fem", "cpu", SIZE)
    assert setting.tissue_model.ball.tissue == STIFF.get_law(TUMOUR_LABEL)


def test_inapplicable_model_is_rejected_with_reason(stiff):
    """Requested models raise an error; models next to the body give a warning."""
    beside, force = str(to_model_path(stiff)), "it was trained on what a tool's force does, and here is none"
    with pytest.raises(InputError, match=rf"model\.npz: is not applicable .*task retract: {force}, but .*ToolContact"):
        open_setting(RETRACT, str(stiff), "auto", "cpu", SIZE, beside)
    with pytest.raises(InputError, match=r"model\.npz: is not applicable to the task debulk: tissue is resected"):
        open_setting(DEBULK, str(stiff), "auto", "cpu", SIZE, beside)
    with pytest.raises(InputError, match=rf"no trained model of .*stiff\.vtu is applicable .*task retract: {force}"):
        open_setting(RETRACT, str(stiff), "model", "cpu", SIZE)
    with pytest.warns(UserWarning, match=rf"FEM is used for .* retract on .*: no .* model is applicable: {force}"):
        open_setting(RETRACT, str(stiff), "auto", "cpu", SIZE)
