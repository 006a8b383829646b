"""What a test registers is forgotten after it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from calib.data.registry import Registry


@contextmanager
def forgotten(*registries: Registry) -> Iterator[None]:
    """Take out of registries what was put in meanwhile."""
    before = [set(registry) for registry in registries]
    yield
    for registry, names in zip(registries, before, strict=True):
        for name in set(registry) - names:
            registry.discard(name)
