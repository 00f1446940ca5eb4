"""Surgical tasks as Gymnasium environments, registered by the import of this package; needs the extra `gym`."""

from .registration import register_environments

register_environments()
