"""What processes of several devices do in tests: they import it by its name."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from conftest import Pretender, make_box

from sim.deformation import Deformation
from sim.errors import InputError
from sim.loads import Loads, Pushed
from surrogate.data.tool_loads import draw


def small_body():
    """So coarse that finite elements solve it in milliseconds."""
    return make_box((6, 6, 4), spacing=12e-3, tumour=14e-3, depth=26e-3, opening=26e-3)


def named(device, *given):
    """What a process was made with."""
    return device, given


def refusing(device):
    """Cannot be made."""
    raise InputError(f"nothing is made on {device}.")


def doing(made, task):
    """Say who does it, or do what the task says."""
    match task:
        case "doze and die":
            time.sleep(0.7)
            os.kill(os.getpid(), signal.SIGKILL)
        case "refuse":
            raise InputError("this is refused.")
        case "fail":
            raise RuntimeError("out of memory\nof the card")
        case "sleep":
            time.sleep(300.0)
        case "nap":
            time.sleep(0.3)
        case "environment":
            return made[0], os.environ.get("CUDA_VISIBLE_DEVICES")
    return made, task, os.getpid()


@dataclass(frozen=True, eq=False)
class Mortal(Pretender):
    """A pretender whose process is killed at the load of this number, unless a file is there, which is made then."""

    loads: Loads | None = None
    number: int = 0
    mark: Path = Path()

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        pushed = loads.get(Pushed)
        if self.loads is not None and pushed is not None and not self.mark.exists():
            mine = self.loads.get(Pushed)
            if mine is not None and (pushed.point == mine.point[self.number]).all(axis=1).any():
                time.sleep(1.0)  # others finish what they have
                self.mark.touch()
                os.kill(os.getpid(), signal.SIGKILL)
        return super().deform(loads, start, at)


def mortal(device, count, number, mark):
    """One, on the small body; its loads are the first draw of palpation."""
    body = small_body()
    return Mortal(body, loads=draw("palpation", body, count, 0), number=number, mark=mark)


def gone(number):
    """Whether no process has this number any more, or it has ended; looked at for a while."""
    for _ in range(100):
        try:
            if Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except (FileNotFoundError, ProcessLookupError):
            return True
        time.sleep(0.1)
    return False
