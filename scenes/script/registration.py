"""Registration of the scan to the patient, as a setting of a scene."""

from collections.abc import Mapping
from typing import Literal

Registration = Literal["perfect", "clinical"]
CLINICAL_DEVIATION = 1.56e-3
"""Standard deviation of a clinical registration along each axis [m].

2.49 mm in the mean by point pairs in 11 patients: Mongen, Willems 2019, Acta Neurochir. 161.
"""
REGISTRATIONS: Mapping[Registration, float] = {"perfect": 0.0, "clinical": CLINICAL_DEVIATION}
"""Standard deviation of each registration along each axis [m]."""


def describe_registration(deviation: float) -> str:
    """Describe a registration by its standard deviation along each axis [m]."""
    return f"clinical registration, {1e3 * deviation:.1f} mm per axis" if deviation else "perfect registration"
