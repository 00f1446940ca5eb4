"""Cost and side effects of imports, each in a separate interpreter."""

import subprocess
import sys
from pathlib import Path

HOUSE = Path(__file__).resolve().parent.parent


def fresh(code, *words):
    """Run code in a new interpreter; what it prints."""
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=HOUSE, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_command_line_imports_no_heavy_library():
    heavy = ("torch", "viser", "cv2", "sklearn", "trimesh", "meshio", "nibabel", "nilearn", "warp", "scipy", "h5py")
    print_heavy = f"import sys; print([name for name in {heavy} if name in sys.modules])"
    assert fresh(f"import scenes.cli; {print_heavy}").strip() == "[]"
    assert "torch" not in fresh(f"import scenes.commands.solve, scenes.commands.anatomy, sim.fem; {print_heavy}")
    assert "viser" not in fresh(f"import scenes.commands.check, scenes.episodes.episode; {print_heavy}")


def test_public_names_import_without_side_effects():
    fresh(
        "import sys; import sim, surrogate, ar, scenes; packages = (sim, surrogate, ar, scenes)\n"
        "assert not {'numpy', 'warp', 'torch', 'cv2'} & set(sys.modules)\n"
        "import warp, torch, cv2, scipy.linalg, sklearn, threadpoolctl\n"
        "def settings():\n"
        "    config = {name: value for name, value in vars(warp.config).items() if not name.startswith('_')}\n"
        "    blas = {pool['filepath']: pool['num_threads'] for pool in threadpoolctl.threadpool_info()}\n"
        "    return [config, torch.get_num_threads(), cv2.getNumThreads(), cv2.useOptimized(), blas]\n"
        "before = settings()\n"
        "for package in packages:\n"
        "    for name in package.__all__:\n"
        "        getattr(package, name)\n"
        "after = settings()\n"
        "after[-1] = {path: after[-1].get(path) for path in before[-1]}  # what is loaded later has no setting before\n"
        "assert after == before, [(one, other) for one, other in zip(before, after) if one != other]\n"
    )
    for room in ("sim", "surrogate", "ar", "scenes"):
        assert (HOUSE / room / "py.typed").exists()


def test_training_commands_import_no_mesh_or_page_library():
    block = "import sys; sys.modules |= dict.fromkeys(['meshio', 'nibabel', 'nilearn', 'trimesh', 'viser', 'cv2'])"
    wanted = "scenes.commands.simulate, scenes.commands.train, surrogate.training.train, surrogate.model.store, sim.fem"
    fresh(f"{block}; import {wanted}")
