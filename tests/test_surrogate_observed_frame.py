"""Frames of a fit: invalid input, and tables of tools."""

from dataclasses import replace

import numpy as np
import pytest
from test_surrogate_fit import build_tool_frame

from sim.errors import InputError
from surrogate.fitting.observed_frame import Tool, check_frames, read_tools


def test_invalid_frames_are_rejected(body):
    motion = np.zeros_like(body.mesh.nodes) + [0.0, 0.0, 1e-3]
    good = build_tool_frame(body, motion)
    tip = tuple((np.array(good.observation.rest)[0]).tolist())
    cases = {
        "no frame": [],
        "frames 1 and 2 are the same": [good, good],
        "frame 1: is a cloud": [replace(good, observation=replace(good.observation, rest=None))],
        "frame 1: half of the points lie": [
            replace(good, observation=replace(good.observation, rest=1e3 * good.observation.rest))
        ],
        "mm from the open cortex": [replace(good, tools=(Tool((1e3, 0.0, 0.0)),))],
        "not finite": [replace(good, tools=(Tool((np.nan, 0.0, 0.0)),))],
        "give newtons": [replace(good, tools=(Tool(tip, force=50.0),))],
        "needs a force": [replace(good, tools=(Tool(tip, sigma=0.1),))],
        "several tools": [replace(good, tools=(Tool(tip, force=0.1), Tool(tip)))],
        "presses on no disc": [replace(good, tools=(Tool(tip, radius=6.0),))],
    }
    for words, frames in cases.items():
        with pytest.raises(InputError, match=words):
            check_frames(body, frames)
    check_frames(body, [good])


def test_tool_table_is_read_and_invalid_rows_rejected(tmp_path):
    path = tmp_path / "tools.csv"
    path.write_text("frame,x,y,z,radius,force,sigma\n2,10,20,30,,0.2,\n2,11,20,30,5,,\n")
    first, second = read_tools(path, 2)
    assert first == () and second[0] == Tool((0.01, 0.02, 0.03), force=0.2) and second[1].radius == 5e-3
    for text, words in (
        ("frame,x,y,z\n3,1,2,3\n", "there are 2"),
        ("frame,x,y,z\n1,1,2,\n", "not 4 numbers"),
        ("frame,x,y,z,force\n1,1,2,3,nan\n", "not finite"),
        ("x,y,z\n1,2,3\n", "header"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=words):
            read_tools(path, 2)
