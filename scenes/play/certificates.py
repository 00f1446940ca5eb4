"""What a certificate says of each drawn frame, beside what the finite elements say that were solved to the end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sim.deformation import Deformation
from sim.fem import Fem
from surrogate.evaluation.certificate import certify, largest

from .player import Frame


@dataclass(frozen=True)
class Certified:
    """One frame: distances of the worst tumour vertex [mm], and what they took [ms].

    Parameters
    ----------
    frame
        Its number.
    estimate_mm, left_mm
        What the certificate says of the prediction, and of what it was corrected to.
    error_mm, corrected_mm
        The same, by the finite elements solved to the end.
    predict_ms, estimate_ms, correct_ms
        For the prediction, for the estimate, and for the correction besides.
    sound
        Whether so little is left that the estimate is the error.
    """

    frame: int
    estimate_mm: float
    left_mm: float
    error_mm: float
    corrected_mm: float
    predict_ms: float
    estimate_ms: float
    correct_ms: float
    sound: bool

    def __str__(self) -> str:
        doubt = "" if self.sound else "; not certain, for too much is left after three steps"
        return (
            f"frame {self.frame}: off by {self.estimate_mm:.4f} mm as estimated ({self.error_mm:.4f} if solved to the "
            f"end), by {self.left_mm:.4f} ({self.corrected_mm:.4f}) when corrected; {self.predict_ms:.1f} ms to "
            f"predict, {self.estimate_ms:.0f} to estimate, {self.correct_ms:.0f} to correct{doubt}"
        )


def certified(fem: Fem, frames: Sequence[Frame], truth: Deformation) -> Iterator[Certified]:
    """A certificate for each frame, one by one; `truth` has one row for each."""
    tumour = fem.anatomy.tumour_nodes
    if frames:  # what is made for the first load alone is no cost of a certificate
        certify(fem, frames[0].loads, frames[0].deformation)
    for row, frame in enumerate(frames):
        found = certify(fem, frame.loads, frame.deformation)
        true = truth.at(tumour).displacement[row : row + 1]
        searched = found.cost.seconds["search"]
        yield Certified(
            frame.number,
            1e3 * float(found.estimate[0]),
            1e3 * float(found.left[0]),
            1e3 * float(largest(frame.deformation.at(tumour).displacement - true)[0]),
            1e3 * float(largest(found.corrected.at(tumour).displacement - true)[0]),
            1e3 * frame.deformation.cost.total,
            1e3 * (found.cost.total - searched),
            1e3 * searched,
            bool(found.sound[0]),
        )
