"""A simulator behind an UM-Bridge server, asked over HTTP."""

from __future__ import annotations

import json
import socket
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from http.client import HTTPException
from typing import Any, Literal
from urllib.parse import urlsplit

from calib.errors import CalibError
from calib.models.base import Array
from calib.models.simulators.base import Failure, Given, Printed, not_made, tail


@dataclass(frozen=True)
class UmbridgeWay:
    """A model behind an UM-Bridge server (protocol 1.0, doi:10.21105/joss.04748).

    The protocol is one POST of JSON. The client of the package `umbridge` has no limit of time and
    stops at a NaN in a reply, so it is spoken here.

    Parameters
    ----------
    columns : tuple of str
        The outputs, in the order of the server's output vectors.
    rows : {"each", "config"}
        ``each``: one call for each row of conditions, parameters then conditions as one input
        vector, an output vector of one number each. ``config``: one call, the conditions as lists
        in the call's ``config``, an output vector of n numbers each.
    limit : float
        Seconds for each call.
    """

    url: str
    model: str
    columns: tuple[str, ...]
    rows: Literal["each", "config"] = "each"
    limit: float = 600.0

    @property
    def identity(self) -> str:
        """Where it is and how it is called."""
        return json.dumps(["umbridge", self.url, self.model, self.columns, self.rows])

    @property
    def key(self) -> str:
        """The key of a simulator file."""
        return "url"

    @property
    def runs(self) -> bool:
        """Always."""
        return True

    def run(self, parameters: Mapping[str, float], conditions: Mapping[str, Array]) -> Given:
        """Call the server."""
        theta = list(parameters.values())
        lists = {name: values.tolist() for name, values in conditions.items()}
        if self.rows == "config":
            calls = [self.ask("Evaluate", {"input": [theta], "config": lists})]
        else:
            calls = []
            for row in zip(*lists.values(), strict=True):
                calls.append(self.ask("Evaluate", {"input": [[*theta, *row]], "config": {}}))
                if isinstance(calls[-1], Failure):
                    break
        outputs: dict[str, list[Any]] = {name: [] for name in self.columns}
        for reply in calls:
            if isinstance(reply, Failure):
                return reply
            vectors = reply.get("output")
            if not isinstance(vectors, list) or len(vectors) != len(self.columns):
                given = len(vectors) if isinstance(vectors, list) else 0
                what = f"the reply has {given} output vectors for {', '.join(self.columns)}"
                return Failure("unreadable", what, tail(str(reply)))
            if not all(isinstance(values, list) for values in vectors):
                what = "the reply is not of output vectors of numbers"
                return Failure("unreadable", what, tail(str(reply)))
            for name, values in zip(self.columns, vectors, strict=True):
                outputs[name].append(values)
        return Printed(outputs, tail(str(calls[-1])))

    def ask(self, what: str, content: Mapping[str, Any]) -> dict[str, Any] | Failure:
        """Send one request of the protocol; a CalibError if there is no server."""
        body = json.dumps({"name": self.model, **content}).encode()
        try:
            request = urllib.request.Request(
                f"{self.url.rstrip('/')}/{what}", body, {"Content-Type": "application/json"}
            )
            with urllib.request.urlopen(request, timeout=self.limit) as reply:
                answer = reply.read()
        except urllib.error.HTTPError as error:
            if error.code not in _OF_THE_MODEL:
                raise self._not_there(f"{error.code} {error.reason}") from None
            return Failure("error", f"the server answered {error.code}", tail(_body(error)))
        except (urllib.error.URLError, ValueError) as error:  # before anything was asked
            raise self._not_there(getattr(error, "reason", error)) from None
        except (OSError, HTTPException) as error:
            if not self._listens():
                raise self._not_there(error) from None
            if isinstance(error, TimeoutError):
                return Failure("time", f"the server took longer than {self.limit:g} s")
            return Failure("error", f"the server at {self.url} did not answer: {error}")
        try:
            # Python's reader takes the NaN and Infinity that JSON does not have.
            found = json.loads(answer)
        except ValueError:
            said = tail(answer.decode(errors="replace"))
            return Failure("unreadable", "the server's reply is not JSON", said)
        if not isinstance(found, dict) or "error" in found:
            return Failure("error", "the server reports an error", tail(str(found)))
        return found

    def _not_there(self, why: object) -> CalibError:
        return not_made(f"the server at {self.url} is not there ({why})", "start it")

    def _listens(self) -> bool:
        """Whether something is there to answer: a server that died has no faulty parameters."""
        try:
            place = urlsplit(self.url)
            port = place.port or (443 if place.scheme == "https" else 80)
            socket.create_connection((place.hostname or "", port), self.limit).close()
        except (OSError, ValueError):
            return False
        return True


# What a server answers of itself with (protocol 1.0): a call that its model will not have, a model
# that failed. With any other code it was not the model that answered.
_OF_THE_MODEL = (400, 500)


def _body(error: urllib.error.HTTPError) -> str:
    return error.read().decode(errors="replace")
