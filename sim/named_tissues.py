"""Named tissues with the time scale for which they are valid, and the sources of their constants."""

from dataclasses import dataclass

from .material import BRAIN, MEASURED_BRAIN, IsotropicTissue, Material, Ogden

EX_VIVO = "seconds; fitted to strains up to 0.1"
BUDDAY = (
    "human, less than a day after death, tension, compression and shear in one fit: "
    "Budday et al. 2017, Acta Biomater. 48:319-340"
)


@dataclass(frozen=True)
class MaterialSet:
    """Tissue with the time scale for which it is valid and the source of its constants."""

    tissue: IsotropicTissue
    time_scale: str
    source: str


def _build_measured(mu: float, exponent: float) -> Ogden:
    """Return tissue with a shear modulus [Pa], nu 0.49, and the limit of strain of `MEASURED_BRAIN`."""
    return Ogden(((2.0 * mu, exponent),), 2.0 * mu * 1.49 / 0.06, limit=MEASURED_BRAIN.limit)


MATERIALS = {
    "default": MaterialSet(BRAIN, "seconds", "equal to the tissue `seconds`"),
    "brain": MaterialSet(MEASURED_BRAIN, EX_VIVO, f"the mean of cortex and corona radiata, {BUDDAY}"),
    "grey": MaterialSet(_build_measured(1500.0, -18.0), EX_VIVO, f"cortex, {BUDDAY}"),
    "white": MaterialSet(_build_measured(700.0, -24.0), EX_VIVO, f"corona radiata, {BUDDAY}"),
    "seed": MaterialSet(
        Material("neo-hookean", 3330.0, 0.4945),
        "seconds",
        "small-strain equivalent of the two-term Ogden law of Tonutti, Gras, Yang 2017, Artif. Intell. Med. 80:39-47",
    ),
    "seconds": MaterialSet(
        BRAIN,
        "seconds",
        "customary in simulating neurosurgery: Wittek, Hawkins, Miller 2009, Biomech. Model. Mechanobiol. 8:77-84",
    ),
    "undrained": MaterialSet(
        BRAIN.replace_constants(poisson=0.499),
        "the limit in which no fluid leaves the tissue",
        "`seconds`, nearer to incompressible",
    ),
    "drained": MaterialSet(
        BRAIN.replace_constants(2100.0, 0.45),
        "minutes to hours: the limit in which fluid has left the tissue; how fast it leaves is not modelled",
        "E 2.1 kPa, nu 0.45 in brain that consolidates: Miga, Paulsen et al. 1999, IEEE Trans. Med. Imaging 18:866-874",
    ),
    # mu is the shear modulus, with 2 mu / alpha^2 before the bracket, as in the measurements with which the paper
    # compares; if it were FEBio's c_1, the tissue would be half as stiff.
    "minutes": MaterialSet(
        Ogden(((1340.0, -19.0),), 148e3),
        "minutes",
        "mu 670 Pa, alpha -19, K 148 kPa from brain shift between prone and supine in vivo, PMC9748497",
    ),
    # Incompressible in the paper; the bulk modulus is that of an instantaneous Poisson's ratio of 0.49.
    "viscoelastic": MaterialSet(
        Ogden(((2.0 * 842.0, -4.7),), 842.0 * 2.98 / 0.06, ((0.45, 0.5), (0.365, 50.0))),
        "half a second to minutes, as loads say how much time goes by; else at once",
        "mu 842 Pa, alpha -4.7, g 0.45 and 0.365, tau 0.5 and 50 s: Miller, Chinzei 2002, J. Biomech. 35:483-490",
    ),
}
"""Tissues by the names used in commands, each with its valid time scale and the source of its constants.

The stiffness of brain depends on the duration of the load. `default` is the tissue of scenes and of the shipped
models. `viscoelastic` depends on the time of the loads. `seed` is the tissue of the published protocol.
"""
