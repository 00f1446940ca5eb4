"""Rules of the repository, read from its code: imports, owners of libraries, form of files."""

import ast
import re
import subprocess
import sys
import tomllib
from functools import cache
from graphlib import TopologicalSorter
from itertools import chain
from pathlib import Path

import pytest

HOUSE = Path(__file__).parents[1]
WHEEL = {"ar": set(), "sim": set(), "surrogate": {"sim"}, "scenes": {"ar", "sim", "surrogate"}}
"""Each room of the wheel and the rooms that it may import."""
ROOMS = WHEEL | {"benchmarks": set(WHEEL)}
ORDER = (
    {"sim.errors", "sim.elements"},
    {"sim.arguments", "sim.skulls", "sim.tools", "sim.material", "sim.geometry"},
    {"sim.accuracy", "sim.loads", "sim.anatomy", "sim.named_tissues"},
    {"sim.fields"},
    {"sim.runtime", "sim.effects", "sim.deformation"},
    {"sim.discretisation", "sim.terms.laws"},
    {"sim.terms", "sim.linalg", "sim.bodies", "sim.diagnostics"},
    {"sim.terms.contact", "sim.minimisers"},
    {"sim.compile"},
    {"sim.local_solvers"},
    {"sim.strategy"},
    {"sim.fem"},
    {"sim.resected_fem", "sim.contact_pressure", "sim.debonding", "sim.adjoint"},
    {"sim.families"},
    {"surrogate.array_functions"},
    {"surrogate.data", "surrogate.regressors"},
    {"surrogate.model"},
    {"surrogate.evaluation", "surrogate.locating", "surrogate.onnx_export"},
    {"surrogate.training", "surrogate.fitting"},
    {"ar.optics", "ar.screen"},
    {"ar.rendering", "ar.stereo"},
    {"ar.overlay", "ar.tracking"},
    {"ar.page"},
    {"scenes.script"},
    {"scenes.builtin", "scenes.play"},
    {"scenes.analysis"},
    {"scenes.page"},
    {"scenes.tracked"},
    {"scenes.gym", "scenes.link"},
    {"scenes.episodes"},
    {"scenes.html", "scenes.report", "scenes.warp"},
    {"scenes.options"},
    {"scenes.commands"},
    {"benchmarks.peers", "benchmarks.published", "benchmarks.studies"},
    {"benchmarks.figures"},
    {"benchmarks.commands"},
    {"benchmarks.heads", "benchmarks.liver_sequences", "benchmarks.located_scenes"},
)
"""Folders from below, and the modules that lie beside them: each imports itself and what lies under it."""
TOGETHER = {"scenes.cli": "scenes.commands", "benchmarks.__main__": "benchmarks.commands"}
"""Command lines and their commands call each other."""
OWNERS = {
    "torch": {
        *(f"sim/{of}.py" for of in ["linalg/dense_inverse", "linalg/block_inverse", "runtime/dense_product"]),
        *[
            "sim/adjoint/torch_function.py",
            "sim/runtime/views.py",
            "surrogate/regressors/baselines.py",
            "scenes/episodes/reading/torch_dataset.py",
        ],
    },
    "sklearn": {"surrogate/regressors/baselines.py"},
    "trimesh": {"scenes/script/tool.py", "scenes/play/instruments.py", "scenes/play/drape.py"},
    "isal": {"scenes/episodes/png.py"},
    "meshio": {"sim/bodies/meshfile.py"},
    "gymnasium": {f"scenes/gym/{of}.py" for of in ["environment", "observation", "registration"]},
    "viser": {
        f"ar/page/{of}.py" for of in ("browser", "control_lock", "access_guard", "messages", "recording", "scene")
    },
    "nilearn": {"sim/bodies/template.py"},
    "pyarrow": {"scenes/episodes/exports/lerobot.py"},
    "matplotlib": {"scenes/analysis/loglog_chart.py"},
    "onnx": {"surrogate/onnx_export/export.py", "surrogate/onnx_export/graph.py"},
    "fastcrc": {"scenes/link/frame.py"},
    "pyamg": {"sim/linalg/amg.py"},
    "PIL": {"ar/tracking/pages.py", "ar/tracking/image_sequences.py", "scenes/commands/inspection_sheet.py"},
    "nibabel": {"sim/bodies/intensity.py", "sim/bodies/nifti.py", "scenes/warp/images.py"},
}
"""Libraries that nobody else imports."""
JOBS = {
    # finite elements, rasteriser
    "warp": {"sim/terms/elasticity.py", "sim/linalg/pcg.py", "ar/rendering/rasteriser.py", "ar/rendering/shade.py"},
    "cv2": {"ar/optics/camera.py", "ar/overlay/composite.py", "ar/screen.py"},  # camera model, compositing, video
    "numpy": {"sim/loads.py", "sim/deformation.py", "ar/optics/camera.py", "surrogate/data/dataset.py"},  # the borders
}
"""Libraries with several jobs: these files, at least, must import them."""
DOCS = [path for path in (HOUSE / "docs").rglob("*.md") if "generated" not in path.parts]
IMPORT_NAMES = {"opencv-python-headless": "cv2", "pillow": "PIL", "scikit-learn": "sklearn", "warp-lang": "warp"}
"""Where they are other than the name to install by, with `_` for `-`."""
FILES = sorted(path for room in ROOMS for path in (HOUSE / room).rglob("*.py"))
PACKAGED = [path for path in FILES if path.relative_to(HOUSE).parts[0] in WHEEL]


def name_of(path):
    return path.relative_to(HOUSE).as_posix()


@cache
def tree_of(path):
    return ast.parse(path.read_text())


@cache
def nodes_of(path):
    return tuple(ast.walk(tree_of(path)))


@cache
def imports(path, everywhere=True, types=True):
    """Absolute dotted names that a file imports.

    Only those that run with the module if not `everywhere`; none that only a type checker reads if not `types`.
    """
    package = name_of(path).removesuffix(".py").split("/")[:-1]
    nodes = nodes_of(path)
    left_out = set() if everywhere else {id(n) for f in nodes if isinstance(f, ast.FunctionDef) for n in ast.walk(f)}
    if not types:
        typed = (f for f in nodes if isinstance(f, ast.If) and getattr(f.test, "id", "") == "TYPE_CHECKING")
        left_out |= {id(n) for f in typed for n in ast.walk(f)}
    found = set()
    for node in nodes:
        if id(node) in left_out:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*start, *([node.module] if node.module else [])])
            found |= {f"{base}.{alias.name}" for alias in node.names}
    return frozenset(found)


def libraries(path, everywhere=True):
    return {name.split(".")[0] for name in imports(path, everywhere)}


def importers(library):
    return {name_of(path) for path in PACKAGED if library in libraries(path)}


def test_import_reader_finds_known_imports():
    """All other tests of this file depend on this reader."""
    assert "sim.errors.InputError" in imports(HOUSE / "sim/geometry/tetmesh.py")
    assert "surrogate.regressors.baselines.Ann" in imports(HOUSE / "surrogate/training/learners.py")
    assert "sim.terms.dead_force.DeadForce" in imports(HOUSE / "sim/compile.py")
    assert "sim.terms.dead_force.DeadForce" not in imports(HOUSE / "sim/compile.py", everywhere=False)
    assert "scenes.play.checks.measure_frames" in imports(HOUSE / "scenes/commands/check.py") and len(FILES) > 80


@pytest.mark.parametrize("room", ROOMS)
def test_packages_import_in_one_direction(room):
    for path in FILES:
        if name_of(path).startswith(f"{room}/"):
            ours = libraries(path) & set(ROOMS)
            assert ours <= ROOMS[room] | {room}, f"{name_of(path)} imports {ours}"
            assert "tests" not in libraries(path)


def folder_of(module):
    """The entry of `ORDER` that a module lies in; None of a package itself, and of what is not ours."""
    known = {name for tier in ORDER for name in tier} | set(TOGETHER)
    parts = module.split(".")
    heads = (".".join(parts[:count]) for count in range(len(parts), 1, -1))
    found = next((head for head in heads if head in known), None)
    return TOGETHER.get(found, found)


def test_folders_import_in_one_direction():
    rank = {name: number for number, tier in enumerate(ORDER) for name in tier}
    for path in FILES:
        module = name_of(path).removesuffix(".py").replace("/", ".")
        own = folder_of(module)
        if path.name == "__init__.py":
            continue
        assert own, f"{name_of(path)} lies in no folder of ORDER: move it into one"
        for name in imports(path, types=False):
            other = folder_of(name)
            assert other in (None, own) or rank[other] < rank[own], f"{name_of(path)} imports {name} from above"


def modules_of(path):
    """Modules of this house that a file imports as it is imported."""
    known = {name_of(file).removesuffix(".py").replace("/", ".") for file in FILES}
    return {name if name in known else name.rpartition(".")[0] for name in imports(path, everywhere=False)} & known


def test_module_imports_have_no_cycle():
    graph = {name_of(path).removesuffix(".py").replace("/", "."): modules_of(path) for path in FILES}
    assert list(TopologicalSorter(graph).static_order())


def test_solver_imports_terms_only_where_compiled():
    own = re.compile(r"sim\.terms\.(?!laws\b)")
    for path in FILES:
        name = name_of(path)
        if name.startswith("sim/terms/"):
            solver = re.compile(r"sim\.(discretisation\.problem|compile|minimisers|fem)\b")
            assert not {other for other in imports(path) if solver.match(other)}
            continue
        assert not [other for other in imports(path, everywhere=False, types=False) if own.match(other)], name
        if name != "sim/compile.py":
            assert not [other for other in imports(path, types=False) if own.match(other)], name


@pytest.mark.parametrize("library", OWNERS)
def test_each_library_is_imported_only_by_its_owners(library):
    assert importers(library) == OWNERS[library]


@pytest.mark.parametrize("library", JOBS)
def test_each_library_is_imported_by_its_required_modules(library):
    assert importers(library) >= JOBS[library]


def test_opencv_and_warp_are_imported_only_in_their_packages():
    outside = {name for name in importers("cv2") if not name.startswith("ar/")}
    assert outside == {"scenes/episodes/episode.py"}
    assert not {name for name in importers("warp") if name.startswith("surrogate/")}


def test_imports_and_declared_dependencies_agree():
    project = tomllib.loads((HOUSE / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    of_users = (extras[name] for name in ("camera", "data", "gym", "heads", "onnx", "report", "slicer"))
    declared = {*project["dependencies"], *chain(*of_users)} - {"mne>=1.6"}  # of mne a file is read, no module
    names = {re.split(r"[<>=!~\[ ]", line)[0] for line in declared}
    allowed = {IMPORT_NAMES.get(name, name.replace("-", "_")) for name in names}
    used = set().union(*map(libraries, PACKAGED)) - set(sys.stdlib_module_names) - set(ROOMS)
    assert used == allowed


@pytest.mark.parametrize("library", ["pickle", "joblib", "dill", "shelve", "marshal"])
def test_no_module_uses_pickle(library):
    assert not importers(library)
    for path in FILES:
        assert not re.search(r"allow_pickle=True|weights_only=False", path.read_text())


def test_files_have_at_most_400_lines():
    lengths = {name_of(path): len(path.read_text().splitlines()) for path in FILES}
    tests = {path.name: len(path.read_text().splitlines()) for path in (HOUSE / "tests").glob("*.py")}
    assert not {name: count for name, count in (lengths | tests).items() if count > 400}


def test_top_level_packages_are_fixed_and_tests_are_flat():
    assert {path.parent.name for path in HOUSE.glob("*/__init__.py")} == set(ROOMS)
    assert not list((HOUSE / "tests").rglob("__init__.py"))
    assert not [path for path in (HOUSE / "tests").rglob("*.py") if path.parent.name != "tests"]


def test_public_definitions_have_docstrings():
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


def test_identifiers_avoid_nonstandard_words():
    """Names in packages, tests and examples: training words of the field only."""
    ours = re.compile(r"(?:^|_)(?:(?:un)?taught|told|teach(?:er|es|ing)?)(?:_|$)", re.IGNORECASE)
    search = cache(ours.search)
    assert ours.search("taught") and ours.search("FEWEST_TAUGHT") and ours.search("Told") and not ours.search("untold")
    for path in [*FILES, *(HOUSE / "tests").glob("*.py"), *(HOUSE / "examples").glob("*.py")]:
        for node in nodes_of(path):
            names = [getattr(node, kind, None) for kind in ("id", "name", "arg", "attr")]
            found = [name for name in names if isinstance(name, str) and search(name)]
            assert not found, f"{name_of(path)}:{node.lineno}: {found[0]}"


def test_identifiers_avoid_vague_words():
    vague = re.compile(r"manager|util|helper|misc|common", re.IGNORECASE)
    for path in FILES:
        imposed = {"options"} if name_of(path).startswith("scenes/gym/") else set()  # Gymnasium calls it so
        assert not vague.search(path.stem), name_of(path)
        for node in nodes_of(path):
            if isinstance(node, ast.ClassDef):
                assert not vague.search(node.name), f"{name_of(path)}: {node.name}"
            if isinstance(node, ast.arg) and node.arg in {"options", "opts", "config"} - imposed:
                raise AssertionError(f"{name_of(path)}: an argument called {node.arg}: spell it out")


def test_tests_use_no_constants_or_private_names():
    """A test sets values by arguments and reads public names."""
    own = {name for path in FILES for name in re.findall(r"(?:def |class |self\.)(_[a-z]\w*)", path.read_text())}
    private = re.compile(r"(?:(?<!\bself)\.|\bimport .*)\b(_[a-z]\w*)")
    constant = re.compile(r"setattr\(\s*.*?[.\"]([A-Z][A-Z_\d]+)\",|^\s*[\w.]+\.([A-Z][A-Z_\d]+) = ", re.MULTILINE)
    assert constant.search('setattr(a, "B' + 'C", 1)') and private.search("a." + "_b")
    for path in sorted((HOUSE / "tests").glob("*.py")):
        text = path.read_text()
        found = [*constant.findall(text), *(name for name in private.findall(text) if name in own)]
        assert not found, f"{path.name}: {found[0]}"


def test_files_contain_no_machine_specific_path():
    machine = re.compile(r"(?<![\w.])/(?:home|root|Users|work|tmp|mnt|opt)/|[A-Z]:\\\\")
    texts = [*FILES, *(HOUSE / "tests").glob("*.py"), HOUSE / "pyproject.toml", HOUSE / "Makefile"]
    for path in [*texts, *HOUSE.glob("*.md")]:
        assert not machine.search(path.read_text()), name_of(path)


def test_linter_checks_every_source_file():
    """Ruff skips paths listed in .gitignore; no source folder may be among them."""
    shown = [sys.executable, "-m", "ruff", "check", "--show-files", "."]
    read = subprocess.run(shown, cwd=HOUSE, capture_output=True, text=True, check=True).stdout.splitlines()
    assert {str(path) for path in FILES} <= set(read)


def test_makefile_lists_existing_tests():
    text = (HOUSE / "Makefile").read_text()
    quick = re.search(r"^QUICK := ((?:.*\\\n)*.*)", text, re.MULTILINE)[1].replace("\\", " ").split()
    pages = re.search(r"^PAGES := (.*)", text, re.MULTILINE)[1].split()
    assert len(quick) > 10 and pages
    assert not [name for name in quick if not (HOUSE / f"tests/test_{name}.py").exists()]
    assert not [name for name in pages if not (HOUSE / name).exists()]


def test_referenced_files_exist():
    """In documents and docstrings; a bare file name may follow the name of its folder."""
    named = re.compile(r"(?<![\w/.-])(?:sim|surrogate|ar|scenes|tests|examples|benchmarks)/[\w/]+\.py\b")
    alone = re.compile(r"`([A-Za-z_]+\.py)`")
    readers = {"my_scene.py", "MY_SCENE.py", "NAME.py", "nearest.py"}  # files that a reader writes
    known = readers | {path.name for path in [*FILES, *(HOUSE / "tests").glob("*.py")]}
    for path in [*FILES, *HOUSE.glob("*.md"), *DOCS]:
        text = path.read_text()
        missing = [name for name in named.findall(text) if not (HOUSE / name).exists()]
        missing += [name for name in alone.findall(text) if name not in known]
        assert not missing, f"{name_of(path)} names {missing}"
