"""Ask roc-validator whether it accepts a research object, without the network.

As a program, in the environment that has it: python roc_validate.py CONTEXT CRATE. CONTEXT is the
file of RO-Crate 1.3 that `rocrate` ships: it stands for the one address that is asked for.
"""

import sys
from pathlib import Path
from typing import Any

import requests
from requests.adapters import HTTPAdapter
from rocrate_validator import models, services


def send(self: HTTPAdapter, request: Any, **_: Any) -> requests.Response:
    if request.url != "https://w3id.org/ro/crate/1.3/context":
        raise requests.ConnectionError(request.url)
    found = requests.Response()
    found.status_code, found.url, found.request = 200, request.url, request
    found._content = Path(sys.argv[1]).read_bytes()
    found.headers["Content-Type"] = "application/ld+json"
    return found


HTTPAdapter.send = send  # type: ignore[method-assign]
settings = services.ValidationSettings(
    rocrate_uri=sys.argv[2], profile_identifier="ro-crate-1.3", no_cache=True,
    requirement_severity=models.Severity.REQUIRED,
)  # fmt: skip
result = services.validate(settings)
for issue in result.get_issues():
    print(issue.check.identifier, issue.message)
raise SystemExit(not result.passed())
