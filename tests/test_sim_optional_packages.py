"""Extras: a command without a package that it needs names the extra in one line."""

import subprocess
import sys

import pytest

COMMANDS = {
    "anatomy --out a.vtu": ("nilearn", "heads"),
    "collect press --out a.h5 --device cpu": ("isal", "data"),
    "episodes small --out run --count 1 --device cpu": ("distributed", "data"),
}


@pytest.mark.parametrize("words", COMMANDS)
def test_command_without_its_extra_names_package_and_extra(words, tmp_path):
    package, extra = COMMANDS[words]
    begin = f"import sys; sys.modules[{package!r}] = None\n"
    script = f"{begin}from scenes.cli import main\nsys.exit(main({words.split()}))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.splitlines()[-1].endswith(
        f"the package {package}, which is not installed. Install it in the checkout: pip install -e '.[{extra}]'."
    )
    assert not list(tmp_path.iterdir())
