"""The columns of an alert's texts, made by hand."""

from hdt_core.alerts.evidence import Corroboration, Evidence
from hdt_core.alerts.text import Text
from pipelines.words.evidence import stored_action


def evidence_of(finding: str, *corroborations: tuple[str, str]) -> Evidence:
    """Evidence of one finding, each corroboration with its role."""
    return Evidence((Text.whole(finding),), tuple(Corroboration(*c) for c in corroborations), "else", "Waiting costs")


def text_columns(at_first: Evidence, now: Evidence, action: str) -> dict[str, str]:
    return {
        "evidence": at_first.text(),
        "evidence_phrases": at_first.to_json(),
        "evidence_now": now.text(),
        "evidence_now_phrases": now.to_json(),
        "recommended_action": action,
        "action_phrases": stored_action(action),
    }
