"""State of each subject, from its outputs alone, and the reason to run it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NamedTuple

from tetopt.cohort.layout import failure_path, mesh_name, numbers_path, subject_folder, table_in
from tetopt.cohort.subjects import IMAGE_PATTERN

Status = Literal["done", "violated", "failed", "changed", "missing"]  # "violated": the mesh violates a requirement
WORDS_LISTED = 4  # changes that fit on a line


class SubjectState(NamedTuple):
    """The state of a subject."""

    status: Status
    why: str  # changes, or the failure; else empty


def state_of(out: Path, key: str, suffix: str, request: dict[str, Any] | None) -> SubjectState:
    """Return the state of a subject.

    Parameters
    ----------
    out : Path
    key : str
    suffix : str
        Suffix of its mesh's file.
    request : dict, optional
        The current request, from `tetopt.job.request.requested`; without it, existing outputs are not compared.
    """
    numbers = table_in(numbers_path(out, key))
    failure = table_in(failure_path(out, key))
    before = _request_of(numbers or {})
    mesh = subject_folder(out, key) / mesh_name(key, str(before["options"].get("format", suffix)))
    is_there = numbers is not None and mesh.is_file() and mesh.stat().st_size > 0
    if is_there and numbers is not None and (request is None or before.get("sha256") == request["sha256"]):
        return SubjectState(
            "violated" if numbers.get("violated") else "done", "; ".join((numbers.get("violated") or {}).values())
        )
    if failure is not None:
        return SubjectState("failed", str(failure.get("reason", "")))
    if is_there and request is not None:
        return SubjectState("changed", differences(before, request))
    return SubjectState("missing", "")


def _request_of(numbers: dict[str, Any]) -> dict[str, Any]:
    """Return the request of a run; empty if its numbers do not state one in tetopt's form."""
    request = numbers.get("request")
    if isinstance(request, dict) and all(isinstance(request.get(name), dict) for name in ("options", "files")):
        return request
    return {"options": {}, "files": {}}


def differences(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Describe the differences of two requests."""
    words = []
    for name in sorted({*before["options"], *now["options"]}):
        pair = [str(each["options"].get(name, "none")) for each in (before, now)]
        words += [f"{name} was {pair[0]}, now {pair[1]}"] if pair[0] != pair[1] else []
    for name in sorted({*before["files"], *now["files"]}):
        if before["files"].get(name) != now["files"].get(name):
            words.append(f"another {'image' if IMAGE_PATTERN.match(name) or name == 'images' else name}")
    if before.get("tetopt") != now["tetopt"]:
        words.append(f"tetopt was {before.get('tetopt', 'none')}, now {now['tetopt']}")
    more = f" and {len(words) - WORDS_LISTED} more" if len(words) > WORDS_LISTED else ""
    return "; ".join(words[:WORDS_LISTED]) + more
