"""Import of optional packages, with a one-line error that names a missing package."""

from collections.abc import Iterator
from contextlib import contextmanager

from ..errors import InputError


def install_hint(extra: str) -> str:
    """Return a sentence that explains how to install an extra of this package, from a checkout of its repository."""
    return f"Install it in the checkout: pip install -e '.[{extra}]'."


@contextmanager
def require_extra(extra: str, message: str) -> Iterator[None]:
    """Run a block that imports packages of an extra; `message` is its start, as "these environments need".

    Raises
    ------
    InputError
        A package is missing; the message names this package and explains how to install the extra.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        raise InputError(f"{message} the package {package}, which is not installed. {install_hint(extra)}") from error
