"""Limits of lines and of positional arguments, and options that are declared once."""

import ast
import re

from test_house import FILES, HOUSE, PACKAGED, name_of, nodes_of

# Lines of the packages and of their tests. Nobody reads more than this: a feature that exceeds it deletes something.
# Lower a number when lines have gone. Raise it only with the reason in the commit.
# 1,380 of the packages are the families of models that finite elements are compared with; 770 lines are their tests.
# 900 more measure the published experiment, choose among families, and plot batches and effects.
# 360 compare tissue laws with measured brain; 140 lines are their tests.
# 250 are the law and names of measured brain, whose stress needs no eigenvectors; 80 lines are their tests.
# 140 list claims with their status, figures and tests; 90 lines are their tests.
# 180 factorise the tangent stiffness under tools, up to nine times as fast with measured brain; 90 are their tests.
# 80 lines of tests compare FEM with a silicone phantom.
# 45 solve poses of a data set in strokes, in a third of the time; 50 are their tests.
# 810 differentiate equilibria, also in PyTorch; 345 lines are their tests.
# 55 draw the exponent of a measured law; 35 are their tests.
# 290 of the tests are calls that names of full words wrap.
MOST = {"packages": 86_344, "tests": 55_040}


def lines(paths):
    return sum(path.read_text().count("\n") for path in paths)


def test_line_counts_are_within_their_budget():
    found = {"packages": lines(PACKAGED), "tests": lines((HOUSE / "tests").glob("*.py"))}
    assert not {name: count for name, count in found.items() if count > MOST[name]}


def test_changelog_has_at_most_8_kib():
    assert (HOUSE / "CHANGELOG.md").stat().st_size <= 8192


def test_shared_options_are_declared_in_one_file():
    shared = {
        "json": "action=",
        "device": 'default="auto", help',
        "seed": "type=",
        "anatomy": 'type=Path, help=".vtu made',
    }
    usual = "|".join(re.escape(f'"--{name}", {rest}') for name, rest in shared.items())
    files = [*PACKAGED, *HOUSE.glob("benchmarks/commands/*.py")]
    found = [path.name for path in files if re.search(usual, path.read_text())]
    assert found == ["shared_options.py", "subject_options.py"]  # the latter: of a group of its own


def test_classes_take_at_most_eight_positional_values():
    """With more positional values a swap of two numbers is easily overlooked."""
    for path in [*FILES, *(HOUSE / "tests").glob("*.py")]:
        for node in nodes_of(path):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id[:1].isupper():
                assert len(node.args) <= 8, f"{name_of(path)}:{node.lineno}: {node.func.id}"


FACTORIES = ("build_kernel", "build_kernels", "build_functions")


def test_functions_are_short_and_take_few_arguments():
    """Exceptions: kernels, their factories, and constructors, which are called by keyword."""
    found = []
    for path in PACKAGED:
        for node in nodes_of(path):
            if not isinstance(node, ast.FunctionDef) or node.name in ("__init__", *FACTORIES):
                continue
            arguments = [one.arg for one in (*node.args.args, *node.args.kwonlyargs) if one.arg not in ("self", "cls")]
            of_warp = any(re.search(r"kernel|^wp\.", ast.unparse(each)) for each in node.decorator_list)
            if not of_warp and (node.end_lineno - node.lineno >= 80 or len(arguments) > 8):
                found.append(f"{name_of(path)}:{node.lineno} {node.name}")
    assert not found
