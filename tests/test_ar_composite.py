"""Loading of all rendering kernels in advance, by one thread at a time."""

import ast
import threading
import time
from pathlib import Path

import pytest
import warp as wp

import ar
from ar.overlay.composite import load_kernels
from ar.rendering.parallel import load_modules


@pytest.fixture
def loading(monkeypatch):
    """The modules that Warp loads, and how many at the same time at most."""
    loaded, inside, most = [], [], []

    def slow(module, device):
        inside.append(module)
        most.append(len(inside))
        time.sleep(0.02)
        inside.remove(module)
        loaded.append(getattr(module, "__name__", module))

    monkeypatch.setattr(wp, "load_module", slow)
    return loaded, most


def of_kernels(path):
    """Whether a file has functions that are kernels."""
    functions = (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef))
    return any(ast.unparse(decorator) == "forward_kernel" for f in functions for decorator in f.decorator_list)


def test_load_kernels_loads_every_rendering_kernel(loading):
    load_kernels()
    house = Path(ar.__file__).parents[1]
    paths = (path.relative_to(house) for path in Path(ar.__file__).parent.rglob("*.py") if of_kernels(path))
    names = {".".join(path.with_suffix("").parts) for path in paths}
    # The tests' own, and those of cameras with a lens.
    later = {f"ar.rendering.{name}" for name in ("raycast", "lens_rasteriser")}
    assert len(names) > 5 and sorted(loading[0]) == sorted(names - later)


def test_kernel_load_waits_for_running_load(loading):
    loaded, most = loading
    ahead = threading.Thread(target=load_kernels)
    ahead.start()
    while not most:
        time.sleep(0.001)
    load_modules("cpu", "ar.overlay.window")
    assert loaded[-1] == "ar.overlay.window" and len(loaded) == 8 and max(most) == 1
    ahead.join()
