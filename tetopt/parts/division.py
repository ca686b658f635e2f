"""How a run is divided: in one piece, by this process alone, or in parts, by workers, from a folder of work."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, TypeVar

from tetopt.errors import InputError
from tetopt.image import Image
from tetopt.parts.rounds import expected_parts

FEWEST_NODES_EACH = 100  # of a part: of 150 half are shared, and stay
WORK_SUFFIX = ".work"  # of the work directory beside the mesh, after its name

Way = TypeVar("Way")


class Division(NamedTuple):
    """Into how many parts a mesh is divided while it is optimised.

    A run in one piece is that of one part which has all iterations in its one round, in this process and without a
    folder; of whatever differs `chosen` takes one.
    """

    n_parts: int | None = None  # at least so many, in a folder of work; None in one piece

    def chosen(self, in_one_piece: Way, in_parts: Way) -> Way:
        """Which of two ways to do a thing is that of the run."""
        return in_one_piece if self.n_parts is None else in_parts

    @property
    def stated(self) -> dict[str, int]:
        """What the mesh's file and run.json say of it among the options."""
        return {} if self.n_parts is None else {"parts": self.n_parts}

    def check_image(self, image: Image) -> None:
        """InputError for an image that cannot be divided so."""
        if self.n_parts is not None and image.ndim != 3:
            raise InputError("`parts`: of a volume, and the image is a plane; leave it out")

    def checked_number(self, nodes: int) -> int:
        """Of parts, at least; InputError for so many that hardly one of the nodes is a part's own."""
        number, most = self.n_parts or 1, max(nodes // FEWEST_NODES_EACH, 1)
        if number > most:
            raise InputError(
                f"`parts`: expected up to {most} of {nodes} nodes, {FEWEST_NODES_EACH} each, got {number}; ask for "
                "fewer"
            )
        return number

    def expected(self, image: Image, nodes: int) -> tuple[int, float]:
        """How many parts there will be in a round, and the bytes that each takes; InputError for too many."""
        return expected_parts(image, nodes, self.checked_number(nodes))


def work_folder(mesh: Path) -> Path:
    """Where what a run in parts has done lies until it is complete, by the mesh's file."""
    return mesh.with_name(mesh.name + WORK_SUFFIX)
