"""Names of the environments in Gymnasium's registry."""

import subprocess
import sys

import gymnasium

import scenes.gym
from scenes.gym.registration import NAMES, register_environments
from scenes.gym.tasks import TASKS


def test_environments_are_registered_once():
    register_environments()  # a second time: warnings are errors here
    assert scenes.gym.register_environments is register_environments
    for name in NAMES:
        spec = gymnasium.spec(f"sulcus/{name}-v0")
        assert spec.kwargs == {"task": name.lower()} and spec.max_episode_steps == 200 and name.lower() in TASKS


def test_missing_gymnasium_message_names_the_extra():
    code = (
        "import sys; sys.modules['gymnasium'] = None; import scenes.cli, sim\n"
        "try:\n    import scenes.gym\nexcept sim.InputError as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install -e '.[gym]'" in done.stdout
