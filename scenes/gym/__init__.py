"""Surgical tasks as Gymnasium environments, which the import of this package registers; needs the extra `gym`."""

from .registration import register_environments

register_environments()
