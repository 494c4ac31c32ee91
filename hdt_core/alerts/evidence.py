"""Evidence of an alert, for and against, and its text."""

from dataclasses import dataclass
from typing import NamedTuple

SUPPORTS, NEUTRAL, AGAINST = ROLES = ("Supports", "Neutral", "Against")


class Corroboration(NamedTuple):
    """An independent observation that bears on an alert: its role (of `ROLES`) and its text."""

    role: str
    text: str


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of an alert at one moment.

    Attributes
    ----------
    finding : str
        What changed, by how much, since when.
    corroborations : tuple of Corroboration
        Other observations, each with its role.
    otherwise : str
        Other explanations.
    waiting : str
        Cost of waiting.
    """

    finding: str
    corroborations: tuple[Corroboration, ...]
    otherwise: str
    waiting: str

    def text(self) -> str:
        """Return one paragraph: the finding, its corroborations by role, the alternatives, the cost."""
        by_role = ((role, [w.text for w in self.corroborations if w.role == role]) for role in ROLES)
        sentences = [f"{role}: {'; '.join(texts)}." for role, texts in by_role if texts]
        return " ".join([f"{self.finding}.", *sentences, f"Else: {self.otherwise}.", f"{self.waiting}."])
