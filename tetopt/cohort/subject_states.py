"""State of each subject, from its outputs alone, and the reason to run it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NamedTuple

from tetopt.cohort.layout import failure_path, numbers_path, table_in
from tetopt.cohort.subjects import IMAGE_PATTERN
from tetopt.io.text import plain

# "violated": the mesh violates a requirement
Status = Literal["done", "violated", "failed", "changed", "missing"]
WORDS_LISTED = 4  # changes that fit on a line


class SubjectState(NamedTuple):
    """The state of a subject."""

    status: Status
    why: str  # on one line; empty for a subject that is done


def state_of(out: Path, key: str, request: dict[str, Any] | None = None) -> SubjectState:
    """Return the state of a subject.

    Parameters
    ----------
    out : Path
    key : str
    request : dict, optional
        The current request, from `tetopt.job.request.job_request`. Outputs of the same request
        count, whatever failed since; without it, outputs are not compared.
    """
    path, failure = numbers_path(out, key), failure_path(out, key)
    numbers = table_in(path)
    before = _request_of(numbers or {})
    is_same = request is not None and before.get("sha256") == request["sha256"]
    is_whole = numbers is not None and mesh_of(out, key) is not None
    if failure.exists() and not (is_whole and is_same):
        reason = (table_in(failure) or {}).get("reason", f"{failure.name} cannot be read")
        return SubjectState("failed", plain(str(reason)))
    if not path.exists():
        return SubjectState("missing", "not run yet")
    if numbers is None or not is_whole:
        wrong = (
            "its numbers cannot be read"
            if numbers is None
            else "its numbers exist, but its mesh is missing"
        )
        return SubjectState("failed", f"{wrong}; run it again")
    if request is not None and not is_same:
        return SubjectState("changed", differences(before, request))
    violated = numbers.get("violated") or {}
    return SubjectState("violated" if violated else "done", plain("; ".join(violated.values())))


def mesh_of(out: Path, key: str) -> Path | None:
    """Return the path of a subject's mesh, in any format; None without one."""
    path = numbers_path(out, key)
    files = (
        each
        for each in path.parent.glob(f"{path.stem}.*")
        if each.suffix != ".json" and each.stat().st_size > 0
    )
    return min(files, default=None)


def _request_of(numbers: dict[str, Any]) -> dict[str, Any]:
    """Return the request of a run; empty if its numbers do not state one in tetopt's form."""
    request = numbers.get("request")
    if isinstance(request, dict) and all(
        isinstance(request.get(name), dict) for name in ("options", "files")
    ):
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
            words.append(
                f"another {'image' if IMAGE_PATTERN.match(name) or name == 'images' else name}"
            )
    if before.get("tetopt") != now["tetopt"]:
        words.append(f"tetopt was {before.get('tetopt', 'none')}, now {now['tetopt']}")
    more = f" and {len(words) - WORDS_LISTED} more" if len(words) > WORDS_LISTED else ""
    return "; ".join(words[:WORDS_LISTED]) + more
