"""Surgical tasks as Gymnasium environments; importing this registers them, and needs the extra `gym`."""

from .registration import register_environments

register_environments()
