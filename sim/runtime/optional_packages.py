"""Import of optional packages, with a one-line error that names the missing one."""

from collections.abc import Iterator
from contextlib import contextmanager

from ..errors import InputError


def install_hint(extra: str) -> str:
    """Return a sentence on how to install an extra of this package: from its checkout, as no index has it."""
    return f"Install it in the checkout: pip install -e '.[{extra}]'."


@contextmanager
def require_extra(extra: str, what: str) -> Iterator[None]:
    """Import packages of an extra in a block; `what` needs them: "these environments need".

    Raises
    ------
    InputError
        Replaces ModuleNotFoundError: names the missing package, and how to install the extra.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        raise InputError(f"{what} the package {package}, which is not installed. {install_hint(extra)}") from error
