"""Examples in docstrings of public names: each prints its documented output."""

import doctest
import importlib
import inspect

import numpy as np
import pytest

from sim.runtime.device import find_device

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
LEAST = 20  # Number of public names with an example.


def find_examples():
    """Public names of the packages whose docstrings have examples, by `package.name`."""
    found = {}
    for package in map(importlib.import_module, ("sim", "surrogate", "ar", "scenes")):
        for name in package.__all__:
            value = getattr(package, name)
            text = inspect.getdoc(value) or ""
            if ">>>" in text and (inspect.isclass(value) or inspect.isfunction(value)):  # a constant has its class's
                found[f"{package.__name__}.{name}"] = text
    return found


EXAMPLES = find_examples()


@pytest.mark.parametrize("name", EXAMPLES)
def test_docstring_example_prints_its_output(name):
    test = doctest.DocTestParser().get_doctest(EXAMPLES[name], {"np": np}, name, None, None)
    assert not any(doctest.SKIP in example.options for example in test.examples)
    find_device("cpu", "float32")  # starts Warp, which prints at its first use
    report = []
    failed, attempted = doctest.DocTestRunner(optionflags=FLAGS).run(test, out=report.append)
    assert attempted and not failed, "".join(report)


def test_main_public_names_have_examples():
    assert len(EXAMPLES) >= LEAST
