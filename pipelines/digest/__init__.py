"""After the night: what changed since the last one, sent to the receivers of `notify.toml`, and work orders."""

from pipelines.digest.changes import Digest, changes_since, compare
from pipelines.digest.declaration import NotifyError, receivers_of
from pipelines.digest.delivery import send_digests, send_trial
from pipelines.digest.orders import work_orders, write_orders
from pipelines.digest.render import as_html, as_json, as_text, write_digest
from pipelines.digest.state import EMPTY, read_state

__all__ = [
    "EMPTY", "Digest", "NotifyError", "as_html", "as_json", "as_text", "changes_since", "compare", "read_state",
    "receivers_of", "send_digests", "send_trial", "work_orders", "write_digest", "write_orders",
]  # fmt: skip
