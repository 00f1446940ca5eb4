"""Images of the environments."""

import numpy as np
import pytest
from gym_examples import made

from scenes.gym.tasks import PALPATE


def test_observation_images_show_the_tool_at_its_pose():
    environment = made(observation="rgbd", render_mode="rgb_array")
    seen, truth = environment.reset(seed=2)
    camera, ball = environment.unwrapped.pictures.camera, PALPATE.tool.radius
    middle = truth["pose"][:3, 3] + ball * truth["pose"][:3, 2]
    (u, v), away = camera.project(middle)
    assert seen["depth"][round(v), round(u)] == pytest.approx(away - ball, abs=1e-3)
    assert np.array_equal(environment.render(), seen["rgb"]) and seen["rgb"].std() > 20
