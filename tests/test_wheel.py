"""Contents of the wheel, and its commands without a checkout."""

import os
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest
from visitor import free_port

HOUSE = Path(__file__).parents[1]
ROOMS = ("sim", "surrogate", "ar", "scenes")


def ran(*words, **where):
    """Run a command, with nothing on Python's path but what its environment has; what it printed."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(list(map(str, words)), env=environment, capture_output=True, text=True, check=False, **where)
    assert done.returncode == 0, f"{words}: {done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from a copy: a build leaves folders in its source."""
    folder = tmp_path_factory.mktemp("wheel")
    for room in (*ROOMS, "benchmarks", "tests"):
        shutil.copytree(HOUSE / room, folder / "source" / room, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(HOUSE / name, folder / "source")
    ran(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, folder / "source", cwd=folder)
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def programs(wheel, tmp_path_factory):
    """The folder of programs of an environment that has the wheel, and the dependencies from here."""
    folder = tmp_path_factory.mktemp("bare") / "venv"
    venv.create(folder, with_pip=False)
    found = folder / "bin"
    pip = [sys.executable, "-m", "pip", "--python", found / "python", "--disable-pip-version-check"]
    ran(*pip, "install", "--quiet", "--no-deps", "--no-index", wheel, cwd=folder)
    (site,) = folder.glob("lib/*/site-packages")
    # Folders that a .pth file names come last, and their own .pth files, as of an editable install, are not read.
    (site / "dependencies.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
    return found


@pytest.fixture(scope="module")
def sulcus(programs, tmp_path_factory):
    """Run a command in one empty folder; what it printed."""
    folder = tmp_path_factory.mktemp("empty")
    return lambda *words: ran(programs / "sulcus", *words, cwd=folder)


def test_wheel_contains_exactly_the_package_files(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    files = [path for room in ROOMS for path in (HOUSE / room).rglob("*") if path.is_file()]
    wanted = {path.relative_to(HOUSE).as_posix() for path in files if path.suffix != ".pyc"}
    assert names == wanted
    data = {f"scenes/data/template.{end}" for end in ("vtu", "t1.nii.gz", "model.npz")}
    assert names >= data | {f"{room}/{name}" for room in ROOMS for name in ("__init__.pyi", "py.typed")}


def test_installed_commands_run_without_the_checkout(programs, sulcus, tmp_path):
    where = ran(programs / "python", "-c", "import sim, scenes; print(sim.__file__, scenes.__file__)", cwd=tmp_path)
    assert all(Path(path).is_relative_to(programs.parent) for path in where.split())
    assert sulcus("--version").startswith("sulcus ")
    assert "press" in sulcus("scenes")
    sulcus("render", "press", "--every", 60, "--out", "frames")
    assert "pass" in sulcus("check", "press", "--every", 60, "--device", "cpu")
    assert "http://" in sulcus("demo", "--device", "cpu", "--seconds", 1, "--port", free_port())
    made = "import gymnasium; made = gymnasium.make('scenes.gym:sulcus/Palpate-v0', device='cpu')"
    assert "(24,)" in ran(
        programs / "python", "-W", "error", "-c", f"{made}; print(made.reset(seed=0)[0].shape)", cwd=tmp_path
    )
