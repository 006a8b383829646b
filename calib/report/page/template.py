"""The templates of all pages, from one set-up."""

from __future__ import annotations

from functools import cache
from pathlib import PurePosixPath

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template

from calib.report.labels import unbroken

_HERE = "calib.report.page"


@cache
def template(name: str, package: str = _HERE) -> Template:
    """Return a template by the name of its file in a package, which may include those of this one.

    It escapes what it is given; a name that it is not given is an error.
    """
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(p, ".") for p in dict.fromkeys((package, _HERE))]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["unbroken"] = unbroken
    environment.filters["basename"] = lambda path: PurePosixPath(path).name
    return environment.get_template(name)
