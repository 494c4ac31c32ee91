"""Evidence of an alert: what changed and since when, observations for and against it, the cost of waiting."""

from dataclasses import dataclass
from typing import NamedTuple

from hdt_core.alerts import phrases
from hdt_core.alerts.text import Figures, Phrase, Text, TextList, as_parts, dump_parts
from hdt_core.robust import Z_90

SUPPORTS, NEUTRAL, AGAINST = ROLES = ("Supports", "Neutral", "Against")
ELSE = "Else"


class Corroboration(NamedTuple):
    """An independent observation that bears on an alert: its role (of `ROLES`) and its text."""

    role: str
    text: str


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of an alert at one moment.

    Attributes
    ----------
    findings : tuple of str
        What changed, by how much, since when.
    corroborations : tuple of Corroboration
        Other observations, each with its role.
    otherwise : str
        Other explanations.
    waiting : str
        Cost of waiting.
    """

    findings: tuple[str, ...]
    corroborations: tuple[Corroboration, ...]
    otherwise: str
    waiting: str

    def sections(self) -> list[tuple[str, TextList]]:
        """Return the findings, their corroborations by role, the alternatives and the cost, each with its label."""
        by_role = ((role, [w.text for w in self.corroborations if w.role == role]) for role in ROLES)
        of_roles = [(role, texts) for role, texts in by_role if texts]
        sections = [("", list(self.findings)), *of_roles, (ELSE, [self.otherwise]), ("", [self.waiting])]
        return [(label, TextList(map(Text.whole, texts), "; ")) for label, texts in sections]

    def text(self) -> str:
        """Return one paragraph in English, a sentence a section."""
        return " ".join(f"{label}: {texts}." if label else f"{capitalised(texts)}." for label, texts in self.sections())

    def to_json(self) -> str:
        """Write the sections as a list of `{"label": ..., "texts": ...}`: see `text.as_parts`."""
        sections = [{"label": label, "texts": as_parts(texts)} for label, texts in self.sections()]
        return dump_parts(sections)


def capitalised(text: str) -> str:
    """Begin a sentence with a capital letter."""
    return text[:1].upper() + text[1:]


def within(value: float, sd: float, digits: int = 0) -> str:
    """Format a share in per cent with its interval of 90 %.

    Examples
    --------
    >>> within(0.34, 0.01)
    '34 % (32 to 36)'
    """
    low, high = (percent(value + side * Z_90 * sd, digits) for side in (-1, 1))
    return Text(phrases.WITHIN, value=percent(value, digits), low=low, high=high)


def percent(share: float, digits: int = 0) -> Figures:
    """Format a share in per cent, without the sign."""
    return figures(100.0 * share, digits)


def figures(value: float, digits: int = 0, unit: str = "") -> Figures:
    """Format a number."""
    return Figures(f"{value:.{digits}f}", unit)


def probability(p: float) -> str:
    """Format a probability, capped below certainty."""
    return Text(phrases.ABOVE, value=Figures("0.99")) if p > 0.99 else figures(p, 2)


def chance_above(value: float, limit: float, sd: float) -> str:
    """Format the probability that the true value exceeds the limit."""
    from scipy.special import ndtr  # noqa: PLC0415 (loads for a fifth of a second, which an idle night saves)

    return probability(float(ndtr((value - limit) / max(sd, 1e-6))))


def loss_finding(
    phrase: Phrase, loss: float, sd: float, limit: float, since: str, digits: int = 0, **names: str
) -> Text:
    """Format a loss with its interval, its distance from 0, and the probability that it exceeds the limit."""
    return Text(
        phrase,
        loss=within(loss, sd, digits),
        sigma=figures(loss / max(sd, 1e-6)),
        limit=percent(limit),
        since=since,
        odds=chance_above(loss, limit, sd),
        **names,
    )


def trend(slope: float) -> list[Text]:
    """Format the growth of a loss over thirty flights; empty where it does not grow."""
    return [Text(phrases.TREND, points=figures(1000.0 * slope, 1))] if slope > 1e-5 else []


def graded(value: float, *grades: tuple[float, str, Phrase]) -> tuple[Corroboration, ...]:
    """Return the observation of the first grade (limit, role, phrase) that the value exceeds; none where it is unknown.

    The phrase takes the value's size in per cent, as `share` or as `points`.
    """
    size = percent(abs(value))
    for limit, role, phrase in grades:
        if value > limit:
            return (Corroboration(role, Text(phrase, share=size, points=size)),)
    return ()
