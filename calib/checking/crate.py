"""Pack a folder as a research object: an RO-Crate with its files and how to compute them again.

RO-Crate 1.3, doi:10.5281/zenodo.3406497. The folder is packed as it is, below the crate's root, so
that `calib check` takes it from there.
"""

from __future__ import annotations

import io
import re
import tempfile
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path, PurePosixPath
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

from calib.batch.environment import sha256
from calib.batch.folders import fresh_folder, writing
from calib.checking.check import check, read_folder
from calib.checking.folders import files_in, labels_in
from calib.data.reader import said_of
from calib.errors import CalibError
from calib.models.simulators.files import load_files

_FORMATS: Mapping[str, str] = {
    ".csv": "text/csv", ".json": "application/json", ".toml": "application/toml",
    ".nc": "application/x-netcdf", ".png": "image/png", ".pdf": "application/pdf",
    ".html": "text/html", ".tex": "application/x-tex", ".bib": "application/x-bibtex",
    ".txt": "text/plain", ".md": "text/markdown",
}  # fmt: skip
_INPUT = re.compile(r"(^|/)(data|priors|case)/|(^|/)(data\.csv|priors\.toml|held_out\.csv)$")
_NO_PINS = ("python", "terracalib")
_ORCID = re.compile(r"^(.+?)[\s<(]+(?:https://orcid\.org/)?((?:\d{4}-){3}\d{3}[\dX])[>)]?$")


def write_crate(
    folder: Path, out: Path, *, licence: str, authors: Sequence[str] = (),
    models: Sequence[Path] = (), published: date | None = None,
) -> list[str]:  # fmt: skip
    """Pack a folder of `calib fit`, `report`, `compare` or `diagnose` as an RO-Crate.

    Parameters
    ----------
    folder : Path
        Nothing in it is changed.
    out : Path
        Folder, or file with the suffix .zip, to write.
    licence : str
        SPDX identifier or address of the licence that the data and results are given under.
    authors : sequence of str
        Names, each with an ORCID behind it if there is one.
    models : sequence of Path
        Python files with models of one's own that the folder was made with.
    published : date, optional
        Today by default.

    Returns
    -------
    list of str
        The files in it.

    Raises
    ------
    CalibError
        If there is no licence, the folder cannot be checked or is not as its record says, or `out`
        exists.

    Examples
    --------
    >>> write_crate(Path("run"), Path("crate.zip"), licence="CC-BY-4.0")  # doctest: +SKIP
    """
    try:
        from rocrate.model.contextentity import ContextEntity
        from rocrate.rocrate import ROCrate
    except ModuleNotFoundError:
        raise CalibError(
            "a research object needs a package that is not installed", expected="rocrate",
            hint="pip install 'terracalib[crate]'",
        ) from None  # fmt: skip
    if not licence:
        raise CalibError(
            "a research object needs a licence, without which nobody may use it",
            expected="--license with an SPDX identifier or an address",
            hint="ask who owns the measurements; with CC-BY-4.0 others may use them and name you",
        )
    if out.exists():
        raise CalibError("it exists already", where=str(out), hint="choose another --out")
    folder, record = folder.resolve(), read_folder(folder)
    load_files(sorted((folder / "emulators").glob("*.npz")))
    outcome = check(folder, quick=True)
    if outcome.exit_code:
        raise CalibError(
            f"the folder is not as its record says ({outcome.verdict})", where=str(folder),
            hint=f"`calib check {folder.name}` says more; make it again, or restore its files",
        )  # fmt: skip
    crate = ROCrate(version="1.3")
    versions = {"terracalib": record.environment.versions["terracalib"], **record.versions}
    how = _recompute(folder.name, versions, [path.name for path in models])

    def entity(place: str, kind: str, **properties: Any) -> Any:
        return crate.add(ContextEntity(crate, place, {"@type": kind, **properties}))

    def pack(name: str, content: bytes, said: str) -> Any:
        form = _FORMATS.get(PurePosixPath(name).suffix, "application/octet-stream")
        about = {
            "name": name, "encodingFormat": form, "contentSize": str(len(content)),
            "sha256": sha256(content), "description": said,
        }  # fmt: skip
        return crate.add_file(io.BytesIO(content), name, properties=about)

    said = said_of(", ".join(labels_in(folder)))
    crate.name = f"{folder.name}: a {record.kind} of calib"
    crate.description = f"Data, priors, results and how to compute them again. {said}"
    crate.datePublished = (published or date.today()).isoformat()
    address = licence if "://" in licence else f"https://spdx.org/licenses/{licence}"
    crate.license = entity(address, "CreativeWork", name=licence, url=address,
                           description="What may be done with the data and results.")  # fmt: skip
    people = []
    for i, author in enumerate(authors, start=1):
        named = _ORCID.match(author)
        place = f"https://orcid.org/{named[2]}" if named else f"#author-{i}"
        people.append(entity(place, "Person", name=named[1] if named else author))
    inputs: list[Any] = []
    results: list[Any] = []
    for name in sorted(files_in(folder)):
        where, role = (inputs, "Input") if _INPUT.search(name) else (results, "Result")
        content, said = (folder / name).read_bytes(), f"{role} of {record.WRITTEN_BY}"
        where.append(pack(f"{folder.name}/{name}", content, said))
    for path in models:
        inputs.append(pack(f"models/{path.name}", path.read_bytes(), "Models of the user"))
    pack("README.md", how.encode(), "How to compute it again")
    pins = (f"{name}=={v}\n" for name, v in versions.items() if name not in _NO_PINS)
    pinned = pack("constraints.txt", "".join(pins).encode(), "The packages it was made with")
    # The program has no public address yet: the README says how to get it.
    program = entity(
        "#calib", "SoftwareApplication", name="calib (terracalib)", url={"@id": "README.md"},
        version=versions["terracalib"], softwareRequirements=pinned,
        description=f"Source files and priors with the SHA-256 {record.code}.",
    )  # fmt: skip
    made = entity(
        "#made", "CreateAction", name=record.WRITTEN_BY, agent=_one(people), instrument=program,
        description=f"{record.WRITTEN_BY}, with the seed {record.seed}",
        object=_one(inputs), result=_one(results),
    )  # fmt: skip
    again = entity("#recompute", "HowTo", name="How to compute it again", text=how, tool=program)
    crate.root_dataset["mentions"] = [made, again]
    if people:
        crate.root_dataset["author"] = crate.publisher = _one(people)
    with writing(out):
        if out.suffix == ".zip":
            with tempfile.TemporaryDirectory(prefix="calib-crate-") as scratch:
                crate.write(scratch)
                with ZipFile(out, "w", ZIP_DEFLATED) as packed:
                    for path in sorted(p for p in Path(scratch).rglob("*") if p.is_file()):
                        packed.write(path, path.relative_to(scratch))
        else:
            with fresh_folder(out) as whole:
                crate.write(whole)
    return [str(file.id) for file in crate.data_entities]


def _one(values: list[Any]) -> Any:
    """A list of one is that one, as RO-Crate 1.3 asks."""
    return values[0] if len(values) == 1 else values


def _recompute(name: str, versions: Mapping[str, str], models: Sequence[str]) -> str:
    own = "".join(f" --models models/{model}" for model in models)
    version = versions["terracalib"]
    released = f"pip install 'terracalib=={version}' -c constraints.txt"
    commit = version.partition("+g")[2].partition(".")[0]
    if commit:
        released = f"pip install -c constraints.txt .  # in a checkout of calib, commit {commit}"
    return (
        f"# How to compute `{name}` again\n\n"
        f"Python {versions.get('python', '3.12 or later')}, calib {version}:\n\n"
        f"```console\n{released}\ncalib check {name}{own}\n```\n\n"
        f"`calib check` computes every number again from the data, priors and seed in `{name}`, "
        "compares, and says what differs. It ends with 0 where nothing does.\n"
    )
