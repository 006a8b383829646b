"""The one exception a user sees: what was found, where, what is allowed, how to mend it."""

from __future__ import annotations


class CalibError(Exception):
    """Raised for every problem the user can mend.

    Parameters
    ----------
    message : str
        What was found.
    where : str, optional
        File, row, column or parameter at which it was found.
    allowed : str, optional
        What would have been accepted there.
    mend : str, optional
        What to do about it.
    """

    def __init__(
        self,
        message: str,
        *,
        where: str | None = None,
        allowed: str | None = None,
        mend: str | None = None,
    ) -> None:
        self.message = message
        self.where = where
        self.allowed = allowed
        self.mend = mend
        super().__init__(str(self))

    def __str__(self) -> str:
        lines = [f"{self.where}: {self.message}" if self.where else self.message]
        if self.allowed:
            lines.append(f"  allowed: {self.allowed}")
        if self.mend:
            lines.append(f"  to mend: {self.mend}")
        return "\n".join(lines)

    def within(self, *places: str | None) -> CalibError:
        """Return the error with what it was found in named before where it was found."""
        where = ", ".join(filter(None, (*places, self.where)))
        return CalibError(self.message, where=where, allowed=self.allowed, mend=self.mend)

    def __reduce__(self) -> tuple[object, ...]:
        # Keyword-only arguments do not survive the default pickling between worker processes.
        return (_rebuild, (self.message, self.where, self.allowed, self.mend))


def _rebuild(message: str, where: str | None, allowed: str | None, mend: str | None) -> CalibError:
    return CalibError(message, where=where, allowed=allowed, mend=mend)
