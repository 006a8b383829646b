"""What numbers depend on beside data, priors and seed: versions, processor, the code itself.

Where these differ, numbers may be rounded otherwise; what that may change is stated in
`calib.checking.tolerances`. One thread of linear algebra, whatever the machine has and the caller
has set, for several add up in another order; and no floating-point errors.
"""

from __future__ import annotations

import hashlib
import platform
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib.errors import CalibError

if TYPE_CHECKING:
    import numpy as np


@contextmanager
def from_the_bench(what: str) -> Iterator[None]:
    """Say of an import of `challenge` within the block that a wheel does not have it.

    Raises
    ------
    CalibError
        Naming the command or table that needs it.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "challenge":
            raise
        raise CalibError(
            "the challenge is a test bench of the repository, not of the wheel",
            where=what,
            expected="a checkout of the repository, with its folder `challenge`",
            hint="run from a checkout: `pip install -e .` in it",
        ) from None


_PACKAGES = (
    "terracalib", "numpy", "scipy", "emcee", "arviz", "arviz-base", "arviz-stats", "xarray",
    "matplotlib", "corner", "pillow", "jinja2", "h5netcdf", "h5py",
)  # fmt: skip


@dataclass(frozen=True)
class Environment:
    """Where a result was made; nothing in it names a computer or a person.

    Parameters
    ----------
    versions : mapping of str to str
        Of Python and of the packages that numbers and figures depend on.
    machine : mapping of str to str
        Processor family, system, C library, linear algebra with the kernels it chose for the
        processor, and the vector instructions that NumPy uses.
    code : str
        SHA-256 over the source files of this package and its priors.
    """

    versions: Mapping[str, str]
    machine: Mapping[str, str]
    code: str

    @classmethod
    def here(cls) -> Environment:
        """Return the environment of this process."""
        return cls(versions(), _machine(), code_sha256())

    def document(self) -> dict[str, Any]:
        """Return it as plain dictionaries."""
        return {"versions": dict(self.versions), "machine": dict(self.machine), "code": self.code}

    def differences(self, other: Environment) -> dict[str, tuple[str, str]]:
        """Return what differs, as pairs of this one's and the other's value."""
        mine, theirs = self._flat(), other._flat()
        return {
            name: (mine.get(name, "none"), theirs.get(name, "none"))
            for name in dict.fromkeys([*mine, *theirs])
            if mine.get(name) != theirs.get(name)
        }

    def same_program(self, other: Environment) -> bool:
        """Whether equal numbers must give equal files: the same code and packages.

        Which code it is its fingerprint says; its version changes with every commit.
        """
        own, *others = _PACKAGES
        return not (set(self.differences(other)) - {own}) & {*others, "code"}

    def _flat(self) -> dict[str, str]:
        return {**self.versions, **self.machine, "code": self.code}


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that numbers depend on."""
    return {"python": sys.version.split()[0], **{name: version(name) for name in _PACKAGES}}


def _machine() -> dict[str, str]:
    import numpy as np

    config: Any = np.show_config(mode="dicts")
    simd, blas = config["SIMD Extensions"], config["Build Dependencies"]["blas"]
    return {
        "processor": platform.machine(),
        "system": platform.system(),
        "c_library": " ".join(platform.libc_ver()).strip(),
        "linear_algebra": f"{blas['name']} {blas['version']}",
        "kernels": " ".join(blas_kernels()),
        "simd": " ".join([*simd.get("baseline", ()), *simd.get("found", ())]),
    }


def sha256(content: bytes) -> str:
    """Return the SHA-256 of bytes in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def unix_lines(content: bytes) -> bytes:
    """Return bytes with the line ends of Unix."""
    return content.replace(b"\r\n", b"\n")


def differs_in_lines(content: bytes, expected: str) -> bool:
    """Whether bytes have an expected SHA-256 but for line ends, as git's autocrlf changes them."""
    unix = unix_lines(content)
    return expected in (sha256(unix), sha256(unix.replace(b"\n", b"\r\n")))


@cache
def code_sha256() -> str:
    """Return the SHA-256 over the source files of this package and the priors shipped with it."""
    package = Path(__file__).resolve().parents[1]
    packaged = package / "_priors"
    # A checkout has the priors beside the package, a wheel in it; they are named alike.
    priors = packaged if packaged.is_dir() else package.parent / "priors"
    files = {
        f"priors/{path.relative_to(priors).as_posix()}": path for path in priors.rglob("*.toml")
    }
    files |= {
        path.relative_to(package).as_posix(): path
        for path in package.rglob("*")
        if path.suffix in (".py", ".j2", ".css", ".js", ".toml")
        and path.is_file()
        and packaged not in path.parents
    }
    digest = hashlib.sha256()
    for name, path in sorted(files.items()):
        # Line ends are the checkout's, not the code's.
        content = unix_lines(path.read_bytes())
        digest.update(f"{name}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()


@contextmanager
def one_thread() -> Iterator[None]:
    """Do linear algebra on one thread: the last bits are the same on any number of cores.

    Also a decorator. The matrices are small, so that more threads would not be faster. Nor does
    it matter whether the caller has NumPy raise floating-point errors.
    """
    with _libraries().limit(limits=1, user_api="blas"), no_floating_point_errors():
        yield


def no_floating_point_errors() -> np.errstate:
    """Have NumPy warn of what it would raise, as it does by default (not of underflow)."""
    import numpy as np

    usual: Any = {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"}
    set_here: dict[str, Any] = np.geterr()  # type: ignore[assignment]
    return np.errstate(**{k: usual[k] if v == "raise" else v for k, v in set_here.items()})


def blas_kernels() -> list[str]:
    """Name the processors that the linear algebra's kernels are made for, as it chose them."""
    found = {str(library.get("architecture", "")) for library in _libraries().info()}
    return sorted(found - {""})


@cache
def _libraries() -> Any:
    # SciPy brings a library of its own, which is found only once it is loaded.
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
