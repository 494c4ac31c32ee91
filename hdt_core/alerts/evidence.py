"""What speaks for an alert, what against it, and how that is written down."""

from dataclasses import dataclass
from typing import NamedTuple

SUPPORTS, NEUTRAL, AGAINST = ROLES = ("Supports", "Neutral", "Against")


class Corroboration(NamedTuple):
    """A second look at what an alert claims: its role (of `ROLES`) and what it shows."""

    role: str
    says: str


@dataclass(frozen=True, slots=True)
class Evidence:
    """Why an alert stands, at one moment.

    Attributes
    ----------
    moved : str
        What moved, by how much, since when.
    witnesses : tuple of Corroboration
        What else was looked at, each with its role.
    otherwise : str
        What else could explain it.
    waiting : str
        What waiting costs.
    """

    moved: str
    witnesses: tuple[Corroboration, ...]
    otherwise: str
    waiting: str

    def text(self) -> str:
        """One paragraph: the finding, its witnesses by role, the alternatives, the cost."""
        by_role = ((role, [w.says for w in self.witnesses if w.role == role]) for role in ROLES)
        told = [f"{role}: {'; '.join(says)}." for role, says in by_role if says]
        return " ".join([f"{self.moved}.", *told, f"Else: {self.otherwise}.", f"{self.waiting}."])
