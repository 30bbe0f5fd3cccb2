"""What can be wrong with a store, an artefact, a stage's config, or the items given to an engine."""

from taccorl.errors import TaccorlError


class LineageError(TaccorlError):
    """A store, a source or an artefact that is not what it should be."""


class ConfigError(LineageError, TypeError):
    """A stage config that has no plain-JSON form, so that it cannot be part of a key."""


class EngineError(TaccorlError):
    """Items that failed, or a function or item that cannot be sent to another process."""
