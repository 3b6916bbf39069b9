"""Engines by name, each imported on request, as its package may not be installed."""

from __future__ import annotations

from importlib import import_module

from ..engines.base import Engine, EngineConfig
from ..errors import ConfigError

# The module and the class of each.
_HOMES = {
    "local": (".local", "LocalEngine"),
    "ray": (".ray_cluster", "RayEngine"),
    "slurm": (".slurm", "SlurmEngine"),
}
ENGINES = tuple(_HOMES)


def make_engine(name: str, config: EngineConfig) -> Engine:
    """Return an engine by name.

    Raises:
        ConfigError: if there is no such engine.
        ExperimentError: if the package that it needs is not installed.
    """
    if name not in _HOMES:
        raise ConfigError(f"unknown engine {name!r}; known engines: {', '.join(ENGINES)}")
    module, kind = _HOMES[name]
    engine: Engine = getattr(import_module(module, __package__), kind)(config)
    return engine
