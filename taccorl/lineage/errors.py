"""Errors of stores, artefacts, stage configurations and engines."""

from taccorl.errors import TaccorlError


class LineageError(TaccorlError):
    """A store, source or artefact that is missing, damaged or changed."""


class ConfigError(LineageError, TypeError):
    """A stage config that has no plain-JSON form, so that it cannot be part of a key."""


class EngineError(TaccorlError):
    """Items that failed, or a function or item that cannot be sent to another process."""
