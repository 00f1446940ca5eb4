"""The house rules, read from the code itself: who imports whom, whose job a library is, how a file looks."""

import ast
import re
import subprocess
import sys
import tomllib
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from statistics import median

import pytest

HOUSE = Path(__file__).parents[1]
ROOMS = {"ar": set(), "sim": set(), "surrogate": {"sim"}, "scenes": {"ar", "sim", "surrogate"}}
"""Each room and the rooms that it may import."""
TIERS = (
    {
        "body",
        "effects",
        "resection",
        "device",
        "lanes",
        "columns",
        "rows",
        "product",
        "sparse",
        "sweep",
        "term",
        "constraint",
        "footprint",
    },
    {"terms", "problem", "conformance"},
    {"linear", "factor", "direction", "search", "dense", "memory", "compile", "steering", "narrow", "trial"},
    {
        "newton",
        "series",
        "balance",
        "room",
        "lbfgs",
        "multigrid",
        "amg",
        "inversion",
        "leak",
        "bond",
        "patch",
        "rim",
        "compliance",
        "pairs",
        "settling",
        "proximal",
        "touched",
    },
    {
        "precondition",
        "at_rest",
        "condensation",
        "elimination",
        "patching",
        "vicinity",
        "ladder",
        "still",
        "correction",
        "frame",
        "following",
    },
    {"fem"},
    {"operated", "pressure", "tearing"},
)
"""The solver, from below; every other module of sim lies under it and imports none of it."""
OWNERS = {
    "torch": {"sim/dense.py", "sim/pivots.py", "sim/product.py", "surrogate/ann.py"},
    "sklearn": {"surrogate/svr.py"},
    "trimesh": {"scenes/tool.py"},
    "meshio": {"sim/meshfile.py"},
    "viser": {"ar/browser.py", "ar/guard.py", "ar/messages.py"},
    "nilearn": {"sim/template.py"},
    "onnx": {"surrogate/exchange.py", "surrogate/wire.py"},
    "pyamg": {"sim/amg.py"},
    "nibabel": {"sim/intensity.py", "sim/volume.py"},
}
"""Libraries that nobody else imports."""
JOBS = {
    "warp": {"sim/terms/elasticity.py", "sim/linear.py", "ar/raster.py", "ar/shade.py"},  # finite elements, rasteriser
    "cv2": {"ar/camera.py", "ar/overlay.py", "ar/screen.py"},  # camera model, compositing, video
    "numpy": {"sim/loads.py", "sim/deformation.py", "ar/camera.py", "surrogate/dataset.py"},  # the borders
}
"""Libraries with several jobs: these files, at least, must import them."""
IMPORT_NAMES = {"opencv-python-headless": "cv2", "scikit-learn": "sklearn", "warp-lang": "warp"}
FILES = sorted(path for room in ROOMS for path in (HOUSE / room).rglob("*.py"))


def name_of(path):
    return path.relative_to(HOUSE).as_posix()


@cache
def tree_of(path):
    return ast.parse(path.read_text())


def imports(path, everywhere=True):
    """Absolute dotted names that a file imports; only those that run with the module if not `everywhere`."""
    package = name_of(path).removesuffix(".py").split("/")[:-1]
    tree = tree_of(path)
    inside = {id(n) for f in ast.walk(tree) if isinstance(f, ast.FunctionDef) for n in ast.walk(f)}
    found = set()
    for node in ast.walk(tree):
        if not everywhere and id(node) in inside:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*start, *([node.module] if node.module else [])])
            found |= {f"{base}.{alias.name}" for alias in node.names}
    return found


def libraries(path, everywhere=True):
    return {name.split(".")[0] for name in imports(path, everywhere)}


def importers(library):
    return {name_of(path) for path in FILES if library in libraries(path)}


def test_the_reader_of_imports_reads():
    """What all other tests here stand on."""
    assert "sim.errors.InputError" in imports(HOUSE / "sim/mesh.py")
    assert "surrogate.ann.Ann" in imports(HOUSE / "surrogate/parts.py")
    assert "sim.terms.dead_force.DeadForce" in imports(HOUSE / "sim/compile.py")
    assert "sim.terms.dead_force.DeadForce" not in imports(HOUSE / "sim/compile.py", everywhere=False)
    assert "scenes.check.measure" in imports(HOUSE / "scenes/commands/check.py") and len(FILES) > 80


@pytest.mark.parametrize("room", ROOMS)
def test_rooms_import_one_way(room):
    for path in FILES:
        if name_of(path).startswith(f"{room}/"):
            ours = libraries(path) & set(ROOMS)
            assert ours <= ROOMS[room] | {room}, f"{name_of(path)} imports {ours}"
            assert "tests" not in libraries(path)


def test_the_solver_is_built_in_tiers():
    rank = {name: number for number, tier in enumerate(TIERS, start=1) for name in tier}
    for path in (HOUSE / "sim").rglob("*.py"):
        own = rank.get(path.relative_to(HOUSE / "sim").parts[0].removesuffix(".py"), 0)
        for name in imports(path):
            if name.startswith("sim."):
                assert rank.get(name.split(".")[1], 0) <= own, f"{name_of(path)} imports {name} from above"


def modules_of(path):
    """Modules of this house that a file imports as it is imported."""
    known = {name_of(file).removesuffix(".py").replace("/", ".") for file in FILES}
    return {name if name in known else name.rpartition(".")[0] for name in imports(path, everywhere=False)} & known


def test_no_module_imports_itself_by_way_of_others():
    graph = {name_of(path).removesuffix(".py").replace("/", "."): modules_of(path) for path in FILES}
    assert list(TopologicalSorter(graph).static_order())


def test_newton_knows_no_particular_term_and_terms_are_imported_in_their_arm_alone():
    for path in FILES:
        name = name_of(path)
        if name.startswith("sim/terms/"):
            assert not {other for other in imports(path) if re.match(r"sim\.(problem|compile|newton|fem)\b", other)}
            continue
        assert not [other for other in imports(path, everywhere=False) if other.startswith("sim.terms")], name
        if name != "sim/compile.py":
            assert not [other for other in imports(path) if other.startswith("sim.terms")], name


@pytest.mark.parametrize("library", OWNERS)
def test_each_library_has_its_owner(library):
    assert importers(library) == OWNERS[library]


@pytest.mark.parametrize("library", JOBS)
def test_each_library_does_its_job(library):
    assert importers(library) >= JOBS[library]


def test_rooms_without_pictures_or_networks_import_none():
    assert all(name.startswith("ar/") or name == "scenes/collect.py" for name in importers("cv2"))
    # A learnt model is arrays: Warp answers single loads alone, and is loaded with the first of them.
    ours = {name for name in importers("warp") if name.startswith("surrogate/")}
    assert ours == {"surrogate/swift.py", "surrogate/swift_kernel.py", "surrogate/swift_limits.py"}


def test_what_is_imported_is_declared_and_what_is_declared_is_imported():
    project = tomllib.loads((HOUSE / "pyproject.toml").read_text())["project"]
    declared = [*project["dependencies"], *project["optional-dependencies"]["onnx"]]
    names = {re.split(r"[<>=!~\[ ]", line)[0] for line in declared}
    allowed = {IMPORT_NAMES.get(name, name) for name in names}
    used = set().union(*map(libraries, FILES)) - set(sys.stdlib_module_names) - set(ROOMS)
    assert used == allowed


@pytest.mark.parametrize("library", ["pickle", "joblib", "dill", "shelve", "marshal"])
def test_nothing_is_pickled(library):
    assert not importers(library)
    for path in FILES:
        assert not re.search(r"allow_pickle=True|weights_only=False", path.read_text())


def test_files_are_short():
    lengths = {name_of(path): len(path.read_text().splitlines()) for path in FILES}
    tests = {path.name: len(path.read_text().splitlines()) for path in (HOUSE / "tests").glob("*.py")}
    assert not {name: count for name, count in (lengths | tests).items() if count > 400}
    assert median(lengths.values()) <= 125


def test_the_top_level_is_fixed_and_tests_are_flat():
    assert {path.parent.name for path in HOUSE.glob("*/__init__.py")} == set(ROOMS)
    assert not list((HOUSE / "tests").rglob("__init__.py"))
    assert not [path for path in (HOUSE / "tests").rglob("*.py") if path.parent.name != "tests"]


def test_everything_public_has_a_docstring():
    missing = []
    for path in FILES:
        open_nodes = [(name_of(path), tree_of(path))]
        while open_nodes:
            name, node = open_nodes.pop()
            if not ast.get_docstring(node):
                missing.append(name)
            for child in getattr(node, "body", []):
                public = isinstance(child, ast.ClassDef | ast.FunctionDef) and not child.name.startswith("_")
                # What is made inside a function is its own affair.
                if public and not isinstance(node, ast.FunctionDef):
                    open_nodes.append((f"{name}:{child.name}", child))
    assert not missing


def test_names_say_what_things_are():
    vague = re.compile(r"manager|util|helper|misc|common", re.IGNORECASE)
    for path in FILES:
        assert not vague.search(path.stem), name_of(path)
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ClassDef):
                assert not vague.search(node.name), f"{name_of(path)}: {node.name}"
            if isinstance(node, ast.arg) and node.arg in ("options", "opts", "config"):
                raise AssertionError(f"{name_of(path)}: an argument called {node.arg}: spell it out")


def test_no_path_of_one_machine():
    machine = re.compile(r"(?<![\w.])/(?:home|root|Users|work|tmp|mnt|opt)/|[A-Z]:\\\\")
    texts = [*FILES, *(HOUSE / "tests").glob("*.py"), HOUSE / "pyproject.toml", HOUSE / "Makefile"]
    for path in [*texts, *HOUSE.glob("*.md")]:
        assert not machine.search(path.read_text()), name_of(path)


def fresh(code, *words):
    """Run code in a new interpreter; what it prints."""
    done = subprocess.run([sys.executable, "-c", code, *words], cwd=HOUSE, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_command_line_waits_for_nothing():
    heavy = ("torch", "viser", "cv2", "sklearn", "trimesh", "meshio", "nibabel", "nilearn", "warp", "scipy", "h5py")
    print_heavy = f"import sys; print([name for name in {heavy} if name in sys.modules])"
    assert fresh(f"import scenes.cli; {print_heavy}").strip() == "[]"
    assert "torch" not in fresh(f"import scenes.commands.solve, scenes.commands.anatomy, sim.fem; {print_heavy}")
    assert "viser" not in fresh(f"import scenes.commands.check, scenes.check, scenes.collect; {print_heavy}")


def test_a_machine_that_only_trains_needs_no_meshes_and_no_pages():
    block = "import sys; sys.modules |= dict.fromkeys(['meshio', 'nibabel', 'nilearn', 'trimesh', 'viser', 'cv2'])"
    wanted = "scenes.commands.simulate, scenes.commands.train, surrogate.train, surrogate.store, sim.fem"
    fresh(f"{block}; import {wanted}")
