"""Division of a run: in one piece, by this process alone, or in parts, by workers with a work directory."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, TypeVar

from tetopt.errors import InputError
from tetopt.image import Image

FEWEST_NODES_EACH = 100  # per part: half of 150 nodes are shared and fixed
WORK_SUFFIX = ".work"  # of the work directory next to the mesh, appended to its name

Way = TypeVar("Way")


class Division(NamedTuple):
    """The number of parts of a mesh during optimisation.

    A run in one piece has one part with all iterations in a single round, in this process and without a work directory;
    `chosen` selects between alternatives that differ.
    """

    n_parts: int | None = None  # minimum number, with a work directory; None: in one piece

    def chosen(self, in_one_piece: Way, in_parts: Way) -> Way:
        """Return the alternative that applies to the run."""
        return in_one_piece if self.n_parts is None else in_parts

    @property
    def stated(self) -> dict[str, int]:
        """The option as written to the mesh's file and run.json."""
        return {} if self.n_parts is None else {"parts": self.n_parts}

    def check_image(self, image: Image) -> None:
        """Raise InputError for an image that cannot be divided into parts."""
        if self.n_parts is not None and image.ndim != 3:
            raise InputError("`parts`: expected a 3-D image, got a 2-D one; omit the option")

    def checked_number(self, nodes: int) -> int:
        """Return the minimum number of parts; InputError if nearly all nodes would be shared."""
        number, most = self.n_parts or 1, max(nodes // FEWEST_NODES_EACH, 1)
        if number > most:
            raise InputError(
                f"`parts`: expected at most {most} for {nodes} nodes ({FEWEST_NODES_EACH} each), got {number}"
            )
        return number


def work_folder(mesh: Path) -> Path:
    """Return the work directory of a run in parts, given the mesh's file."""
    return mesh.with_name(mesh.name + WORK_SUFFIX)
