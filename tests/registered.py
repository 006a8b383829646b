"""What a test registers is forgotten after it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from calib.batch import user_code
from calib.data.registry import Registry


@contextmanager
def forgotten(*registries: Registry) -> Iterator[None]:
    """Take out of registries what was put in meanwhile."""
    before = [set(registry) for registry in registries]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(user_code, "_loaded", {})
        patch.setattr(user_code, "_content", dict(user_code._content))
        yield
    for registry, names in zip(registries, before, strict=True):
        for name in set(registry) - names:
            registry.discard(name)
